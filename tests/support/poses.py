"""Poses that tests send to outputs."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from edgepose.pose import PoseFrame
from edgepose.skeleton import JOINTS


def pose(index: int = 0, where: np.ndarray | None = None, **turns: tuple[str, float]) -> PoseFrame:
    """A T-pose in which some joints are turned about an axis, degrees."""
    rotations = np.tile(np.eye(3, dtype=np.float32), (24, 1, 1))
    for joint, (axis, angle) in turns.items():
        rotations[JOINTS.index(joint)] = Rotation.from_euler(axis, angle, degrees=True).as_matrix()
    return PoseFrame(index, 1.7e9 + index / 60, rotations, np.zeros(24, np.float32), where)


def anything(index: int) -> PoseFrame:
    """A pose with random rotations anywhere; always the same for an index."""
    rotations = Rotation.random(24, random_state=index).as_matrix().astype(np.float32)
    where = np.random.default_rng(index).normal(size=3)
    return PoseFrame(index, 1.7e9 + index / 60, rotations, np.zeros(24, np.float32), where)
