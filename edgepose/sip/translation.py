"""Path of the pelvis over a whole recording, from its acceleration, from contacts and from the ground.

Assumptions: what is in contact stands still; the wearer starts on the ground; the ground is level except for
steps, and without a network's contacts throughout.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.pose import CONTACTS
from edgepose.sip.ground import ankle_heights, grounded
from edgepose.sip.solve import Solution
from edgepose.skeleton import JOINTS, forward_kinematics, standing_pelvis_position

Array = NDArray[np.float64]

ACCELERATION_ERROR = 1.0
"""Spread (m/s^2) of errors of the pelvis acceleration that last for a second: bias, scale, tilt, poses."""

SLIP = 0.3
"""Spread (m/s) of the speed of a joint in contact, in the estimated poses."""

VELOCITY_ERROR = 2.0
"""Spread (m/s) of errors of the network's velocity that last for a second."""

FLIGHT = -4.0
"""Vertical acceleration (m/s^2) below which no foot supports the wearer; free fall is -9.81."""

_HINT = 0.1  # weight of the lower ankle where a network estimates contacts
_FLYING = 1e-3  # weight of the lower foot in flight
_ROUNDS = 6  # of reweighting
_POINTS = [JOINTS.index(name) for name in CONTACTS]
_TOES = [CONTACTS.index("left_foot"), CONTACTS.index("right_foot")]
_ANKLES = [CONTACTS.index("left_ankle"), CONTACTS.index("right_ankle")]


class Support(NamedTuple):
    """What is known of the velocity between frames, apart from accelerations.

    Attributes:
        weight: (T - 1, K) of the assumption that each of K points stands still, s^2/m^2.
        velocity: (T - 1, K, 3) of the pelvis under this assumption, m/s.
        free_weight: weight of `free`, s^2/m^2.
        free: (T - 1, 3) velocity of the pelvis without assumption, m/s.
    """

    weight: Array
    velocity: Array
    free_weight: float
    free: Array


class PelvisPath(NamedTuple):
    """Path of the pelvis.

    Attributes:
        translation: (T, 3) position in T, metres; Y is the height above the ground of the start.
        contacts: (T, 7) probabilities of the contacts `edgepose.pose.CONTACTS`; None without a network.
    """

    translation: Array
    contacts: NDArray[np.float32] | None


def pelvis_path(solution: Solution, offsets: Array, rate: float, place: Array | None = None) -> PelvisPath:
    """Estimate the path that best fits accelerations, contacts and level ground.

    It starts above the origin.

    Args:
        solution: poses, and the acceleration of the pelvis.
        offsets: (24, 3) of the body, metres.
        rate: frames a second.
        place: (T, 10) contacts and velocity from a network, see `edgepose.inference.engine.EngineOutput`;
            None takes contacts from the poses.
    """
    frames = len(solution.acceleration)
    contacts = None if place is None else place[:, : len(CONTACTS)].astype(np.float32)
    if frames < 3:
        return PelvisPath(np.tile(standing_pelvis_position(offsets), (frames, 1)), contacts)
    joints = forward_kinematics(solution.rotations, offsets)[1] - offsets[0]
    support = _support_of_poses(joints, solution.acceleration, rate)
    if place is None:
        speed, still = _speed(solution.acceleration, support, rate)
        standing = still[:, _ANKLES]
    else:
        share = _shares(place)
        support = _with_network(support, share, solution.rotations[:, 0], place)
        speed, _ = _speed(solution.acceleration, support, rate)
        # A network's feet are fixed to the shanks, so toes that stand seem to rise and sink.
        weight = support.weight.copy()
        weight[:, _TOES] = 0.0
        speed[:, 1] = _speed(solution.acceleration, support._replace(weight=weight), rate)[0][:, 1]
        standing = np.maximum(share[:, _ANKLES], share[:, _TOES])
    start = standing_pelvis_position(offsets)
    path = start + np.concatenate([np.zeros((1, 3)), np.cumsum(speed, axis=0) / rate])
    heights = ankle_heights(path, joints, offsets)
    vertical = solution.acceleration[:, 1]
    path[:, 1] = grounded(path[:, 1], heights, vertical, standing, rate, steps=place is not None)
    return PelvisPath(path, contacts)


def _support_of_poses(joints: Array, acceleration: Array, rate: float) -> Support:
    """Assume that the lower ankle stands still except in flight."""
    velocity = -rate * np.diff(joints[:, _POINTS], axis=0)
    ankles = joints[:, [_POINTS[i] for i in _ANKLES], 1]
    lower = np.argmin(ankles[1:] + ankles[:-1], axis=1)
    in_flight = np.fmin(acceleration[1:, 1], acceleration[:-1, 1]) < FLIGHT
    weight = np.zeros(velocity.shape[:2])
    weight[np.arange(len(lower)), np.array(_ANKLES)[lower]] = np.where(in_flight, _FLYING, 1.0) / SLIP**2
    return Support(weight, velocity, 0.0, np.zeros((len(lower), 3)))


def _shares(place: Array) -> Array:
    """Return how far each point is in contact between frames (T - 1, 7), 0 to 1, from a network's place."""
    probability = np.minimum(place[1:, : len(CONTACTS)], place[:-1, : len(CONTACTS)])
    share: Array = np.clip(5.0 * probability - 3.0, 0.0, 1.0)
    return share


def _with_network(support: Support, share: Array, pelvis: Array, place: Array) -> Support:
    """Return a support by a network's contacts and velocity, with that of the poses as a hint.

    Args:
        support: of the poses.
        share: (T - 1, 7) contacts.
        pelvis: (T, 3, 3) R_TB.
        place: (T, 10) with the velocity.
    """
    level = rot.rotation_about_axis("y", rot.yaw_of_matrix(pelvis))
    free = (level @ place[:, len(CONTACTS) :, None])[..., 0]
    weight = _HINT * support.weight + share / SLIP**2
    return Support(weight, support.velocity, 1.0 / VELOCITY_ERROR**2, 0.5 * (free[1:] + free[:-1]))


def _speed(acceleration: Array, support: Support, rate: float) -> tuple[Array, Array]:
    """Return the velocity (T - 1, 3) between frames, m/s, and how far points stand still (T - 1, K), 0 to 1.

    By least squares: v[t] - v[t-1] is the acceleration over a frame, v follows from the points that stand
    still. Errors last for many frames, so each single frame's counts `rate` times less.
    """
    from scipy.linalg import solveh_banded

    known = np.isfinite(acceleration[1:-1, 0])
    stiffness = np.where(known, rate / ACCELERATION_ERROR**2, 0.0)
    gained = stiffness[:, None] * np.nan_to_num(acceleration[1:-1]) / rate
    trust = np.ones_like(support.weight)
    for _ in range(_ROUNDS):
        weight = support.weight * trust / rate
        # The last term only keeps the equations solvable where nothing is known.
        diagonal = weight.sum(axis=1) + support.free_weight / rate + 1e-9
        right = np.einsum("tk,tki->ti", weight, support.velocity) + support.free_weight / rate * support.free
        diagonal[1:] += stiffness
        diagonal[:-1] += stiffness
        right[1:] += gained
        right[:-1] -= gained
        speed = solveh_banded(np.stack([diagonal, np.append(-stiffness, 0.0)]), right, lower=True)
        # A point that moves anyway does not stand still: the weight shifts from foot to foot.
        slips = np.linalg.norm(speed[:, None] - support.velocity, axis=2) / (2.0 * SLIP)
        trust = 1.0 / (1.0 + slips**2) ** 2
    return speed, trust * np.minimum(support.weight * SLIP**2, 1.0)
