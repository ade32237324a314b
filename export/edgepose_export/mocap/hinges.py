"""Hinges of elbows and knees, by which all skeletons get SMPL's frames for upper arms and thighs.

In SMPL's zero pose an elbow bends about the vertical axis and a knee about the lateral one. Skeletons of
other sources differ from this by a constant rotation about the length of the upper bone (CMU's elbows by
30 deg). The motion itself reveals it: the hinge is the axis about which the joint bends.
"""

from __future__ import annotations

from collections.abc import Sequence

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


def hinge_rotations(motions: Sequence[Motion]) -> Array:
    """Return the right factors (24, 3, 3) that bring an actor's elbows and knees to SMPL's hinges.

    They rotate upper arms and thighs about their own length. A joint that does not bend, or not as a hinge,
    keeps its frame.

    Args:
        motions: takes of one skeleton.
    """
    result = np.tile(np.eye(3), (24, 1, 1))
    for upper, (lower, length, hinge) in _HINGES.items():
        axes = np.concatenate([np.zeros((0, 3)), *(_bend_axes(m, upper, lower, length) for m in motions)])
        if len(axes) < LEAST_FRAMES:
            continue
        moments, directions = np.linalg.eigh(axes.T @ axes / len(axes))
        if moments[-1] < LEAST_AGREEMENT:
            continue
        axis = directions[:, -1] * np.sign(directions[:, -1] @ axes.sum(axis=0))
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
