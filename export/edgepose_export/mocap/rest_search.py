"""The T-pose of a BVH file: in the file, in a file beside it, or known."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError
from edgepose.formats.bvh import read_bvh
from edgepose.formats.joint_tree import JointTree
from edgepose.rotations import geodesic_angle, transpose

from .known_t_poses import bandai_t_pose, cmu_t_pose, is_bandai, is_cmu
from .rest_pose import RestPose, deviation_deg, is_exact, limb_directions, near_rest, rest_fault, standing
from .skeleton_roles import Roles

Array = NDArray[np.float64]

_CLEARLY_BETTER_DEG = 5.0
_SAME_LIMB, _SAME_OTHER = 0.02, 0.1
"""Largest differences of a joint's offset in two files, as shares of the longest; limbs show the axes."""


class Rest(NamedTuple):
    """Rest pose of a take, and the frame at which its motion starts."""

    pose: RestPose
    start: int


def is_t_pose_file(path: Path) -> bool:
    """Return whether a file is the T-pose of the BVH files beside it, by its name."""
    return path.suffix.lower() == ".bvh" and path.stem.lower().replace("-", "_").startswith(
        ("t_pose", "tpose")
    )


def find_rest(path: Path, tree: JointTree, roles: Roles, t_pose: Path | None = None) -> Rest:
    """Return the T-pose of a file.

    In this order: the given file; what is known of Bandai-Namco's skeleton; a file beside (`t_pose*.bvh`)
    with the same skeleton; frame 0; what is known of CMU's; the zero pose, where all angles are zero. Frame 0
    is the T-pose if it is one as programs write it, and clearly closer to SMPL's than the zero pose. Then it
    is no motion, nor is a frame 0 that is the zero pose.

    Raises:
        EdgeposeError: no T-pose; the message says what to give.
    """
    if t_pose is not None:
        return Rest(_from_file(t_pose, tree, roles), 0)
    if is_bandai(tree.names):
        # Both datasets share one skeleton; the zero of the collars differs, which only the name reveals.
        pose = _from_global(tree, roles, bandai_t_pose(tree.names, not path.name.startswith("dataset-1_")))
        if pose is None or not near_rest(limb_directions(pose, roles)):
            raise EdgeposeError("the limbs do not lie as in Bandai-Namco's skeleton")
        return Rest(pose, 0)
    beside, misfits = _beside(path, tree, roles)
    return _within(tree, roles, misfits) if beside is None else Rest(beside, 0)


def _within(tree: JointTree, roles: Roles, misfits: list[str]) -> Rest:
    """Return the T-pose in the file itself; `misfits`: faults of files beside."""
    zero = standing(tree, roles, np.tile(np.eye(3), (len(tree.names), 1, 1)))
    first = standing(tree, roles, tree.rotations[0])
    fault = "left and right coincide" if zero is None else rest_fault(zero, roles, tree.names)
    if first is not None and is_exact(first, roles):
        better_deg = _deviation_deg(zero, roles) - _deviation_deg(first, roles)
        if fault or better_deg > _CLEARLY_BETTER_DEG:
            return Rest(first, _first_filled(tree))
    if is_cmu(tree.names):
        known = standing(tree, roles, cmu_t_pose(tree.names))
        if known is not None and near_rest(limb_directions(known, roles)):
            return Rest(known, 0)
    if zero is None or fault:
        raise EdgeposeError(
            f"no T-pose: where all angles are zero, {fault}; frame 0 is not the T-pose"
            f"{''.join(f'; {misfit}' for misfit in misfits)}; give --t-pose FILE, a BVH file of the same "
            "skeleton with a T-pose in it"
        )
    at_zero = geodesic_angle(tree.rotations[0, 1:], np.eye(3)).max(initial=0.0) < 1e-6
    return Rest(zero, _first_filled(tree) if at_zero and len(tree.rotations) > 1 else 0)


def _first_filled(tree: JointTree) -> int:
    """Return the first frame after frame 0, a T-pose, that is not all zero.

    In two takes of CMU's (07_12, 09_10) frames that are all zero follow the T-pose.
    """
    filled = (tree.rotations != np.eye(3)).any(axis=(1, 2, 3)) | tree.positions[:, 0].any(axis=1)
    filled[0] = False
    return int(np.argmax(filled)) if filled.any() else len(filled)


def _beside(path: Path, tree: JointTree, roles: Roles) -> tuple[RestPose | None, list[str]]:
    """Return the T-pose in a file beside a file, None if there is none, and why other files are of no use."""
    poses, misfits = [], []
    try:
        files = sorted(filter(is_t_pose_file, path.parent.iterdir()))
    except OSError:  # a folder that may not be listed
        files = []
    for file in files:
        try:
            poses.append(_from_file(file, tree, roles))
        except EdgeposeError as error:
            misfits.append(str(error))
    return min(poses, key=lambda pose: _deviation_deg(pose, roles), default=None), misfits


def _from_file(path: Path, tree: JointTree, roles: Roles) -> RestPose:
    """Return the T-pose in another file of the same skeleton: its frame that is closest to SMPL's.

    Raises:
        EdgeposeError: it cannot be read, has another skeleton, or contains no T-pose.
    """
    other = read_bvh(path)
    order = _same_joints(path, tree, other, roles)
    poses = [standing(tree, roles, local) for local in other.rotations[:, order]]
    best = min(poses, key=lambda pose: _deviation_deg(pose, roles))
    fault = "left and right coincide" if best is None else rest_fault(best, roles, tree.names)
    if best is None or fault:
        raise EdgeposeError(f"{path} contains no T-pose: at best {fault}")
    return best


def _deviation_deg(pose: RestPose | None, roles: Roles) -> float:
    return np.inf if pose is None else deviation_deg(limb_directions(pose, roles))


def _same_joints(path: Path, tree: JointTree, other: JointTree, roles: Roles) -> list[int]:
    """Return the index in another skeleton of each joint of a skeleton.

    Raises:
        EdgeposeError: a joint that matters is missing, or has another parent or offset.
    """
    size = np.linalg.norm(tree.offsets[1:], axis=1).max()
    ends = {end for _, end in roles.limbs.values()}
    for joint, name in enumerate(tree.names):
        if name not in other.names:
            raise EdgeposeError(f"{path} has another skeleton: no joint {name}")
        twin = other.names.index(name)
        parent, twins_parent = tree.parents[joint], other.parents[twin]
        if parent < 0 and twins_parent < 0:
            continue
        if min(parent, twins_parent) < 0 or tree.names[parent] != other.names[twins_parent]:
            raise EdgeposeError(f"{path} has another skeleton: joint {name} has another parent")
        share = _SAME_LIMB if joint in ends else _SAME_OTHER
        if np.linalg.norm(tree.offsets[joint] - other.offsets[twin]) > share * size:
            raise EdgeposeError(f"{path} has another skeleton: joint {name} has another offset")
    return [other.names.index(name) for name in tree.names]


def _from_global(tree: JointTree, roles: Roles, rotations: Array) -> RestPose | None:
    """Return the pose with global rotations (J, 3, 3)."""
    parents = list(tree.parents)
    local = transpose(rotations[parents]) @ rotations
    local[0] = rotations[0]
    return standing(tree, roles, local)
