"""Heading reset from some steps straight ahead, from standing to standing.

The sensors of a wearer who stands straight, walks and stands straight again all travel the same way: the
swing of an arm or a leg cancels out. Its direction is forward, in each sensor's own inertial frame.
"""

from __future__ import annotations

import numpy as np

from edgepose import rotations as rot
from edgepose.calibration.functional import leans, main_direction
from edgepose.calibration.heading_reset import HeadingReset, WeakMotionError, over
from edgepose.calibration.static_pose import Hold, check_reported, trim
from edgepose.calibration.walks import ADVICE, Walk, find_walk
from edgepose.placements import PLACEMENTS
from edgepose.rotations import Array

STEPS_S = 8.0
"""Time for the steps and the stand after them, seconds."""

ERROR_WARNING_DEG, ERROR_LIMIT_DEG = 10.0, 16.0
TURN_LIMIT_DEG = 20.0
POSE_LIMIT_DEG = 25.0

_LEGS = [PLACEMENTS.index(name) for name in ("left_lower_leg", "right_lower_leg")]
# Errors of the best displacements, and of the plane in which a lower leg swings.
_DIRECTION_ERROR_DEG, _LEAN_ERROR_DEG = 3.0, 6.0


def headings_from_steps(moving: Hold, upright: Array, must_stop: bool = True) -> HeadingReset:
    """Reset headings from some steps straight ahead; the common frame's X axis is forward.

    Args:
        moving: samples of standing straight for a second, the steps, and standing in the same way again.
        upright: (6, 4) mean quaternions of the straight pose, held shortly before.
        must_stop: refuse steps without a stand after them; otherwise they give a warning.

    Raises:
        WeakMotionError: no stand before or after the steps, too short a way, a turn, backward steps,
            another pose at the end, or sensors whose displacements differ.
        CalibrationError: a sensor measures no acceleration, or lost samples.
    """
    check_reported(moving)
    walk = find_walk(moving, must_stop)
    if walk.stops:
        _check_end(trim(moving, walk.end_s, np.inf), upright)
    reset = _headings(walk, trim(moving, walk.start_s, walk.end_s), upright)
    if uncertain := over(reset.error_deg, ERROR_LIMIT_DEG):
        lengths = ", ".join(f"{length:.1f}" for length in walk.lengths_m)
        raise WeakMotionError(
            f"no heading from these steps: the displacement of {uncertain} does not fit the others "
            f"(in m: {lengths}); {ADVICE}"
        )
    return reset


def _check_end(end: Hold, upright: Array) -> None:
    """Check that the wearer stands after the steps as before.

    Raises:
        WeakMotionError: they face another direction or stand in another pose; names the sensors.
    """
    now = np.stack([rot.mean_rotation(s.quat[: max(1, len(s.quat) // 2)]) for s in end])
    between = rot.quat_multiply(now, rot.quat_conjugate(upright))
    turned = float(np.degrees(np.median(rot.wrapped(rot.yaw_of_quat(between)))))
    if abs(turned) > TURN_LIMIT_DEG:
        raise WeakMotionError(
            f"no heading from these steps: the wearer turned by {abs(turned):.0f} deg; {ADVICE}"
        )
    tilt = np.degrees(rot.tilt_of_quat(between))
    if other := over(tilt, POSE_LIMIT_DEG):
        raise WeakMotionError(f"no heading from these steps: another pose after them: {other}; {ADVICE}")


def _headings(walk: Walk, moving: Hold, upright: Array) -> HeadingReset:
    """Return the headings in which the displacements are forward, for the lower legs also their leaning.

    Raises:
        WeakMotionError: the wearer walked backwards.
    """
    forward = np.exp(1j * np.arctan2(walk.displacements[:, 1], walk.displacements[:, 0]))
    # Without errors, all displacements would be level and of one length. The error across cannot be seen.
    wrong_m = np.hypot(walk.lengths_m - walk.length_m, walk.displacements[:, 2]) / np.sqrt(2.0)
    error_deg = np.hypot(np.degrees(np.arctan2(wrong_m, walk.length_m)), _DIRECTION_ERROR_DEG)
    surplus = 0.0
    for i in _LEGS:
        direction, spread_deg, one_way = main_direction(leans(moving[i].quat, upright[i]))
        lean = complex(*direction)
        if (lean * forward[i].conjugate()).real < 0.0:  # a leg leans to both sides
            lean, one_way = -lean, -one_way
        surplus += one_way
        forward[i], error_deg[i] = _weighted(
            forward[i], error_deg[i], lean, np.hypot(spread_deg / 2.0, _LEAN_ERROR_DEG)
        )
    if surplus < 0.0:  # heels rise behind
        raise WeakMotionError(f"no heading from these steps: the wearer walked backwards; {ADVICE}")
    warnings = [
        f"the heading of {name} is only known to {error:.0f} deg: its displacement differs from the others'"
        for name, error in zip(PLACEMENTS, error_deg, strict=True)
        if ERROR_WARNING_DEG < error <= ERROR_LIMIT_DEG
    ]
    if not walk.stops:
        warnings.insert(0, "the wearer did not stand still after the steps: headings are less certain")
    return HeadingReset(-np.angle(forward), error_deg, warnings)


def _weighted(one: complex, one_deg: float, other: complex, other_deg: float) -> tuple[complex, float]:
    """Combine two directions by their errors; what they differ by is an error, too."""
    share = other_deg**2 / (one_deg**2 + other_deg**2)
    between_deg = abs(np.degrees(np.angle(other / one)))
    error_deg = np.hypot(one_deg * other_deg / np.hypot(one_deg, other_deg), between_deg / 2.0)
    return share * one + (1.0 - share) * other, float(error_deg)
