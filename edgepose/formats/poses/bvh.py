"""Poses from BVH files with SMPL's joints under any of their names, in a world with any axes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import FileFormatError
from edgepose.formats.bvh import salvage_bvh
from edgepose.formats.bvh_names import BVH_NAMES, find_joints, missing_joints
from edgepose.formats.joint_tree import JointTree
from edgepose.formats.poses.base import PoseFormat, all_new
from edgepose.pose import PoseSequence
from edgepose.skeleton import JOINTS, PARENTS, grounded_pelvis_position, local_from_global

Array = NDArray[np.float64]

UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
"""Units of length in metres."""

_SHANKS_M = {"m": (0.16, 0.58), "cm": (0.16, 0.58), "mm": (0.16, 0.58), "dm": (0.3, 0.52), "in": (0.3, 0.52)}
"""Plausible lengths of a shank: a child's to a giant's in usual units, an adult's in others."""

_LIMBS = {
    "left_knee": (0, -1, 0),
    "right_knee": (0, -1, 0),
    "left_elbow": (1, 0, 0),
    "right_elbow": (-1, 0, 0),
}
"""Joints at the far ends of limbs, and the directions of the limbs in the T-pose."""

_STRAIGHT = 0.9
"""Cosine of the largest angle, 25 degrees, between a limb and its direction in the T-pose."""

_SAME_POSITION_M = 1e-4  # angles have four decimals of a degree


def read_bvh(path: Path, unit: str | None = None) -> tuple[PoseSequence, str | None]:
    """Read poses from a BVH file.

    The directions of the body in its zero pose show which axes its world has. The length of its shanks shows
    the unit, unless that is given as a key of `UNITS`.

    Raises:
        FileFormatError: not BVH, other joints, no T-pose, or a unit that is not clear.
    """
    tree, problem = salvage_bvh(path)
    indices = _smpl_joints(path, tree)
    offsets = _rest_offsets(tree, indices)
    axes = _axes(path, offsets)
    offsets = offsets @ axes.T
    _check_zero_pose(path, offsets)
    metres = _metres(path, offsets[JOINTS.index("left_ankle")], unit)
    rotations, positions = _pose(tree, indices)
    rotations = axes @ local_from_global(rotations) @ axes.T
    rotations[:, [joint for joint in range(len(JOINTS)) if joint not in indices]] = np.eye(3)
    positions = metres * positions @ axes.T
    # `BvhSink` writes this position if the translation is unknown.
    known = np.abs(positions - grounded_pelvis_position(rotations, metres * offsets)).max() > _SAME_POSITION_M
    count = len(positions)
    times = np.arange(count) / tree.rate
    translation = positions if known else None
    return PoseSequence(np.arange(count), times, rotations, translation, *all_new(count)), problem


def _smpl_joints(path: Path, tree: JointTree) -> dict[int, int]:
    """Return the index in a tree of each of SMPL's joints; hands may be missing.

    Raises:
        FileFormatError: it has other joints, or they are connected in another way.
    """
    indices = find_joints(tree.names)
    if indices is None:
        missing = missing_joints(tree.names)
        more = " ..." if len(missing) > 3 else ""
        raise FileFormatError(
            f"{path}: its joints are not SMPL's: no {', '.join(missing[:3])}{more}; other names read "
            f"are those of {', '.join(list(BVH_NAMES)[1:])}"
        )
    joints = {index: joint for joint, index in indices.items()}
    for index, joint in joints.items():
        above = tree.parents[index]
        while above >= 0 and above not in joints:
            above = tree.parents[above]
        if joints.get(above, -1) != PARENTS[joint]:
            raise FileFormatError(f"{path}: its joint {tree.names[index]} does not have SMPL's parent")
    return indices


def _rest_offsets(tree: JointTree, indices: dict[int, int]) -> Array:
    """Return joint positions (24, 3) minus their parents' in the zero pose; 0 for missing joints."""
    rest = tree.offsets.copy()
    for index, parent in enumerate(tree.parents):
        rest[index] += rest[parent] if parent >= 0 else 0.0
    offsets = np.zeros((len(JOINTS), 3))
    for joint, index in indices.items():
        if joint:
            offsets[joint] = rest[index] - rest[indices[PARENTS[joint]]]
    return offsets


