"""Extrapolation of segments whose sensors dropped out: they move along with the rest of the body.

If a segment kept its orientation in the room, it would rotate against the body of a wearer who turns. Instead
it keeps its last orientation relative to the pelvis. A lower leg, which does not lean when the wearer bends
over, only follows the pelvis' heading. A silent pelvis follows the mean heading change of the lower legs.
`tools/bench_robustness.py` measures the benefit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edgepose.calibration import POSES
from edgepose.placements import PLACEMENTS, ROOT
from edgepose.rotations import rotation_about_axis, yaw_of_matrix

Array = NDArray[np.float64]

_LOWER_LEGS = np.array([name.endswith("lower_leg") for name in PLACEMENTS])


def extrapolate_dropouts(
    orientation: Array, acceleration: Array, held: NDArray[np.bool_], before: Array | None
) -> tuple[Array, Array]:
    """Extrapolate the orientations and accelerations of segments whose sensors are silent.

    Args:
        orientation: (6, 3, 3) R_TB; for silent sensors the last measured one.
        acceleration: (6, 3) a_T, m/s^2.
        held: (6,) which sensors are silent.
        before: (6, 3, 3) the orientations returned for the previous frame; None for the first.

    Returns:
        Orientations and accelerations of the same shapes. A silent pelvis has zero acceleration, other silent
        segments that of the pelvis.
    """
    if before is None or not held.any():
        return orientation, acceleration
    orientation, acceleration = orientation.copy(), acceleration.copy()
    if held[ROOT]:
        legs = _LOWER_LEGS & ~held
        changes = _heading_changes(before[legs], orientation[legs])
        orientation[ROOT] = rotation_about_axis("y", changes.mean() if legs.any() else 0.0) @ before[ROOT]
        acceleration[ROOT] = 0.0
    pelvis_rotation = orientation[ROOT] @ before[ROOT].T
    others = held & (np.arange(len(held)) != ROOT)
    legs = others & _LOWER_LEGS
    orientation[others] = pelvis_rotation @ before[others]
    pelvis_heading_change = _heading_changes(before[ROOT], orientation[ROOT])
    orientation[legs] = rotation_about_axis("y", pelvis_heading_change) @ before[legs]
    acceleration[others] = acceleration[ROOT]
    return orientation, acceleration


def assumed_bones(orientation: Array, missing: NDArray[np.bool_]) -> Array:
    """Return the orientations (6, 3, 3) before a run with a rig that lacks sensors.

    The segments without a sensor are those of a wearer who stands straight, in the heading of the pelvis.
    From then on they are extrapolated like those of silent sensors.

    Args:
        orientation: (6, 3, 3) R_TB of the first frame.
        missing: (6,) which sensors the rig lacks; the pelvis is not among them.
    """
    result = orientation.copy()
    result[missing] = rotation_about_axis("y", yaw_of_matrix(orientation[ROOT])) @ POSES["straight"][missing]
    return result


def _heading_changes(before: Array, now: Array) -> Array:
    """Return the changes of heading (...), from -pi to pi, between orientations (..., 3, 3)."""
    changes: Array = (yaw_of_matrix(now) - yaw_of_matrix(before) + np.pi) % (2.0 * np.pi) - np.pi
    return changes
