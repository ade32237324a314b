"""Path of the pelvis, from the acceleration that the poses leave unexplained and from the supporting foot."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edgepose.sip.solve import Solution
from edgepose.skeleton import JOINTS, forward_kinematics, standing_pelvis_position

Array = NDArray[np.float64]

ACCELERATION_ERROR = 1.0
"""Spread (m/s^2) of errors of the pelvis acceleration that last for a second: bias, scale, tilt, poses."""

SLIP = 0.3
"""Spread (m/s) of the lower ankle's speed while a foot supports the wearer."""

FLIGHT = -4.0
"""Vertical acceleration (m/s^2) below which no foot supports the wearer; free fall is -9.81."""

_ANKLES = [JOINTS.index("left_ankle"), JOINTS.index("right_ankle")]
_FLYING = 1e-3  # weight of the lower foot in flight
_ROUNDS = 6  # of reweighting


def pelvis_path(solution: Solution, offsets: Array, rate: float) -> Array:
    """Estimate the path (T, 3) in T, metres, that best fits the acceleration and the supporting foot.

    Integrated twice, an error of the acceleration grows without bound. The lower foot stands still except in
    flight, which gives the speed. The path still drifts, by a tenth of its length, and it knows no ground. It
    starts above the origin, at the pelvis height of someone who stands straight.

    Args:
        solution: poses, and the acceleration of the pelvis.
        offsets: (24, 3) of the body, metres.
        rate: frames a second.
    """
    acceleration = solution.acceleration
    frames = len(acceleration)
    if frames < 3:
        return np.tile(standing_pelvis_position(offsets), (frames, 1))
    from scipy.linalg import solveh_banded

    # Velocities v between frames, by least squares: v[t] - v[t-1] is the acceleration over a frame, v follows
    # from the supporting foot. Errors last for many frames, so each single frame's counts `rate` times less.
    in_flight = np.fmin(acceleration[1:, 1], acceleration[:-1, 1]) < FLIGHT
    support_weight = np.where(in_flight, _FLYING, 1.0) / SLIP**2 / rate
    support = _support_speed(solution.rotations, offsets, rate)
    acceleration_weight = np.where(np.isfinite(acceleration[1:-1, 0]), rate / ACCELERATION_ERROR**2, 0.0)
    gained = acceleration_weight[:, None] * np.nan_to_num(acceleration[1:-1]) / rate
    trust = np.ones(frames - 1)
    for _ in range(_ROUNDS):
        diagonal = support_weight * trust
        right = diagonal[:, None] * support
        diagonal[1:] += acceleration_weight
        diagonal[:-1] += acceleration_weight
        right[1:] += gained
        right[:-1] -= gained
        speed = solveh_banded(np.stack([diagonal, np.append(-acceleration_weight, 0.0)]), right, lower=True)
        # While the weight shifts from foot to foot, the lower one may be the one that swings.
        slips = np.linalg.norm(speed - support, axis=1) / (2.0 * SLIP)
        trust = 1.0 / (1.0 + slips**2) ** 2
    return standing_pelvis_position(offsets) + np.concatenate(
        [np.zeros((1, 3)), np.cumsum(speed, axis=0) / rate]
    )


def _support_speed(rotations: Array, offsets: Array, rate: float) -> Array:
    """Return the velocity (T - 1, 3) of the pelvis between frames if the lower ankle stands still, m/s."""
    ankles = forward_kinematics(rotations, offsets)[1][:, _ANKLES]
    lower = np.argmin(ankles[1:, :, 1] + ankles[:-1, :, 1], axis=1)
    return -rate * np.diff(ankles, axis=0)[np.arange(len(lower)), lower]