def _axes(path: Path, offsets: Array) -> Array:
    """Return the rotation (3, 3) from the file's world to T, given offsets (24, 3).

    Raises:
        FileFormatError: in the zero pose, the body does not stand along the axes.
    """
    left = offsets[JOINTS.index("left_hip")] - offsets[JOINTS.index("right_hip")]
    up = sum(offsets[JOINTS.index(name)] for name in ("spine1", "spine2", "spine3", "neck"))
    rows = []
    for direction in (left, np.asarray(up)):
        axis = int(np.abs(direction).argmax())
        if not abs(direction[axis]) > _STRAIGHT * np.linalg.norm(direction):
            break
        rows.append(np.sign(direction[axis]) * np.eye(3)[axis])
    if len(rows) < 2 or rows[0] @ rows[1]:
        raise FileFormatError(
            f"{path}: where all angles are zero, its body does not stand upright along an axis of its world"
        )
    return np.stack([*rows, np.cross(*rows)])


def _check_zero_pose(path: Path, offsets: Array) -> None:
    """Raise FileFormatError unless offsets (24, 3), with the axes of T, are those of a T-pose."""
    for name, direction in _LIMBS.items():
        offset = offsets[JOINTS.index(name)]
        if not offset @ direction > _STRAIGHT * np.linalg.norm(offset):
            raise FileFormatError(
                f"{path}: where all angles are zero, its {name} is not where a T-pose has it; export it with "
                "the T-pose as rest pose"
            )
    if offsets[JOINTS.index("left_foot")][2] <= 0.0:
        raise FileFormatError(
            f"{path}: where all angles are zero, its toes point backwards; left and right are exchanged, or "
            "an axis is mirrored"
        )


def _metres(path: Path, shank: Array, unit: str | None) -> float:
    """Return the unit in metres, as given, or judged by a shank (3,) in this unit: BVH names none.

    Raises:
        FileFormatError: no unit, or more than one, gives a shank of plausible length.
    """
    if unit is not None:
        return UNITS[unit]
    length = float(np.linalg.norm(shank))
    fits = [name for name, (least, most) in _SHANKS_M.items() if least <= UNITS[name] * length <= most]
    if len(fits) != 1:
        why = f"{' and '.join(fits)} are possible" if fits else "that is no shank in m, cm, mm, dm or in"
        raise FileFormatError(
            f"{path}: its unit is not clear: its shanks are {length:.3g} long, {why}; "
            f"give convert --unit {'|'.join(UNITS)}"
        )
    return UNITS[fits[0]]


def _pose(tree: JointTree, indices: dict[int, int]) -> tuple[Array, Array]:
    """Return global rotations (T, 24, 3, 3) of SMPL's joints and positions (T, 3) of the pelvis.

    Other joints between them, or above the pelvis, are followed; missing hands turn with their parents.
    """
    needed = set[int]()
    for index in indices.values():
        while index >= 0 and index not in needed:
            needed.add(index)
            index = tree.parents[index]
    world: dict[int, Array] = {}
    position = np.zeros((len(tree.rotations), 3))
    pelvis = indices[0]
    for index in sorted(needed):
        parent = tree.parents[index]
        world[index] = tree.rotations[:, index] if parent < 0 else world[parent] @ tree.rotations[:, index]
        if index <= pelvis:  # the pelvis, and all that is above it
            moved = tree.positions[:, index, :, None]
            position += (moved if parent < 0 else world[parent] @ moved)[..., 0]
    rotations = [
        world[indices[joint if joint in indices else PARENTS[joint]]] for joint in range(len(JOINTS))
    ]
    return np.stack(rotations, axis=1), position


FORMAT = PoseFormat((".bvh",), read_bvh, read_in=read_bvh)
