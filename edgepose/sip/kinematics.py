"""Positions and orientations of sensors on a posed body, and their derivatives by the pose.

A pose is 24 x 3 exponential coordinates, each joint against its parent, joint 0 against the body frame T. The
pelvis stays at the origin; `edgepose.sip.translation` estimates the translation afterwards.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.skeleton import PARENTS, forward_kinematics

Array = NDArray[np.float64]

JOINT_COUNT = len(PARENTS)


def _ancestors() -> NDArray[np.bool_]:
    """Return (24, 24) bool: whether joint j rotates bone b, at [b, j]."""
    mask = np.eye(JOINT_COUNT, dtype=bool)
    for joint, parent in enumerate(PARENTS[1:], start=1):
        mask[joint] |= mask[parent]
    return mask


TURNS = _ancestors()
"""Whether joint j rotates bone b, at [b, j]: j is b or lies between b and the pelvis."""


class SensorPoints(NamedTuple):
    """Positions of sensors on a body.

    Attributes:
        offsets: (24, 3) joint position minus its parent's in the zero pose, metres; row 0 is zero.
        bones: (N,) SMPL joint of each sensor's bone.
        points: (N, 3) sensor position minus that joint's, in the bone's frame, metres.
    """

    offsets: Array
    bones: NDArray[np.int_]
    points: Array


class SensorStates(NamedTuple):
    """Sensors of a posed body.

    Attributes:
        orientation: (T, N, 3, 3) R_TB of the bones that carry sensors.
        position: (T, N, 3) sensors, from the pelvis, metres.
        joints: (T, 24, 3) positions of joints from the pelvis, metres.
        axes: (T, 24, 3, 3) rotation in T, rad, per change of each joint's exponential coordinates.
        bones: (T, 24, 3, 3) R_TB of all bones.
    """

    orientation: Array
    position: Array
    joints: Array
    axes: Array
    bones: Array


def pose_sensors(angles: Array, body: SensorPoints) -> SensorStates:
    """Compute the sensors of a body in poses (T, 24, 3) of exponential coordinates (SIP eq. 5, 15)."""
    rotations, joints = forward_kinematics(rot.rotvec_to_matrix(angles), body.offsets)
    axes = rot.left_jacobian(angles)
    # A joint's axes rotate with its parent; the pelvis has none.
    axes[:, 1:] = rotations[:, list(PARENTS[1:])] @ axes[:, 1:]
    carrying = rotations[:, body.bones]
    position = joints[:, body.bones] + (carrying @ body.points[..., None])[..., 0]
    return SensorStates(carrying, position, joints, axes, rotations)


def orientation_jacobian(posed: SensorStates, bones: NDArray[np.int_]) -> Array:
    """Return the rotation of bones (N,) in T per change of the pose: (T, N, 3, 24, 3), rad (SIP eq. 24)."""
    mask = TURNS[bones].astype(float)
    return np.moveaxis(posed.axes, 1, 2)[:, None] * mask[:, None, :, None]


def position_jacobian(posed: SensorStates, body: SensorPoints) -> Array:
    """Return each sensor's motion against the pelvis per change of the pose: (T, N, 3, 24, 3), m (eq. 27)."""
    mask = TURNS[body.bones].astype(float)
    levers = (posed.position[:, :, None] - posed.joints[:, None]) * mask[..., None]
    x, y, z = np.moveaxis(levers, -1, 0)[..., None]  # (T, N, 24, 1) each
    ax, ay, az = np.moveaxis(posed.axes, 2, 0)[:, :, None]  # (T, 1, 24, 3): components of all three axes
    return np.stack([ay * z - az * y, az * x - ax * z, ax * y - ay * x], axis=2)
