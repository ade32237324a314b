"""Poses from BVH files with SMPL's joints, in a world with the axes of T."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import FileFormatError
from edgepose.formats.bvh import salvage_bvh
from edgepose.formats.joint_tree import JointTree
from edgepose.formats.poses.base import PoseFormat, all_new
from edgepose.pose import PoseSequence
from edgepose.skeleton import JOINTS, PARENTS, standing_pelvis_position

Array = NDArray[np.float64]

_LIMBS = {
    "left_knee": (0, -1, 0),
    "right_knee": (0, -1, 0),
    "left_elbow": (1, 0, 0),
    "right_elbow": (-1, 0, 0),
}
"""Joints at the far ends of limbs, and the directions of the limbs in the T-pose."""

_SAME_POSITION_M = 1e-5  # BVH has four decimals of a centimetre


def read_bvh(path: Path) -> tuple[PoseSequence, str | None]:
    """Read poses from a BVH file with SMPL's joints, whose world has the axes of T."""
    tree, problem = salvage_bvh(path)
    indices = _smpl_joints(path, tree)
    count = len(tree.rotations)
    rotations = np.broadcast_to(np.eye(3), (count, len(JOINTS), 3, 3)).copy()
    metres = _metres(tree.offsets[indices["left_ankle"]])
    offsets = np.zeros((len(JOINTS), 3))
    for joint, name in enumerate(JOINTS):
        if name in indices:
            rotations[:, joint] = tree.rotations[:, indices[name]]
            offsets[joint] = metres * tree.offsets[indices[name]]
    positions = metres * tree.positions[:, 0]
    # `BvhSink` writes this position if the translation is unknown.
    known = np.abs(positions - standing_pelvis_position(offsets)).max() > _SAME_POSITION_M
    times = np.arange(count) / tree.rate
    translation = positions if known else None
    poses = PoseSequence(np.arange(count), times, rotations, translation, *all_new(count))
    return poses, problem


def _smpl_joints(path: Path, tree: JointTree) -> dict[str, int]:
    """Return the indices of SMPL's joints in a tree by name; hands may be missing, case does not matter.

    Raises:
        FileFormatError: it has other joints, or its rest pose is not the T-pose.
    """
    indices = {name.lower(): index for index, name in enumerate(tree.names)}
    missing = [name for name in JOINTS[:22] if name not in indices]
    if missing:
        more = " ..." if len(missing) > 3 else ""
        raise FileFormatError(f"{path}: its joints are not SMPL's: no {', '.join(missing[:3])}{more}")
    for joint, parent in enumerate(PARENTS):
        if (index := indices.get(JOINTS[joint])) is not None:
            wanted = -1 if parent < 0 else indices[JOINTS[parent]]
            if tree.parents[index] != wanted:
                raise FileFormatError(f"{path}: its joint {JOINTS[joint]} does not have SMPL's parent")
    for name, direction in _LIMBS.items():
        offset = tree.offsets[indices[name]]
        if not offset @ direction > 0.7 * np.linalg.norm(offset):
            raise FileFormatError(
                f"{path}: where all angles are zero, its {name} is not where a T-pose has it (Y up, facing Z)"
            )
    return indices


def _metres(shank: Array) -> float:
    """Return the unit in metres, judged by a shank (3,): BVH names none; m, cm and mm are common."""
    length = max(float(np.linalg.norm(shank)), 1e-9)
    return min((1.0, 0.01, 0.001), key=lambda metres: abs(np.log(length * metres / 0.4)))


FORMAT = PoseFormat((".bvh",), read_bvh)
