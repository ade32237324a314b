"""Points of a posed body that may touch something, seen from the pelvis."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgepose.skeleton import JOINTS, PARENTS, Body

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
        scale: size of the body, 1 for the average.
        skin: 15 heights of the points above a surface that they touch, metres.
    """

    def __init__(self, body: Body) -> None:
        """Store the lengths of a body."""
        self.scale = body.leg_length_m / _LEG_LENGTH
        self.skin: list[float] = [_SKIN[name] * self.scale for name in POINTS]
        offsets = body.offsets.tolist()
        carries = [name in POINTS for name in JOINTS]
        self._steps: list[tuple[int, int, Point, Point | None]] = []
        names: list[list[str]] = [[] for _ in JOINTS]
        for j in range(len(JOINTS) - 1, 0, -1):  # children come before their parents
            if carries[j]:
                parent = PARENTS[j]
                carries[parent] = True
                point = self._point(JOINTS[j], offsets)
                self._steps.append((j, parent, offsets[j], point))
                names[parent] += [JOINTS[j]] * (point is not None) + names[j]
        names[0].append(JOINTS[0])
        self._order = [names[0].index(name) for name in POINTS]

    @staticmethod
    def _point(joint: str, offsets: list[Point]) -> Point | None:
        """Return the point that stands for a joint in the frame of its parent; None if there is none."""
        x, y, z = offsets[JOINTS.index(joint)]
        if joint.endswith("_ankle"):  # the sole, which is not rotated by the foot
            y += offsets[JOINTS.index(joint.replace("ankle", "foot"))][1]
        return [x, y, z] if joint in POINTS else None

    def positions(self, rotations: Input) -> list[Point]:
        """Return the positions of the 15 `POINTS` relative to the pelvis, along the axes of T, metres.

        Plain floats are used on purpose: numpy on a few points at a time takes twice as long.

        Args:
            rotations: (24, 3, 3) local rotations, joint 0 relative to T.
        """
        matrices = rotations.tolist()
        carried: list[list[Point]] = [[] for _ in matrices]
        for j, parent, offset, point in self._steps:
            if point is not None:
                carried[parent].append(point)
            if carried[j]:
                carried[parent] += _moved(matrices[j], offset, carried[j])
        points = [*_moved(matrices[0], [0.0, 0.0, 0.0], carried[0]), [0.0, 0.0, 0.0]]
        return [points[i] for i in self._order]


def _moved(matrix: list[list[float]], offset: Point, points: list[Point]) -> list[Point]:
    """Return points that are rotated and then shifted."""
    (a, b, c), (d, e, f), (g, h, i) = matrix
    u, v, w = offset
    return [
        [a * x + b * y + c * z + u, d * x + e * y + f * z + v, g * x + h * y + i * z + w]
        for x, y, z in points
    ]
