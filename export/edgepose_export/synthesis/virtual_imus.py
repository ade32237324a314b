"""Virtual IMUs on a body that moves as in motion capture (DIP 3.2)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.calibration import GRAVITY
from edgepose.placements import BONES, PLACEMENTS
from edgepose.skeleton import Body, forward_kinematics, local_from_global
from edgepose_export.mocap import Motion
from edgepose_export.mocap.straight_pose import straight_pose
from edgepose_export.synthesis.contacts import contacts, level_velocity

Array = NDArray[np.float64]

INERTIAL_FROM_BODY = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""R_IT of synthetic recordings: wearers who face +Z of T face +X of I, so `heading:0` is their body frame."""

BLEND_S = 1.0
"""Duration of the transition from a held pose to the first pose of the take, seconds."""


def with_hold(motion: Motion, seconds: float) -> Motion:
    """Put some seconds of standing straight before a take.

    The take is rotated so that it begins facing +Z of T, which is what `heading:0` calibrates. The pelvis
    stays at its position of the first frame. `BLEND_S` more seconds lead from the straight pose to the first
    frame's pose.
    """
    forward = motion.rotations[0, 0, :, 2]
    to_front = rot.rotation_about_axis("y", -np.arctan2(forward[0], forward[2]))
    rotations, translation = to_front @ motion.rotations, motion.translation @ to_front.T
    # A smooth start and end (smoothstep), so that the virtual accelerometers measure no jolt.
    t = np.linspace(0.0, 1.0, round(BLEND_S * motion.rate), endpoint=False)[:, None]
    first, last = rot.matrix_to_quat(straight_pose()), rot.matrix_to_quat(rotations[0])
    blend = rot.quat_to_matrix(rot.slerp(first, last, t * t * (3.0 - 2.0 * t)))
    hold = np.broadcast_to(straight_pose(), (round(seconds * motion.rate), 24, 3, 3))
    still = np.broadcast_to(translation[0], (len(hold) + len(blend), 3))
    return motion._replace(
        rotations=np.concatenate([hold, blend, rotations]), translation=np.concatenate([still, translation])
    )


def random_mounting(seed: int) -> Array:
    """Return R_BS (6, 3, 3) of sensors that are strapped on at random angles."""
    return rot.rotvec_to_matrix(np.random.default_rng(seed).uniform(-np.pi, np.pi, (6, 3)))


class VirtualImus(NamedTuple):
    """Measurements of six virtual sensors.

    Attributes:
        orientation: (T, 6, 4) unit quaternions, sensor to inertial (R_IS), in the order of PLACEMENTS.
        force: (T, 6, 3) specific force in the sensor frames, m/s^2.
        rate_of_turn: (T, 6, 3) angular rates in the sensor frames, rad/s.
        joints: (T, 24, 3) positions of the body's joints in T, metres.
    """

    orientation: Array
    force: Array
    rate_of_turn: Array
    joints: Array


def virtual_imus(
    motion: Motion, body: Body, mounting: Array | None = None, directions: Array | None = None
) -> VirtualImus:
    """Simulate sensors at the six sensor points on the body's skin.

    Accelerations are central differences over neighbouring frames, DIP eq. 3 with n = 1. The first and the
    last frame repeat those of their neighbours.

    Args:
        motion: motion at the sample rate of the sensors.
        body: body with the joints and sensor points to move.
        mounting: (6, 3, 3) R_BS, sensor frames in bone frames; None for sensors aligned with the bones.
        directions: (24, 3, 3) right factors to the frames by which the body moves, if these are not the
            frames that sensors are aligned with, see `mocap.zeroing.Zero`.

    Raises:
        ValueError: the motion has fewer than 3 frames.
    """
    if len(motion.rotations) < 3:
        raise ValueError("a take needs at least 3 frames for accelerations")
    moving = motion.rotations if directions is None else motion.rotations @ directions
    _, joints = forward_kinematics(local_from_global(moving), body.offsets, motion.translation)
    points = joints[:, list(BONES)] + np.einsum("tsij,sj->tsi", moving[:, list(BONES)], body.sensors)
    acceleration = (points[:-2] + points[2:] - 2.0 * points[1:-1]) * motion.rate**2
    acceleration = np.concatenate([acceleration[:1], acceleration, acceleration[-1:]])
    sensors = INERTIAL_FROM_BODY @ motion.rotations[:, list(BONES)]
    if mounting is not None:
        sensors = sensors @ mounting
    force_inertial = acceleration @ INERTIAL_FROM_BODY.T + [0.0, 0.0, GRAVITY]
    rates = rot.matrix_to_rotvec(rot.transpose(sensors[:-1]) @ sensors[1:]) * motion.rate
    # The rate at a frame is the mean of those before and after it.
    rates = np.concatenate([rates[:1], 0.5 * (rates[:-1] + rates[1:]), rates[-1:]])
    return VirtualImus(
        orientation=rot.quat_continuous(rot.matrix_to_quat(sensors)),
        force=np.einsum("tsji,tsj->tsi", sensors, force_inertial),
        rate_of_turn=rates,
        joints=joints,
    )


def recording_arrays(
    motion: Motion, imus: VirtualImus, license_note: str, source: str = "own", actor: str = "own"
) -> dict[str, NDArray]:
    """Return the arrays of an .npz file that is both an IMU recording and an AMASS-like motion file.

    It holds the sensors and the poses that they were made from, and contacts and velocities, see `contacts`.

    Args:
        motion: the motion.
        imus: what the sensors measure of it.
        license_note: licence of the motion.
        source: name of its source, see `training.sources`.
        actor: key of its actor.
    """
    arrays: dict[str, NDArray] = {"t": np.arange(len(motion.rotations)) / motion.rate}
    for i, name in enumerate(PLACEMENTS):
        arrays[f"{name}_quat"] = imus.orientation[:, i].astype(np.float32)
        arrays[f"{name}_acc"] = imus.force[:, i].astype(np.float32)
        arrays[f"{name}_gyr"] = imus.rate_of_turn[:, i].astype(np.float32)
    poses = rot.matrix_to_rotvec(local_from_global(motion.rotations))
    arrays["poses"] = poses.reshape(len(poses), 72).astype(np.float32)
    arrays["trans"] = motion.translation.astype(np.float32)
    arrays["contact"] = contacts(imus.joints, motion.rate)
    velocity = level_velocity(imus.joints[:, 0], motion.rotations[:, 0], motion.rate)
    arrays["velocity"] = velocity.astype(np.float32)
    arrays["mocap_framerate"] = np.array(motion.rate)
    arrays["source"] = np.array(source)
    arrays["actor"] = np.array(actor)
    arrays["license"] = np.array(license_note)
    return arrays
