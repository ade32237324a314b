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
_IDENTITY = np.eye(3)
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


def _path(joint: str) -> list[int]:
    """Return a joint and the joints between it and the pelvis."""
    path = [JOINTS.index(joint)]
    while PARENTS[path[-1]] >= 0:
        path.append(PARENTS[path[-1]])
    return path[:-1]


_CARRIERS = sorted({PARENTS[j] for name in POINTS for j in _path(name)})
"""Joints whose rotations move a point."""


def _ancestors() -> list[NDArray[np.intp]]:
    """Return for each carrier, and the identity after them, the parent, its parent's parent, and so on.

    Each array goes up twice as far as the one before; beyond the pelvis is the identity.
    """
    identity = len(_CARRIERS)
    parents = [_CARRIERS.index(PARENTS[j]) if PARENTS[j] >= 0 else identity for j in _CARRIERS]
    ancestors = [np.array([*parents, identity])]
    while (further := ancestors[-1][ancestors[-1]]).min() < identity:
        ancestors.append(further)
    return ancestors


_ANCESTORS = _ancestors()
_MOVING = np.array(_CARRIERS)


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
        lengths = np.zeros((len(POINTS), len(_CARRIERS), 3))  # from joint to joint, in the frames of carriers
        for row, name in zip(lengths, POINTS, strict=True):
            for j in _path(name):
                row[_CARRIERS.index(PARENTS[j])] = body.offsets[j]
            if name.endswith("_ankle"):  # the sole, which is not rotated by the foot
                j, foot = JOINTS.index(name), JOINTS.index(name.replace("ankle", "foot"))
                row[_CARRIERS.index(PARENTS[j]), 1] += body.offsets[foot, 1]
        self._lengths = lengths.reshape(len(POINTS), -1)

    def positions(self, rotations: Input) -> list[Point]:
        """Return the positions of the 15 `POINTS` relative to the pelvis, along the axes of T, metres.

        Args:
            rotations: (24, 3, 3) local rotations, joint 0 relative to T.
        """
        # Transposed, so that the products are rows; the chains of all joints grow twice as long in each step.
        chains = np.empty((len(_CARRIERS) + 1, 3, 3))
        chains[:-1] = rotations.take(_MOVING, 0).transpose(0, 2, 1)
        chains[-1] = _IDENTITY
        for ancestors in _ANCESTORS:
            chains = chains @ chains.take(ancestors, 0)
        positions: list[Point] = (self._lengths @ chains[:-1].reshape(-1, 3)).tolist()
        return positions
