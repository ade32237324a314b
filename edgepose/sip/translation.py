"""The pelvis' path, from its acceleration, which the poses leave over, and from the foot it stands on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edgepose.sip.solve import Solution
from edgepose.skeleton import JOINTS, forward_kinematics, standing_pelvis_position

Array = NDArray[np.float64]

ACCELERATION_ERROR = 1.0
"""Spread (m/s^2) of errors of the pelvis' acceleration that last for a second: bias, scale, tilt, poses."""

SLIP = 0.3
"""Spread (m/s) of the lower ankle's speed while a foot carries the wearer."""

FLIGHT = -4.0
"""Vertical acceleration (m/s^2) below which no foot carries the wearer; free fall is -9.81."""

_ANKLES = [JOINTS.index("left_ankle"), JOINTS.index("right_ankle")]
_FLYING = 1e-3  # how much the lower foot counts then
_ROUNDS = 6  # of weighing anew


def pelvis_path(solution: Solution, offsets: Array, rate: float) -> Array:
    """Path (T, 3) in T, metres: the likeliest for the acceleration and the supporting foot.

    Integrated twice, an error of the acceleration grows without bound. That the lower foot stands gives the
    speed, except in flight. The path still drifts, by a tenth of the way; there is no ground in it.
    It begins over the origin, as high as the pelvis is of someone who stands straight.

    Args:
        solution: poses, and the acceleration that they leave to the pelvis.
        offsets: (24, 3) of the body, metres.
        rate: frames a second.
    """
    acceleration = solution.acceleration
    frames = len(acceleration)
    if frames < 3:
        return np.tile(standing_pelvis_position(offsets), (frames, 1))
    from scipy.linalg import solveh_banded

    # Speeds v between frames, by least squares: v[t] - v[t-1] is the acceleration over a frame, v is the
    # supporting foot's. Errors last for many frames, so that one of a single frame counts `rate` times less.
    flies = np.fmin(acceleration[1:, 1], acceleration[:-1, 1]) < FLIGHT
    stands = np.where(flies, _FLYING, 1.0) / SLIP**2 / rate
    support = _support_speed(solution.rotations, offsets, rate)
    pushes = np.where(np.isfinite(acceleration[1:-1, 0]), rate / ACCELERATION_ERROR**2, 0.0)
    push = pushes[:, None] * np.nan_to_num(acceleration[1:-1]) / rate
    trust = np.ones(frames - 1)
    for _ in range(_ROUNDS):
        diagonal = stands * trust
        right = diagonal[:, None] * support
        diagonal[1:] += pushes
        diagonal[:-1] += pushes
        right[1:] += push
        right[:-1] -= push
        speed = solveh_banded(np.stack([diagonal, np.append(-pushes, 0.0)]), right, lower=True)
        # While the weight passes from foot to foot, the lower one may be the one that swings.
        slips = np.linalg.norm(speed - support, axis=1) / (2.0 * SLIP)
        trust = 1.0 / (1.0 + slips**2) ** 2
    return standing_pelvis_position(offsets) + np.concatenate(
        [np.zeros((1, 3)), np.cumsum(speed, axis=0) / rate]
    )


def _support_speed(rotations: Array, offsets: Array, rate: float) -> Array:
    """Speed (T - 1, 3) of the pelvis between frames if the lower ankle stands still, m/s."""
    ankles = forward_kinematics(rotations, offsets)[1][:, _ANKLES]
    lower = np.argmin(ankles[1:, :, 1] + ankles[:-1, :, 1], axis=1)
    return -rate * np.diff(ankles, axis=0)[np.arange(len(lower)), lower]
