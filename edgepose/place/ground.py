"""The ground under the feet, and what planted feet say about the place.

Assumptions:
- The ground is level, apart from steps: a foot that comes to rest clearly above or below what the feet stood
  on stands on something else. Slopes, and steps lower than `_STEP`, cannot be told from errors of poses.
- What a foot stands on does not move. A foot that has stood for long is where it was.
- No part of the body is below the ground. A foot may be, if one of them stands: it goes down a step. A
  wearer who jumps lands on a known ground, or higher. Those who lie and push themselves up come down again.
- Only those who stand or sit step on something else: the feet of those who lie or crawl do not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from edgepose.place.points import NEVER_BELOW, Point

_PLANTED, _LIFTED = 0.7, 0.5
"""Probabilities of contact above which a foot is planted, and below which it is no longer."""
_SETTLED_S = 0.05
"""Time after which a planted foot has come to rest, seconds."""
_STEP = 0.1
"""Least height of a step for a body of average size, metres. 99 % of all footprints on level ground differ by
up to 0.09 m."""
_UPRIGHT = 0.3
"""Height of the pelvis above the feet of those who stand or sit, for a body of average size, metres."""
_FLIGHT, _MOST = 0.6, 0.3
"""Uncertainty of the height after a flight: metres per second, and most of it, metres."""
_GROUND_S = 0.1
"""Time constant with which planted feet are brought to their ground, seconds."""
_STANDING_S = 1.0
"""Time after which a planted foot is anchored, seconds. In a step the foot rolls off before."""
_ANCHOR_S = 0.5
"""Time constant with which anchored feet are brought back, seconds."""
_RISE = 3.0
"""Greatest speed with which a body is lifted out of the ground, m/s."""


class _Foot:
    """A foot: what it stands on, and since when it has stood there."""

    __slots__ = ("anchor", "ground", "planted_s", "settled")

    def __init__(self) -> None:
        self.ground = 0.0
        self.lift()

    def lift(self) -> None:
        self.planted_s = 0.0
        self.settled = False
        self.anchor: tuple[float, float] | None = None


class Ground:
    """Corrects the position of the pelvis by the feet that stand on the ground."""

    def __init__(self, skin: Sequence[float], scale: float = 1.0) -> None:
        """Put both feet on the floor, at height 0; `skin` and `scale` are those of `BodyPoints`."""
        self._skin, self._scale = skin, scale
        self.reset()

    def reset(self) -> None:
        """Put both feet on the floor."""
        self._feet = _Foot(), _Foot()
        self._uncertainty = 0.0
        self._lifted = 0.0

    def lift(self) -> None:
        """Take both feet off the ground, because nothing is known about the time since the last frame."""
        for foot in self._feet:
            foot.lift()

    def height_of(self, points: Sequence[Point], parts: Sequence[int] = NEVER_BELOW) -> float:
        """Return the height of the pelvis, metres, above a ground that the lowest of some points rests on.

        Args:
            points: the points of `BodyPoints`.
            parts: indices of those that can rest on the ground.
        """
        return max([self._skin[i] - points[i][1] for i in parts])

    def correct(
        self,
        dt: float,
        position: list[float],
        points: Sequence[Point],
        probabilities: Sequence[float],
        share: Sequence[float],
    ) -> None:
        """Correct the position of the pelvis, in place.

        Args:
            dt: time since the frame before, seconds.
            position: position of the pelvis in T, metres.
            points: the points of `BodyPoints`.
            probabilities: those of `edgepose.pose.CONTACTS`.
            share: their shares, see `velocity.shares`.
        """
        up = total = x = z = anchored = 0.0
        for side, foot in enumerate(self._feet):
            point, s = points[side], share[side]
            if probabilities[side] < (_LIFTED if foot.planted_s > 0.0 else _PLANTED):
                foot.lift()
                continue
            foot.planted_s += dt
            height = position[1] + point[1] - self._skin[side]
            if not foot.settled and foot.planted_s > _SETTLED_S:
                self._settle(foot, height, -point[1])
            if foot.settled:
                up, total = up + s * (foot.ground - height), total + s
            if foot.planted_s > _STANDING_S:
                at = position[0] + point[0], position[2] + point[2]
                foot.anchor = foot.anchor or at
                x, z = x + s * (foot.anchor[0] - at[0]), z + s * (foot.anchor[1] - at[1])
                anchored += s
        if total > 0.0:
            part = 1.0 - math.exp(-dt / _GROUND_S)
            position[1] += _limited(part * up / total, dt)
            self._uncertainty *= 1.0 - part
        elif max(share) <= 0.0:
            self._uncertainty = min(_MOST, self._uncertainty + _FLIGHT * dt)
        if anchored > 0.0:
            part = min(1.0, dt / _ANCHOR_S) / anchored
            position[0] += _limited(part * x, dt)
            position[2] += _limited(part * z, dt)
        self._keep_above(dt, position, points)

    def _keep_above(self, dt: float, position: list[float], points: Sequence[Point]) -> None:
        """Lift a body out of the ground, and lower it again as soon as it can be lower, in place."""
        ground = min(foot.ground for foot in self._feet)
        standing = any(foot.planted_s > 0.0 for foot in self._feet)
        if not standing:
            ground = min(ground, 0.0)
        parts = NEVER_BELOW[2:] if standing else NEVER_BELOW
        depth = ground + self.height_of(points, parts) - position[1]
        rise = _limited(max(depth, -self._lifted), dt)
        position[1] += rise
        upright = min(points[0][1], points[1][1]) < -_UPRIGHT * self._scale
        self._lifted = 0.0 if upright else self._lifted + rise

    def _settle(self, foot: _Foot, height: float, below: float) -> None:
        """Put a foot that has come to rest on the ground.

        Args:
            foot: the foot.
            height: its height, metres.
            below: how far it is below the pelvis, metres.
        """
        known = min((self._feet[0].ground, self._feet[1].ground, 0.0), key=lambda g: abs(g - height))
        if abs(height - known) < _STEP * self._scale + self._uncertainty + self._lifted:
            foot.settled, foot.ground = True, known
        elif below > _UPRIGHT * self._scale:
            foot.settled, foot.ground = True, height


def _limited(correction: float, dt: float) -> float:
    """Return a correction, metres, that is not faster than `_RISE`."""
    return min(max(correction, -_RISE * dt), _RISE * dt)
