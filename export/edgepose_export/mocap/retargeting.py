"""Retargeting from the skeletons of the motion-capture sources to the 24 SMPL joints.

A bone's rotation is taken relative to the source's T-pose, and its limb direction is kept exactly:

    G_smpl = G_src inv(G0) minrot(SMPL rest direction -> source T-pose direction)

`G_src` is the source bone's global rotation, `G0` the same in the source's T-pose. In the T-pose the SMPL
bone thus points in the source's direction instead of its rest direction (the arms of CMU's T-pose hang by
8 deg), and both point the same way in every pose. All other bones (trunk, neck, head, collars, feet) are the
identity in the source's T-pose, because a wearer's trunk is calibrated to the identity when they stand
straight, whatever the slope of the line between two vertebrae.

A sensor near the wrist measures the rotation of a forearm about its own axis, wherever a source has it: CMU's
forearms do not rotate about their axis, the next joint does; some of Bandai-Namco's takes rotate the forearm,
some the hand. So the rotation of the hand about the forearm's axis is added to the forearm's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose.formats.joint_tree import JointTree, forward
from edgepose.rotations import (
    matrix_to_quat,
    minimal_rotation,
    quat_to_matrix,
    slerp,
    transpose,
)

from .motion import Motion
from .rest_pose import REST_DIRECTIONS, RestPose, limb_directions, to_y_up
from .skeleton_roles import Roles, Side
from .skeleton_size import leg_length

Array = NDArray[np.float64]

_FOREARM_OF = {20: 18, 21: 19, 22: 18, 23: 19}  # wrists and hands stay at rest against the forearms

_SPINE_SHARES = (0.3, 0.51)
"""Middles of SMPL's two lower spine bones, as shares of the way from pelvis to neck."""


class Source(NamedTuple):
    """Motion of a skeleton that is understood."""

    tree: JointTree
    """The motion."""
    roles: Roles
    rest: RestPose
    """The T-pose."""
    up: Array
    """(3,) axis of the motion's world that points up."""
    metre: float
    """Metres in one unit of length."""
    name: str
    """Origin, see `Motion`."""


def retarget(source: Source) -> Motion:
    """Transfer a motion to SMPL's joints."""
    tree, roles, rest, up, metre, name = source
    rotations, positions = forward(tree)
    axes = to_y_up(up)

    def since_rest(joint: int) -> Array:
        return np.asarray(axes @ rotations[:, joint] @ transpose(rest.rotations[joint]))

    ends = limb_directions(rest, roles)
    picked = np.empty((len(rotations), 24, 3, 3))
    picked[:, 0] = since_rest(roles.pelvis)
    spine = [since_rest(joint) for joint in roles.spine]
    picked[:, 9] = spine[-1]
    picked[:, 3], picked[:, 6] = _lower_spine(spine, _spine_middles(rest, roles))
    picked[:, 15] = since_rest(roles.head)
    picked[:, 12] = _between(spine[-1], picked[:, 15], 0.5) if roles.neck is None else since_rest(roles.neck)
    for side, joints in enumerate((roles.left, roles.right)):
        _fill_side(picked, side, joints, since_rest, ends[18 + side])
    for joint, forearm in _FOREARM_OF.items():
        picked[:, joint] = picked[:, forearm]
    return Motion(
        to_smpl(picked, np.tile(np.eye(3), (24, 1, 1)), ends),
        metre * positions[:, roles.pelvis] @ axes.T,
        tree.rate,
        name,
        metre * leg_length(rest, roles),
    )


def _fill_side(
    picked: Array, side: int, joints: Side, since_rest: Callable[[int], Array], forearm_axis: Array
) -> None:
    """Fill the joints of one side, 0 left, 1 right, of rotations (T, 24, 3, 3) since the T-pose."""
    picked[:, 1 + side] = since_rest(joints.thigh)
    picked[:, 4 + side] = since_rest(joints.shank)
    picked[:, 7 + side] = since_rest(joints.foot)
    picked[:, 10 + side] = picked[:, 7 + side] if joints.toes is None else since_rest(joints.toes)
    picked[:, 13 + side] = picked[:, 9] if joints.collar is None else since_rest(joints.collar)
    picked[:, 16 + side] = since_rest(joints.upper_arm)
    forearm = since_rest(joints.forearm)
    in_forearm = transpose(forearm) @ since_rest(joints.hand)
    picked[:, 18 + side] = forearm @ _twist(in_forearm, forearm_axis)


def _twist(rotations: Array, axis: Array) -> Array:
    """Return the part about an axis (3,) of rotations (T, 3, 3)."""
    quats = matrix_to_quat(rotations)
    quats[:, 1:] = (quats[:, 1:] @ axis)[:, None] * axis
    norms = np.linalg.norm(quats, axis=-1, keepdims=True)
    return quat_to_matrix(np.where(norms > 1e-9, quats / np.maximum(norms, 1e-9), np.eye(4)[0]))


def _spine_middles(rest: RestPose, roles: Roles) -> Array:
    """Return the middle of each spine bone as share of the way along the spine from pelvis to neck."""
    above = roles.head if roles.neck is None else roles.neck
    points = rest.positions[[roles.pelvis, *roles.spine, above]]
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    along /= along[-1]
    return np.asarray((along[1:-1] + along[2:]) / 2)


def _lower_spine(spine: Sequence[Array], middles: Array) -> tuple[Array, Array]:
    """Return rotations (T, 3, 3) of SMPL's two lower spine bones from those of a spine, the chest last."""
    if len(spine) <= 3:
        return spine[0], spine[-2] if len(spine) == 3 else spine[-1]
    pair = []
    for share in _SPINE_SHARES:
        upper = int(np.clip(np.searchsorted(middles, share), 1, len(spine) - 1))
        low, high = middles[upper - 1], middles[upper]
        part = float(np.clip((share - low) / max(high - low, 1e-9), 0.0, 1.0))
        pair.append(_between(spine[upper - 1], spine[upper], part))
    return pair[0], pair[1]


def _between(start: Array, end: Array, share: float) -> Array:
    """Return rotations (T, 3, 3) on the shortest way from `start` (share 0) to `end` (share 1)."""
    return quat_to_matrix(slerp(matrix_to_quat(start), matrix_to_quat(end), np.full(len(start), share)))


def to_smpl(rotations: Array, t_pose: Array, ends: dict[int, Array]) -> Array:
    """Convert global rotations of a source to global SMPL rotations.

    Args:
        rotations: (T, 24, 3, 3) global rotation of each SMPL joint's source joint.
        t_pose: (24, 3, 3) the same in the source's T-pose.
        ends: unit direction (3,) of each limb bone (`REST_DIRECTIONS`) in the source's T-pose.

    Returns:
        (T, 24, 3, 3) rotations that take the SMPL rest direction of each limb to its direction in the source.
    """
    correction = transpose(t_pose)
    for limb, direction in REST_DIRECTIONS.items():
        correction[limb] = correction[limb] @ minimal_rotation(direction, ends[limb])
    result = rotations @ correction
    for joint, forearm in _FOREARM_OF.items():
        result[:, joint] = result[:, forearm]
    return result
