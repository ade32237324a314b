"""Points of a posed body that may touch something, seen from the pelvis."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgepose.skeleton import JOINTS, Body

Array = NDArray[np.float64]
Input = NDArray[np.floating[Any]]
Point = list[float]

POINTS = (
    "left_ankle", "right_ankle", "left_foot", "right_foot", "pelvis", "left_wrist", "right_wrist",
    "left_knee", "right_knee", "left_elbow", "right_elbow", "left_shoulder", "right_shoulder",
    "spine3", "head",
)  # fmt: skip
"""The joints, those of `edgepose.pose.CONTACTS` first. An ankle stands for the point of the sole below it: a
shank that swings over a foot pivots there."""

NEVER_BELOW = (0, 1, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14)
"""Indices of the points that cannot be below the ground: all but the toes, whose joints are not measured."""

_LEG_LENGTH = 0.846
_SKIN = {
    **dict.fromkeys(("left_ankle", "right_ankle", "left_foot", "right_foot"), 0.0),
    "pelvis": 0.09,
    **dict.fromkeys(("left_wrist", "right_wrist"), 0.02),
    **dict.fromkeys(("left_knee", "right_knee"), 0.04),
    **dict.fromkeys(("left_elbow", "right_elbow"), 0.03),
    **dict.fromkeys(("left_shoulder", "right_shoulder", "spine3", "head"), 0.08),
}
"""Height of a point above a surface that the body touches there, metres, for legs of `_LEG_LENGTH`. As
everywhere in edgepose, the toes' joints of a standing wearer are at height 0, so soles do not count."""


class BodyPoints:
    """Computes the positions of `POINTS` from rotations.

    Attributes:
        skin: 15 heights of the points above a surface that they touch, metres.
    """

    def __init__(self, body: Body) -> None:
        """Store the lengths of a body."""
        scale = body.leg_length_m / _LEG_LENGTH
        self.skin: list[float] = [_SKIN[name] * scale for name in POINTS]
        offsets = {name: body.offsets[j][:, None] for j, name in enumerate(JOINTS)}

        def both(joint: str) -> Array:
            return np.stack([offsets[f"left_{joint}"], offsets[f"right_{joint}"]])

        self._toe, self._ankle, self._wrist = both("foot"), both("ankle"), both("wrist")
        self._hip, self._knee, self._collar = both("hip"), both("knee"), both("collar")
        self._shoulder, self._elbow = both("shoulder"), both("elbow")
        self._head, self._neck = offsets["head"], offsets["neck"]
        self._spine1, self._spine2, self._spine3 = offsets["spine1"], offsets["spine2"], offsets["spine3"]
        # Columns are points in the frame of the joint that moves them. The constant ones are set here.
        self._below_knee = np.concatenate([self._ankle + self._toe * [[0], [1], [0]], self._toe], axis=2)
        self._below_hip = np.concatenate([self._knee] * 3, axis=2)
        self._below_shoulder = np.concatenate([self._elbow] * 2, axis=2)
        self._below_collar = np.concatenate([self._shoulder] * 3, axis=2)
        self._above_spine3 = np.zeros((3, 7))
        self._above_spine2 = np.concatenate([self._spine3] * 8, axis=1)
        self._all = np.zeros((3, 15))

    def positions(self, rotations: Input) -> list[Point]:
        """Return the positions of the 15 `POINTS` relative to the pelvis, along the axes of T, metres.

        Args:
            rotations: (24, 3, 3) local rotations, joint 0 relative to T.
        """
        rotations = np.asarray(rotations, float)  # once, not in each product
        matmul, everything = np.matmul, self._all
        self._below_knee[:, :, 1:] = matmul(rotations[7:9], self._toe) + self._ankle
        self._below_hip[:, :, 1:] = matmul(rotations[4:6], self._below_knee) + self._knee
        legs = matmul(rotations[1:3], self._below_hip) + self._hip
        self._below_shoulder[:, :, 1:] = matmul(rotations[18:20], self._wrist) + self._elbow
        self._below_collar[:, :, 1:] = matmul(rotations[16:18], self._below_shoulder) + self._shoulder
        arms = matmul(rotations[13:15], self._below_collar) + self._collar
        trunk = self._above_spine3
        trunk[:, :3], trunk[:, 3:6] = arms
        trunk[:, 6:] = matmul(rotations[12], self._head) + self._neck
        self._above_spine2[:, 1:] = matmul(rotations[9], trunk) + self._spine3
        everything[:, :3], everything[:, 3:6] = legs
        everything[:, 6:14] = (
            matmul(rotations[3], matmul(rotations[6], self._above_spine2) + self._spine2) + self._spine1
        )
        points: list[Point] = matmul(rotations[0], everything).T.tolist()
        return [points[column] for column in _COLUMNS]


_COLUMNS = (1, 4, 2, 5, 14, 9, 12, 0, 3, 8, 11, 7, 10, 6, 13)
"""Column of each of `POINTS` in `BodyPoints.positions`."""
