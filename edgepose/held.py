"""Bones whose sensors are silent: they go on with the pelvis, in the attitude in which they last stood to it.

A bone that kept its orientation in the room would turn against a wearer who turns: over held-out takes that
costs 4 to 6 degrees of joint angle, this 3 to 5 (`tools/bench_robustness.py`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edgepose.placements import ROOT

Array = NDArray[np.float64]


def carried(
    orientation: Array, acceleration: Array, held: NDArray[np.bool_], before: Array | None
) -> tuple[Array, Array]:
    """Bones with those of silent sensors moved along with the pelvis.

    While the pelvis' own sensor is silent nothing is moved: there is nothing to go by.

    Args:
        orientation: (6, 3, 3) R_TB, of silent sensors the last that was measured.
        acceleration: (6, 3) a_T, m/s^2.
        held: (6,) which sensors are silent.
        before: (6, 3, 3) what this gave for the frame before; None for the first.

    Returns:
        The same shapes; a silent sensor accelerates as the pelvis does.
    """
    if before is None or held[ROOT] or not held.any():
        return orientation, acceleration
    orientation, acceleration = orientation.copy(), acceleration.copy()
    orientation[held] = orientation[ROOT] @ before[ROOT].T @ before[held]
    acceleration[held] = acceleration[ROOT]
    return orientation, acceleration
