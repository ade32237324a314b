"""Straight pose and then T-pose: the raised arms show which way is forward, and improve the bone offsets.

What was vertical in a forearm that hung points to the body when the arm is raised to its side, whatever the
forearm's twist. So each forearm shows its own heading, and both show which way the wearer faces.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edgepose import rotations as rot
from edgepose.calibration.checks import HoldError
from edgepose.calibration.heading_reset import HeadingReset, over
from edgepose.calibration.sensor_to_segment import POSES, Calibration
from edgepose.calibration.static_pose import (
    TENTH_S,
    Hold,
    stillest_start,
    tenths_with_samples,
    trim,
    unit_or_zero,
)
from edgepose.errors import CalibrationError
from edgepose.placements import PLACEMENTS
from edgepose.rotations import Array

TWO_POSES = "straight+t-pose"
"""Name of the two poses one after the other."""

RAISED_DEG = (65.0, 115.0)
"""Angles between which the forearms must have been raised."""

OPPOSITE_LIMIT_DEG = 45.0
"""Largest angle by which the forearms may miss pointing in opposite directions: both may be in front."""

CONTRADICTION_DEG = 30.0
"""Largest angle between the direction of an arm and that which the heading reset expects."""

STOOD_LIMIT_DEG = 15.0
"""Largest tilt of the other sensors between the poses."""

OFFSET_WARNING_DEG, OFFSET_LIMIT_DEG = 25.0, 45.0
"""Differences between the bone offsets of the two poses."""

_ARM_ERROR_DEG = 8.0  # of the direction of an arm that a wearer stretches to their side
_ARMS = [PLACEMENTS.index("left_forearm"), PLACEMENTS.index("right_forearm")]


def forward_of_raised_arms(straight: Array, t_pose: Array) -> Array:
    """Return the forward direction that each raised forearm of a wearer shows.

    Args:
        straight: (6, 4) mean quaternions of the straight pose, sensor to inertial.
        t_pose: (6, 4) those of the T-pose, held shortly after.

    Returns:
        (2,) angles from X of the inertial frames of the left and the right forearm's sensor, rad.

    Raises:
        HoldError: the arms were not raised to the sides, or the wearer did not stand as before.
    """
    turned = _turned_up(straight, t_pose)
    raised_deg = np.degrees(np.arccos(np.clip(turned[:, 2], -1.0, 1.0)))
    least, most = RAISED_DEG
    if wrong := [
        f"{PLACEMENTS[i]} by {raised_deg[i]:.0f} deg" for i in _ARMS if not least <= raised_deg[i] <= most
    ]:
        raise HoldError(
            f"the arms were not raised level to the sides: {', '.join(wrong)} instead of 90; stretch out both"
        )
    raised_deg[_ARMS] = 0.0
    if moved := over(raised_deg, STOOD_LIMIT_DEG):
        raise HoldError(f"not standing as before the T-pose: {moved}; move the arms only")
    # Inwards, which is to the right for the left arm.
    return np.arctan2(turned[_ARMS, 1], turned[_ARMS, 0]) + np.array([0.5, -0.5]) * np.pi


def _turned_up(straight: Array, later: Array) -> Array:
    """Return directions (..., 3) in I: what was up in sensors (..., 4) then, as they are later."""
    return rot.quat_rotate(later, rot.quat_rotate(rot.quat_conjugate(straight), [0.0, 0.0, 1.0]))


def facing_deg(arms: Array, heading_offset: Array) -> tuple[float, float]:
    """Return the direction that the wearer faces, from X of the common frame towards Y; its error.

    Args:
        arms: (2,) result of `forward_of_raised_arms`.
        heading_offset: (6,) rotation about Z from each sensor's inertial frame to the common one, rad.

    Returns:
        Both in degrees.

    Raises:
        CalibrationError: the forearms do not point in opposite directions.
    """
    left, right = np.exp(1j * (arms + heading_offset[_ARMS]))
    apart_deg = abs(float(np.degrees(np.angle(left / right))))
    if apart_deg > OPPOSITE_LIMIT_DEG:
        raise CalibrationError(
            f"the forearms are {apart_deg:.0f} deg from pointing in opposite directions: stretch both arms "
            "out to the sides; if you did, the sensors have no common north: add --heading-reset steps"
        )
    return float(np.degrees(np.angle(left + right))), apart_deg / 2.0


def with_raised_arms(reset: HeadingReset, arms: Array) -> HeadingReset:
    """Improve the headings of the forearms, in a common frame whose X axis is forward, by the raised arms.

    Raises:
        CalibrationError: an arm points another way than the heading reset says; names it.
    """
    offset, error_deg = reset.offset.copy(), reset.error_deg.copy()
    apart_deg = np.zeros(len(PLACEMENTS))
    for i, angle in zip(_ARMS, arms, strict=True):
        between = float(rot.wrapped(-angle - offset[i]))
        apart_deg[i] = abs(np.degrees(between))
        share = error_deg[i] ** 2 / (error_deg[i] ** 2 + _ARM_ERROR_DEG**2)
        offset[i] += share * between
        error_deg[i] *= _ARM_ERROR_DEG / np.hypot(error_deg[i], _ARM_ERROR_DEG)
    if wrong := over(apart_deg, CONTRADICTION_DEG):
        raise CalibrationError(
            f"the raised arms contradict the heading reset: {wrong}; stretch both arms out to the sides, and "
            "repeat both"
        )
    return reset._replace(offset=rot.wrapped(offset), error_deg=error_deg)


def with_t_pose(calibration: Calibration, t_pose: Array) -> tuple[Calibration, list[str]]:
    """Average the bone offsets of the straight pose with those of the T-pose; return warnings, too.

    Args:
        calibration: from the straight pose.
        t_pose: (6, 4) mean quaternions of the T-pose, sensor to inertial, as measured.

    Raises:
        CalibrationError: the offsets contradict each other; names the sensors.
    """
    turned = rot.quat_multiply(rot.quat_about_z(calibration.heading_offset), t_pose)
    r_ts = rot.quat_to_matrix(calibration.body_from_inertial) @ rot.quat_to_matrix(turned)
    other = rot.matrix_to_quat(rot.transpose(POSES["t-pose"]) @ r_ts)
    both = np.stack([calibration.bone_from_sensor, other], axis=1)
    apart_deg = np.degrees(rot.geodesic_angle(*(rot.quat_to_matrix(both[:, i]) for i in (0, 1))))
    if wrong := over(apart_deg, OFFSET_LIMIT_DEG):
        raise CalibrationError(
            f"straight pose and T-pose contradict each other: {wrong}; face the same way in both, palms on "
            "the thighs, then down"
        )
    warnings = [
        f"straight pose and T-pose differ by {angle:.0f} deg at {name}: turn the palms down in the T-pose"
        for name, angle in zip(PLACEMENTS, apart_deg, strict=True)
        if angle > OFFSET_WARNING_DEG
    ]
    mean = np.stack([rot.mean_rotation(pair) for pair in both])
    metadata = dict(calibration.metadata) | {
        "t_pose_differs_deg": {n: round(float(a), 3) for n, a in zip(PLACEMENTS, apart_deg, strict=True)}
    }
    return replace(calibration, bone_from_sensor=mean, metadata=metadata), warnings


def t_pose_start(everything: Hold, straight: Array, after_s: float, seconds: float) -> float:
    """Return the start of the stillest part of the first time with raised arms, seconds.

    Args:
        everything: samples of a recording.
        straight: (6, 4) mean quaternions of the straight pose.
        after_s: end of the straight pose.
        seconds: length of the part.

    Raises:
        CalibrationError: there is none.
    """
    last_s = min(sensor.time_s.max() for sensor in everything)
    times = tenths_with_samples(everything, after_s, last_s)
    raised = np.ones(len(times), bool)
    for i in _ARMS:
        order = np.argsort(everything[i].time_s, kind="stable")
        rows = np.searchsorted(everything[i].time_s[order], times).clip(max=len(order) - 1)
        up = _turned_up(straight[i], unit_or_zero(everything[i].quat[order][rows]))
        raised &= np.abs(np.degrees(np.arccos(np.clip(up[:, 2], -1.0, 1.0))) - 90.0) < 20.0
    edges = np.flatnonzero(np.diff(raised.astype(int), prepend=0, append=0)).reshape(-1, 2)
    for begin, end in edges:
        start_s, end_s = float(times[begin]), float(times[end - 1]) + TENTH_S
        if end_s - start_s > seconds + TENTH_S:
            return stillest_start(trim(everything, start_s, end_s), seconds)
    raise CalibrationError(
        f"no T-pose of {seconds:g} s after the straight pose: the arms were not raised to the sides; "
        "record again, or use --pose straight"
    )
