"""Hinges of elbows and knees, by which all skeletons get SMPL's frames for upper arms and thighs.

In SMPL's zero pose an elbow bends about the vertical axis and a knee about the lateral one. Skeletons of
other sources differ from this by a constant rotation about the length of the upper bone (CMU's elbows by
30 deg). The motion itself reveals it: the hinge is the axis about which the joint bends.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from edgepose.rotations import rotvec_to_matrix

from .motion import Array, Motion

LEAST_BEND = 20.0
"""Angle between the two bones, degrees, from which on the axis of the bend is known."""
MOST_BEND = 150.0
LEAST_FRAMES = 50
LEAST_AGREEMENT = 0.9
"""Least share of the axes' second moment along their common direction; 1 for an ideal hinge."""

_HINGES = {
    16: (18, (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
    17: (19, (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    1: (4, (0.0, -1.0, 0.0), (1.0, 0.0, 0.0)),
    2: (5, (0.0, -1.0, 0.0), (1.0, 0.0, 0.0)),
}
"""Upper bone -> lower bone, direction of both in SMPL's zero pose, axis about which the lower one bends."""


class Bends(NamedTuple):
    """Axes about which joints bend, over any number of frames, by row of `_HINGES`.

    Attributes:
        sums: (4, 3) sums of unit axes in the upper bones' frames.
        moments: (4, 3, 3) sums of their outer products.
        counts: (4,) numbers of frames in which the joints are bent.
    """

    sums: Array
    moments: Array
    counts: Array

    @classmethod
    def of(cls, motion: Motion) -> Bends:
        """Return those of a take, 20 frames a second."""
        axes = [_bend_axes(motion, upper, *rest[:2]) for upper, rest in _HINGES.items()]
        return cls(
            np.stack([a.sum(axis=0) for a in axes]),
            np.stack([a.T @ a for a in axes]),
            np.array([len(a) for a in axes]),
        )

    def plus(self, other: Bends) -> Bends:
        """Return those of both."""
        return Bends(*(mine + yours for mine, yours in zip(self, other, strict=True)))


def hinge_rotations(bends: Bends) -> Array:
    """Return the right factors (24, 3, 3) that bring a skeleton's elbows and knees to SMPL's hinges.

    They rotate upper arms and thighs about their own length. A joint that does not bend, or not as a hinge,
    keeps its frame.
    """
    result = np.tile(np.eye(3), (24, 1, 1))
    for row, (upper, (_, length, hinge)) in enumerate(_HINGES.items()):
        if bends.counts[row] < LEAST_FRAMES:
            continue
        moments, directions = np.linalg.eigh(bends.moments[row] / bends.counts[row])
        if moments[-1] < LEAST_AGREEMENT:
            continue
        axis = directions[:, -1] * np.sign(directions[:, -1] @ bends.sums[row])
        angle = np.arctan2(np.cross(hinge, axis) @ length, np.dot(hinge, axis))
        result[upper] = rotvec_to_matrix(angle * np.array(length))
    return result


def _bend_axes(motion: Motion, upper: int, lower: int, length: tuple[float, float, float]) -> Array:
    """Return unit vectors (N, 3), in the upper bone's frame, about which the lower bone is bent."""
    pair = motion.rotations[:: max(1, round(motion.rate / 20.0))]
    direction = np.swapaxes(pair[:, upper], -1, -2) @ pair[:, lower] @ np.array(length)
    axes = np.cross(length, direction)
    size = np.linalg.norm(axes, axis=1)
    bend = np.degrees(np.arctan2(size, direction @ np.array(length)))
    chosen = (bend > LEAST_BEND) & (bend < MOST_BEND)
    unit: Array = axes[chosen] / size[chosen, None]
    return unit
