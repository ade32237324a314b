"""Points of a posed body that may touch the ground, seen from the pelvis."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgepose.skeleton import JOINTS, Body

Array = NDArray[np.float64]
Input = NDArray[np.floating[Any]]

POINTS = (
    "left_ankle", "right_ankle", "left_foot", "right_foot", "pelvis", "left_wrist", "right_wrist",
    "left_knee", "right_knee", "left_elbow", "right_elbow", "left_shoulder", "right_shoulder", "spine3", "head",
)  # fmt: skip
"""The joints, those of `edgepose.pose.CONTACTS` first."""

_LEG_LENGTH = 0.846
_SKIN = {
    **dict.fromkeys(("left_ankle", "right_ankle"), 0.07),
    **dict.fromkeys(("left_foot", "right_foot"), 0.02),
    "pelvis": 0.11,
    **dict.fromkeys(("left_wrist", "right_wrist"), 0.04),
    **dict.fromkeys(("left_knee", "right_knee"), 0.06),
    **dict.fromkeys(("left_elbow", "right_elbow"), 0.05),
    **dict.fromkeys(("left_shoulder", "right_shoulder", "spine3", "head"), 0.10),
}
"""Height of a joint above a surface that the body touches there, metres, for legs of `_LEG_LENGTH`."""


class BodyPoints:
    """Computes where `POINTS` are, from rotations.

    Attributes:
        skin: (15,) heights of the points above what they touch, metres. As everywhere in edgepose, the toes'
            joints of a standing wearer are at height 0, so all are lower by the thickness of the sole.
    """

    def __init__(self, body: Body) -> None:
        """Store the lengths of a body."""
        skin = np.array([_SKIN[name] for name in POINTS]) - _SKIN["left_foot"]
        self.skin: Array = skin * (body.leg_length_m / _LEG_LENGTH)
        foot = body.offsets[JOINTS.index("left_foot")]
        self.skin[:2] = -foot[1]  # the foot of a wearer who stands straight is flat
        offsets = body.offsets
        self._toe, self._ankle, self._knee, self._hip = (offsets[[j, j + 1], :, None] for j in (10, 7, 4, 1))
        self._wrist, self._elbow, self._shoulder, self._collar = (
            offsets[[j, j + 1], :, None] for j in (20, 18, 16, 13)
        )
        self._head, self._neck, self._spine3, self._spine2, self._spine1 = (
            offsets[j][:, None] for j in (15, 12, 9, 6, 3)
        )

    def positions(self, rotations: Input) -> Array:
        """Return the positions (15, 3) of `POINTS` relative to the pelvis, along the axes of T, metres.

        Args:
            rotations: (24, 3, 3) local rotations, joint 0 relative to T.
        """
        # From the tips of the limbs to the pelvis: columns are points in the frame of the joint above.
        toe = rotations[7:9] @ self._toe + self._ankle
        shin = rotations[4:6] @ np.concatenate([self._ankle, toe], axis=2) + self._knee
        leg = rotations[1:3] @ np.concatenate([self._knee, shin], axis=2) + self._hip
        wrist = rotations[18:20] @ self._wrist + self._elbow
        forearm = rotations[16:18] @ np.concatenate([self._elbow, wrist], axis=2) + self._shoulder
        arm = rotations[13:15] @ np.concatenate([self._shoulder, forearm], axis=2) + self._collar
        head = rotations[12] @ self._head + self._neck
        above = rotations[9] @ np.concatenate([arm[0], arm[1], head], axis=1) + self._spine3
        above = rotations[6] @ np.concatenate([above, self._spine3], axis=1) + self._spine2
        above = rotations[3] @ above + self._spine1
        pelvis = np.zeros((3, 1))
        points = np.concatenate([leg[0], leg[1], above, pelvis], axis=1)
        result: Array = (rotations[0] @ points).T[_ORDER]
        return result


_ORDER = [1, 4, 2, 5, 14, 8, 11, 0, 3, 7, 10, 6, 9, 13, 12]
"""Index of each of `POINTS` in the columns of `BodyPoints.positions`."""
