"""Tracker of a wearer's place, frame by frame.

Assumptions:
- What a foot stands on does not move, and a foot does not slide.
- The ground is level unless a foot comes to rest clearly above or below it.
- Rotations are those of the wearer in a frame that does not turn; heading errors turn the path.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose.place.points import BodyPoints
from edgepose.pose import CONTACTS
from edgepose.skeleton import Body

Array = NDArray[np.float64]
Input = NDArray[np.floating[Any]]

_NETWORK = 0.3
"""Share of the network's velocity, where a point that surely stands still has 1."""
_SHARES = (1.0, 1.0, 0.3, 0.3, 1.0, 0.5, 0.5)
"""Greatest share of each of CONTACTS."""
_ANCHOR_PER_S = 2.0
"""Part of the way from a planted foot to where it was planted that is made up in a second."""
_GROUND_S = 0.15
"""Time constant with which planted feet are brought to their ground, seconds."""
_LEVEL = 0.05
"""A foot that comes to rest at most so far above or below the ground is on the same level, metres."""
_PLANTED, _LIFTED = 0.8, 0.5
"""Probabilities of contact above which a foot is planted, and below which it is no longer."""
_GAP_S = 0.1
"""Longest time from frame to frame in which a motion is followed, seconds."""
_FASTEST = 12.0
"""Greatest speed, m/s."""


class Place(NamedTuple):
    """A wearer's place in one frame.

    Attributes:
        translation: (3,) position of the pelvis in T, metres; Y is the height above the ground of the start.
        contacts: (7,) probabilities that the joints `edgepose.pose.CONTACTS` rest on something; None if the
            network does not estimate them.
    """

    translation: Array
    contacts: NDArray[np.float32] | None


class _Foot:
    """A foot on the ground: where its ankle was planted."""

    __slots__ = ("level", "x", "z")

    def __init__(self, x: float, level: float, z: float) -> None:
        self.x, self.level, self.z = x, level, z


class PlaceTracker:
    """Follows one wearer through the room."""

    def __init__(self, body: Body) -> None:
        """Put the wearer above the origin of T, on the ground."""
        self._points = BodyPoints(body)
        self._skin: list[float] = self._points.skin.tolist()
        self.reset()

    def reset(self) -> None:
        """Put the wearer back above the origin of T, on the ground."""
        self._time_s = -math.inf
        self._before: list[list[float]] = []
        self._position = [0.0, 0.0, 0.0]
        self._ground = 0.0
        self._feet: list[_Foot | None] = [None, None]

    def update(self, time_s: float, rotations: Input, place: Input | None) -> Place:
        """Return the place in the next frame.

        Args:
            time_s: time of the frame, seconds, later than that of the frame before.
            rotations: (24, 3, 3) local rotations, joint 0 relative to T.
            place: (10,) the network's contacts and velocity, see `EngineOutput.place`; None without them.
        """
        points: list[list[float]] = self._points.positions(rotations).tolist()
        if not self._before:
            self._position[1] = -min(p[1] - skin for p, skin in zip(points, self._skin, strict=True))
        else:
            contacts, velocity = self._estimates(points, rotations, place)
            self._move(time_s - self._time_s, points, contacts, velocity)
        self._time_s, self._before = time_s, points
        probabilities = None if place is None else np.asarray(place[: len(CONTACTS)], np.float32)
        return Place(np.array(self._position), probabilities)

    def _estimates(
        self, points: list[list[float]], rotations: Input, place: Input | None
    ) -> tuple[list[float], list[float] | None]:
        """Return probabilities of contacts and the velocity along the axes of T."""
        if place is None:
            lowest = 0 if points[0][1] < points[1][1] else 1
            return [float(i == lowest) for i in range(len(CONTACTS))], None
        numbers = place.tolist()
        root = rotations[0]
        angle = math.atan2(root[0, 2] - root[2, 0], root[0, 0] + root[2, 2])
        s, c = math.sin(angle), math.cos(angle)
        x, y, z = numbers[len(CONTACTS) :]
        return numbers[: len(CONTACTS)], [c * x + s * z, y, c * z - s * x]

    def _move(
        self, dt: float, points: list[list[float]], contacts: list[float], velocity: list[float] | None
    ) -> None:
        if not 0.0 < dt <= _GAP_S:
            self._feet = [None, None]
            dt = min(max(dt, 0.0), _GAP_S)
            self._before = points
        shares = [min(max(5.0 * p - 3.0, 0.0), 1.0) for p in contacts]
        position = self._position
        x, y, z, total = 0.0, 0.0, 0.0, 1e-6
        if velocity is not None:
            x, y, z = (_NETWORK * v * dt for v in velocity)
            total = _NETWORK
        for before, now, share, most in zip(self._before, points, shares, _SHARES, strict=False):
            if share:
                share *= most
                x += share * (before[0] - now[0])
                y += share * (before[1] - now[1])
                z += share * (before[2] - now[2])
                total += share
        step = math.sqrt(x * x + y * y + z * z) / total
        scale = min(1.0, _FASTEST * dt / step) / total if step > 0.0 else 0.0
        position[0] += x * scale
        position[1] += y * scale
        position[2] += z * scale
        self._stand(dt, points, contacts, shares)

    def _stand(
        self, dt: float, points: list[list[float]], contacts: list[float], shares: list[float]
    ) -> None:
        """Bring planted feet to the ground and to where they were planted."""
        position = self._position
        x = y = z = total = 0.0
        for i in (0, 1):
            at_x, at_z = position[0] + points[i][0], position[2] + points[i][2]
            height = position[1] + points[i][1] - self._skin[i]
            foot = self._feet[i]
            if foot is None and contacts[i] > _PLANTED:
                self._ground = self._ground if abs(height - self._ground) < _LEVEL else height
                foot = _Foot(at_x, self._ground, at_z)
            elif contacts[i] < _LIFTED:
                foot = None
            self._feet[i] = foot
            if foot is not None:
                x += shares[i] * (foot.x - at_x)
                y += shares[i] * (foot.level - height)
                z += shares[i] * (foot.z - at_z)
                total += shares[i]
        if total:
            part = min(1.0, _ANCHOR_PER_S * dt) / total
            position[0] += part * x
            position[1] += (1.0 - math.exp(-dt / _GROUND_S)) * y / total
            position[2] += part * z
        ground = min([foot.level for foot in self._feet if foot is not None], default=self._ground)
        below = ground - position[1]
        depth = max(below - points[i][1] + self._skin[i] for i in _NEVER_BELOW)
        if depth > 0.0:
            position[1] += depth


_NEVER_BELOW = (0, 1, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14)
"""Points that are kept above the ground: all but the toes, whose joints are not measured."""
