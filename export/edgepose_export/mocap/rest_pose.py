"""A skeleton's T-pose: whether a pose is one, and which way it faces."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose.formats.joint_tree import JointTree, forward
from edgepose.rotations import minimal_rotation, rotation_about_axis

from .skeleton_roles import Roles

Array = NDArray[np.float64]

REST_DIRECTIONS = {
    joint: np.array(direction)
    for joints, direction in (
        ((1, 2, 4, 5), (0.0, -1.0, 0.0)),
        ((16, 18), (1.0, 0.0, 0.0)),
        ((17, 19), (-1.0, 0.0, 0.0)),
    )
    for joint in joints
}
"""Direction of each limb bone in SMPL's zero pose, without the slight tilts of the template."""

STRAIGHT_DEG = 20.0
"""Largest angle between a limb of a T-pose and SMPL's."""

_LEGS_DEG, _ELBOW_DEG, _ARM_FORWARD_DEG = 30.0, 40.0, 30.0
_SQUARE_DEG = 10.0  # smaller differences between body and axes are those of two sides of a body


class RestPose(NamedTuple):
    """A skeleton that stands upright and faces +Z, in the unit of its file."""

    rotations: Array
    """(J, 3, 3) global rotation of each joint."""
    positions: Array
    """(J, 3) position of each joint."""
    up: Array
    """(3,) the axis of the file's world that was up in this pose."""


def standing(tree: JointTree, roles: Roles, local: Array) -> RestPose | None:
    """Return the pose with local rotations (J, 3, 3) of a skeleton, brought upright, facing +Z.

    Up is the axis along which the head is farthest above the feet. The result is None if the joints of both
    sides coincide, so that there is no left and right.
    """
    posed = forward(tree._replace(rotations=local[None], positions=tree.offsets[None]))
    rotations, positions = posed[0][0], posed[1][0]
    up = nearest_axis(body_up(positions[None], roles)[0])
    axes = to_y_up(up)
    left = sum(
        positions[getattr(roles.left, role)] - positions[getattr(roles.right, role)]
        for role in ("thigh", "upper_arm")
    )
    left = axes @ np.asarray(left)
    if not np.hypot(left[0], left[2]) > 1e-3 * np.abs(positions - positions[roles.pelvis]).max():
        return None
    heading = float(np.arctan2(-left[2], left[0]))
    square = np.round(heading / (np.pi / 2)) * (np.pi / 2)
    if abs(heading - square) < np.radians(_SQUARE_DEG):
        heading = float(square)
    if heading:
        axes = rotation_about_axis("y", -heading) @ axes
    return RestPose(axes @ rotations, positions @ axes.T, up)


def nearest_axis(direction: Array) -> Array:
    """Return the axis (3,), with its sign, that is nearest to a direction (3,)."""
    largest = int(np.abs(direction).argmax())
    return np.asarray(np.sign(direction[largest]) * np.eye(3)[largest])


def body_up(positions: Array, roles: Roles) -> Array:
    """Return unit directions (T, 3) from the ankles to the head for joint positions (T, J, 3)."""
    feet = positions[:, [roles.left.foot, roles.right.foot]].mean(axis=1)
    up = positions[:, roles.head] - feet
    return np.asarray(up / np.maximum(np.linalg.norm(up, axis=-1, keepdims=True), 1e-12))


def to_y_up(up: Array) -> Array:
    """Return the rotation (3, 3) from a world whose axis `up` (3,) points up to one with Y up."""
    if up[1] < -0.5:
        return rotation_about_axis("x", np.pi)
    return np.round(minimal_rotation(up, np.array([0.0, 1.0, 0.0])))


def limb_directions(rest: RestPose, roles: Roles) -> dict[int, Array]:
    """Return the unit direction (3,) of each limb bone in a rest pose, by SMPL joint."""
    return {
        limb: _unit(rest.positions[end] - rest.positions[start]) for limb, (start, end) in roles.limbs.items()
    }


def deviation_deg(ends: dict[int, Array]) -> float:
    """Return the largest angle between limbs and their directions in SMPL's zero pose."""
    return max(_angle_deg(ends[limb], direction) for limb, direction in REST_DIRECTIONS.items())


def near_rest(ends: dict[int, Array]) -> bool:
    """Return whether all limbs lie within 20 deg of their directions in SMPL's zero pose."""
    return deviation_deg(ends) < STRAIGHT_DEG


def is_exact(rest: RestPose, roles: Roles) -> bool:
    """Return whether a pose is a T-pose as programs write it, upright and equal on both sides, within 3 deg.

    People who stand in one are less exact.
    """
    ends = limb_directions(rest, roles)
    mirror = np.array([-1.0, 1.0, 1.0])
    uneven = max(_angle_deg(ends[limb], mirror * ends[limb + 1]) for limb in (1, 4, 16, 18))
    lean = _angle_deg(body_up(rest.positions[None], roles)[0], np.array([0.0, 1.0, 0.0]))
    return near_rest(ends) and uneven < 3.0 and lean < 8.0


def rest_fault(rest: RestPose, roles: Roles, names: tuple[str, ...]) -> str | None:
    """Return why a pose is no rest pose, None if it is one: a T-pose, or one with lowered, straight arms."""
    ends = limb_directions(rest, roles)
    for limb, (start, end) in roles.limbs.items():
        bone = f"the bone from {names[start]} to {names[end]}"
        if limb in (1, 2, 4, 5):
            angle = _angle_deg(ends[limb], REST_DIRECTIONS[limb])
            if angle > _LEGS_DEG:
                return f"{bone} is {angle:.0f} deg from straight down"
        elif limb in (18, 19):
            angle = _angle_deg(ends[limb], ends[limb - 2])
            if angle > _ELBOW_DEG:
                return f"the elbow {names[start]} is bent by {angle:.0f} deg"
        else:
            outward = ends[limb] @ REST_DIRECTIONS[limb]
            raised = np.degrees(np.arcsin(np.clip(ends[limb][1], -1, 1)))
            ahead = np.degrees(np.arcsin(np.clip(abs(ends[limb][2]), 0, 1)))
            if raised > STRAIGHT_DEG or ahead > _ARM_FORWARD_DEG or outward < -0.2:
                return f"{bone} points neither sideways nor down"
    for side in (roles.left, roles.right):
        if side.toes is not None:
            foot = rest.positions[side.toes] - rest.positions[side.foot]
            if foot[2] < -0.3 * float(np.linalg.norm(foot)):
                return f"{names[side.toes]} points backwards (left and right exchanged, or an axis mirrored)"
    return None


def _angle_deg(u: Array, v: Array) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(u, v)), u @ v)))


def _unit(v: Array) -> Array:
    return np.asarray(v / max(float(np.linalg.norm(v)), 1e-12))
