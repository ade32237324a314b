"""Detection, during a run, of two sensors that sit on one limb.

Two limbs of a body do not move as one for long while they turn against all others: in 272 minutes of motion
capture (sport, dance, work, walks) no two did for more than 11 s of motion.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.calibration.fit import FEWEST
from edgepose.placements import PLACEMENTS
from edgepose.rotations import Array

STEP_S = 0.5
"""Time between two orientations that are compared, seconds."""
RIGID_DEG = 10.0
"""Largest change of the orientation of one sensor against another on the same limb: flesh moves."""
MOVED_DEG = 10.0
"""Least change against every other sensor in a step that counts as motion."""
STEPS = 40
"""Steps of motion after which two sensors are reported."""

SAME_LIMB = "move as one, while they turn against all others: both sit on one limb; put them on as calibrated"
"""What is wrong with them."""


class SameLimb:
    """Counts steps in which two sensors move as one, and reports the first such pair."""

    def __init__(self) -> None:
        """Start with no steps."""
        self._next_s = -np.inf
        self._before: Array | None = None  # (6, 6, 4) sensors against each other
        self._first: Array | None = None  # the same, when each pair began to move as one
        self._steps = dict.fromkeys(combinations(range(len(PLACEMENTS)), 2), 0)

    def update(self, time_s: float, orientation: Array, missing: NDArray[np.bool_]) -> tuple[str, str] | None:
        """Return the two sensors that are now found to sit on one limb; None if none are.

        Args:
            time_s: time of a frame in which no sensor of the rig is held, seconds.
            orientation: (6, 4) unit quaternions, sensor to inertial.
            missing: (6,) sensors that the rig lacks; too few of the others are not judged.
        """
        if time_s < self._next_s:
            return None
        self._next_s = time_s + STEP_S - 1e-6
        now, before = _against_each_other(orientation), self._before
        self._before = now
        if before is None or np.count_nonzero(~missing) < FEWEST:
            return None
        if self._first is None:
            self._first = now.copy()
        turned = np.degrees(rot.angle_between_quats(now, self._first)) > RIGID_DEG
        turned |= missing | missing[:, None]
        self._first[turned] = now[turned]
        moved = np.degrees(rot.angle_between_quats(now, before)) > MOVED_DEG
        moved |= missing  # against a missing sensor nothing shows
        still = np.count_nonzero(~moved, axis=1) - ~moved.diagonal()  # against how many each did not turn
        for i, j in self._steps:
            if turned[i, j]:
                self._steps[i, j] = 0
            else:
                self._steps[i, j] += bool(still[i] == (not moved[i, j]))
            if self._steps[i, j] >= STEPS:
                self._steps = {}  # one wrong sensor may look like others
                return PLACEMENTS[i], PLACEMENTS[j]
        return None


def _against_each_other(orientation: Array) -> Array:
    """Return unit quaternions (6, 6, 4) from the second sensor to the first."""
    return rot.quat_multiply(rot.quat_conjugate(orientation)[:, None], orientation[None])
