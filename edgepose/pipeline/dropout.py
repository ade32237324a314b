"""Bones whose sensors are silent: they go on with the rest of the body.

A bone that kept its orientation in the room would turn against a wearer who turns. So it keeps the attitude
in which it last stood to the pelvis; a lower leg, which does not lean when the wearer bends, only follows the
pelvis' heading. A silent pelvis turns with the lower legs, whose turns add up to its own. What that is worth:
`tools/bench_robustness.py`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edgepose.placements import PLACEMENTS, ROOT
from edgepose.rotations import rotation_about_axis, yaw_of_matrix

Array = NDArray[np.float64]

_LOWER_LEGS = np.array([name.endswith("lower_leg") for name in PLACEMENTS])


def extrapolate_dropouts(
    orientation: Array, acceleration: Array, held: NDArray[np.bool_], before: Array | None
) -> tuple[Array, Array]:
    """Bones with those of silent sensors moved along.

    Args:
        orientation: (6, 3, 3) R_TB, of silent sensors the last that was measured.
        acceleration: (6, 3) a_T, m/s^2.
        held: (6,) which sensors are silent.
        before: (6, 3, 3) what this gave for the frame before; None for the first.

    Returns:
        The same shapes; a silent pelvis does not accelerate, other silent bones do as the pelvis does.
    """
    if before is None or not held.any():
        return orientation, acceleration
    orientation, acceleration = orientation.copy(), acceleration.copy()
    if held[ROOT]:
        legs = _LOWER_LEGS & ~held
        turns = _turns(before[legs], orientation[legs])
        orientation[ROOT] = rotation_about_axis("y", turns.mean() if legs.any() else 0.0) @ before[ROOT]
        acceleration[ROOT] = 0.0
    turn = orientation[ROOT] @ before[ROOT].T
    others = held & (np.arange(len(held)) != ROOT)
    legs = others & _LOWER_LEGS
    orientation[others] = turn @ before[others]
    orientation[legs] = rotation_about_axis("y", _turns(before[ROOT], orientation[ROOT])) @ before[legs]
    acceleration[others] = acceleration[ROOT]
    return orientation, acceleration


def _turns(before: Array, now: Array) -> Array:
    """How far headings of (..., 3, 3) turned, (...) from -pi to pi."""
    turns: Array = (yaw_of_matrix(now) - yaw_of_matrix(before) + np.pi) % (2.0 * np.pi) - np.pi
    return turns
