"""Motion from BVH files of any program."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError
from edgepose.formats.bvh import read_bvh
from edgepose.formats.joint_tree import JointTree, forward

from .known_t_poses import is_bandai, is_cmu
from .mapping import Mapping
from .rest_pose import RestPose, body_up, nearest_axis, to_y_up
from .rest_search import find_rest
from .retargeting import Source
from .skeleton_roles import Roles, find_roles
from .skeleton_size import metres

Array = NDArray[np.float64]

RATES_HZ = (5.0, 2000.0)
"""Plausible frame rates of motion capture."""

_RIGID = 0.05
"""Largest change of a limb's length as a share of it."""

_SHORTEST = 0.02
"""Shortest limb, as a share of the longest bone."""

_UNEVEN = 1.5
"""Largest ratio of the lengths of a limb on both sides."""

_UPRIGHT = 0.9
"""Least length of the mean of unit vectors from feet to head of people who are on their feet all the time."""
_TRAVEL_LEGS, _FLOOR_LEGS = 0.7, 0.35


def read_any_bvh(path: Path, t_pose: Path | None = None, mapping: Mapping | None = None) -> Source:
    """Read the motion in a BVH file of a person.

    Args:
        path: the file.
        t_pose: a BVH file of the same skeleton with a T-pose in it; None searches, see `find_rest`.
        mapping: what is known about the skeleton.

    Raises:
        EdgeposeError: the file is broken, its skeleton is not understood, or is no person's.
    """
    tree = read_bvh(path)
    try:
        return _source(path, tree, t_pose, mapping or Mapping())
    except EdgeposeError as error:
        raise EdgeposeError(f"{path}: {error}") from None


def _source(path: Path, tree: JointTree, t_pose: Path | None, mapping: Mapping) -> Source:
    if not RATES_HZ[0] <= tree.rate <= RATES_HZ[1]:
        raise EdgeposeError(
            f"a frame rate of {tree.rate:.3g} Hz is not that of motion capture; correct 'Frame Time'"
        )
    roles = find_roles(tree.names, tree.parents, mapping.joints)
    tree = _rigid(tree, roles)
    rest, start = find_rest(path, tree, roles, t_pose)
    if start == len(tree.rotations):
        raise EdgeposeError("contains only the T-pose of frame 0, no motion")
    tree = tree._replace(rotations=tree.rotations[start:], positions=tree.positions[start:])
    metre = metres(rest, roles, mapping.unit)
    up = _motion_up(tree, roles, rest) if mapping.up is None else mapping.up
    return Source(tree, roles, rest, up, metre, _origin(tree.names))


def _origin(names: tuple[str, ...]) -> str:
    if is_cmu(names):
        return "cmu"
    return "bandai-namco" if is_bandai(names) else "bvh"


def _rigid(tree: JointTree, roles: Roles) -> JointTree:
    """Return a skeleton whose limbs keep their length.

    Some programs write a shift against the offset, always zero, to the position channels of all joints.

    Raises:
        EdgeposeError: a limb has no length, its position channels change it, or both sides differ.
    """
    positions = tree.positions
    shifts = np.abs(positions[:, 1:]).max(initial=0.0) < 1e-9 < np.abs(tree.offsets[1:]).max(initial=0.0)
    if shifts:
        positions = np.concatenate(
            [positions[:, :1], np.broadcast_to(tree.offsets[1:], positions[:, 1:].shape)], axis=1
        )
    tree = tree._replace(positions=positions)
    lengths = {limb: _limb_length(tree, *ends) for limb, ends in roles.limbs.items()}
    for limb, (start, end) in roles.limbs.items():
        other = lengths[limb - 1 if limb in (2, 5, 17, 19) else limb + 1]
        if lengths[limb] > _UNEVEN * other:
            raise EdgeposeError(
                f"the bone from {tree.names[start]} to {tree.names[end]} is {lengths[limb] / other:.3g} "
                "times as long as that of the other side"
            )
    return tree


def _limb_length(tree: JointTree, start: int, end: int) -> float:
    """Return the length of a bone; raise EdgeposeError if it is zero or changes, see `_rigid`."""
    path = _path(tree, start, end)
    length = float(np.linalg.norm(tree.offsets[path].sum(axis=0)))
    size = np.linalg.norm(tree.offsets[1:], axis=1).max(initial=0.0)
    for joint in path:
        change = np.linalg.norm(tree.positions[:, joint] - tree.offsets[joint], axis=1).max()
        if change > _RIGID * max(length, 1e-3 * size):
            raise EdgeposeError(
                f"the position channels of joint {tree.names[joint]} do not lie as in its OFFSET: a bone "
                "changes its length"
            )
    if length < _SHORTEST * size:
        raise EdgeposeError(f"the bone from {tree.names[start]} to {tree.names[end]} has no length")
    return length


def _path(tree: JointTree, top: int, bottom: int) -> list[int]:
    """Return the joints below `top` down to and with `bottom`."""
    path = [bottom]
    while tree.parents[path[-1]] != top:
        path.append(tree.parents[path[-1]])
    return path


def _motion_up(tree: JointTree, roles: Roles, rest: RestPose) -> Array:
    """Return the axis (3,) that is up in the motion: mostly that of the rest pose.

    Some programs write a zero pose with Y up and motion with Z up, and rotate the root in each frame. That
    looks like a person who lies all the time, so it counts only if the person travels on level feet.

    Raises:
        EdgeposeError: the motion has another up axis, or the person lies.
    """
    every = max(1, len(tree.rotations) // 200)
    sample = tree._replace(rotations=tree.rotations[::every], positions=tree.positions[::every])
    positions = forward(sample)[1]
    if np.ptp(positions, axis=0).max() == 0.0:
        return rest.up  # no motion
    mean = body_up(positions, roles).mean(axis=0)
    axis = nearest_axis(mean)
    if axis @ rest.up > 0.5 or mean @ axis < _UPRIGHT:
        return rest.up
    leg = np.linalg.norm(rest.positions[roles.left.foot] - rest.positions[roles.left.thigh])
    level = positions @ to_y_up(axis).T / leg
    feet = level[:, [roles.left.foot, roles.right.foot], 1].min(axis=1)
    travel = np.ptp(level[:, roles.pelvis][:, [0, 2]], axis=0).max()
    if travel > _TRAVEL_LEGS and np.ptp(feet) < _FLOOR_LEGS:
        return axis
    raise EdgeposeError(
        f"which way is up is not clear: the rest pose stands along {_name(rest.up)}, the motion along "
        f"{_name(axis)}; give `up` in --mapping FILE.toml"
    )


def _name(axis: Array) -> str:
    return ("-" if axis.sum() < 0 else "") + "XYZ"[int(np.abs(axis).argmax())]
