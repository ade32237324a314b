"""Velocity of the pelvis, fused from points that stand still and from the network's estimate.

Assumptions:
- Points in contact do not move. Where the network is sure of a contact, this is more accurate than its
  velocity, which is too slow for fast wearers.
- The difference between both, as it was at the last contacts, remains while nothing touches the ground.
- No one moves faster than `FASTEST`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from edgepose.imu import GRAVITY
from edgepose.place.points import Point

FASTEST = 12.0
"""Greatest speed of the pelvis, m/s."""

_UNSURE, _SURE = 0.7, 0.95
"""Probabilities of contact up to which a point has no share in the velocity, and from which on it has all."""
_WRIST = 0.5
"""Share of a wrist in sure contact; other points have 1. What a hand touches may move."""
_PREDICTION = 0.1
"""Share of the velocity that is predicted without contacts."""
_PREDICTION_S = 0.1
"""Time constant with which the prediction follows the network's velocity, seconds."""
_CORRECTION_S = 0.4
"""Time constant with which the network's error is estimated from contacts, seconds."""
_GLITCH = 5.0
"""A point that would change the velocity by more, m/s, belongs to a pose that has jumped."""


def shares(probabilities: Sequence[float]) -> list[float]:
    """Return the shares, 0 to 1, of the points in contact, in the order of `edgepose.pose.CONTACTS`.

    A toe counts for as much as the heel has lifted before it.
    """
    left, right, left_toe, right_toe, pelvis, left_wrist, right_wrist = [
        0.0 if p <= _UNSURE else 1.0 if p >= _SURE else (p - _UNSURE) / (_SURE - _UNSURE)
        for p in probabilities
    ]
    left_toe, right_toe = max(left_toe - left, 0.0), max(right_toe - right, 0.0)
    return [left, right, left_toe, right_toe, pelvis, _WRIST * left_wrist, _WRIST * right_wrist]


class PelvisVelocity:
    """Estimates the velocity of the pelvis along the axes of T, m/s."""

    def __init__(self) -> None:
        """Start at rest."""
        self.reset()

    def reset(self) -> None:
        """Forget the velocity and the network's error."""
        self._velocity = [0.0, 0.0, 0.0]
        self._correction = [0.0, 0.0]

    def update(
        self,
        dt: float,
        before: Sequence[Point],
        points: Sequence[Point],
        share: Sequence[float],
        network: Sequence[float] | None,
    ) -> list[float]:
        """Return the velocity between two frames, [x, y, z].

        Args:
            dt: time between the frames, seconds.
            before: the points of `BodyPoints` in the frame before, metres from the pelvis.
            points: the same in this frame.
            share: shares of the first seven, see `shares`.
            network: the network's velocity along the axes of T, m/s; None without it.
        """
        predicted = self._predicted(dt, max(share), network)
        px, py, pz = predicted
        x = y = z = total = 0.0
        for a, b, s in zip(before, points, share, strict=False):
            if s > 0.0:
                vx, vy, vz = (a[0] - b[0]) / dt, (a[1] - b[1]) / dt, (a[2] - b[2]) / dt
                if abs(vx - px) + abs(vy - py) + abs(vz - pz) < _GLITCH:
                    x, y, z, total = x + s * vx, y + s * vy, z + s * vz, total + s
        if total > 0.0 and network is not None:
            part = min(1.0, total) * min(1.0, dt / _CORRECTION_S)
            self._correction[0] += part * (x / total - network[0] - self._correction[0])
            self._correction[1] += part * (z / total - network[2] - self._correction[1])
        x, y, z = x + _PREDICTION * px, y + _PREDICTION * py, z + _PREDICTION * pz
        total += _PREDICTION
        scale = 1.0 / max(total, math.sqrt(x * x + y * y + z * z) / FASTEST)
        self._velocity = [x * scale, y * scale, z * scale]
        return self._velocity

    def _predicted(self, dt: float, contact: float, network: Sequence[float] | None) -> list[float]:
        """Return the velocity if nothing touches the ground: it follows the network's, or ends, and falls."""
        x, y, z = self._velocity
        to_x = to_y = to_z = 0.0
        if network is not None:
            to_x, to_y, to_z = network
            to_x, to_z = to_x + self._correction[0], to_z + self._correction[1]
        part = min(1.0, dt / _PREDICTION_S)
        y -= (1.0 - contact) * GRAVITY * dt
        return [x + part * (to_x - x), y + part * (to_y - y), z + part * (to_z - z)]
