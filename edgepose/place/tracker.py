"""Tracker of a wearer's place, frame by frame.

Each frame moves the pelvis by the velocity of `edgepose.place.velocity`; the feet on the ground then correct
the position, see `edgepose.place.ground`. Both modules state what they assume. Beyond that:

- Rotations and velocities are those of a frame that does not turn: an error of the heading turns the path.
- Frames come at least every `GAP_S`. What happens in a longer gap is unknown: the wearer stays in place, and
  the lowest part of the body at its height.
- Without contacts from a network the lower foot stands on the ground.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose.place.ground import Ground
from edgepose.place.points import BodyPoints, Point
from edgepose.place.velocity import PelvisVelocity, shares
from edgepose.pose import CONTACTS
from edgepose.skeleton import Body

Array = NDArray[np.float64]
Input = NDArray[np.floating[Any]]

GAP_S = 0.2
"""Longest time from frame to frame in which a motion is followed, seconds."""

_LOWER = 0.01
"""The foot that stands changes if the other one is lower by more, metres; only without contacts."""
_UPSET = 0.15
"""A foot higher above the lowest point of the body does not stand, metres; only without contacts."""
_PELVIS = CONTACTS.index("pelvis")
_MOST_SQUARES = 100.0
"""Largest sum of the squares of a pose's matrices that is taken for one of 24 rotations, which is 72."""


class Place(NamedTuple):
    """A wearer's place in one frame.

    Attributes:
        translation: (3,) position of the pelvis in T, metres; Y is the height above the ground of the start.
        contacts: (7,) probabilities that the joints `edgepose.pose.CONTACTS` rest on something; None if the
            network does not estimate them.
    """

    translation: Array
    contacts: NDArray[np.float32] | None


class PlaceTracker:
    """Follows one wearer through the room."""

    def __init__(self, body: Body) -> None:
        """Put the wearer above the origin of T, on the ground."""
        self._points = BodyPoints(body)
        self._velocity = PelvisVelocity()
        self._ground = Ground(self._points.skin, self._points.scale)
        self.reset()

    def reset(self) -> None:
        """Put the wearer back above the origin of T, on the ground."""
        self._velocity.reset()
        self._ground.reset()
        self._time_s = 0.0
        self._before: list[Point] | None = None
        self._position = [0.0, 0.0, 0.0]
        self._standing = 0

    def update(self, time_s: float, rotations: Input, place: Input | None) -> Place:
        """Return the place in the next frame.

        A frame with a time that is not finite, or matrices that are not rotations but NaN or far too large,
        leaves the place as it is; a `place` that is not finite counts as None.

        Args:
            time_s: time of the frame, seconds, later than that of the frame before.
            rotations: (24, 3, 3) local rotations, joint 0 relative to T.
            place: (10,) the network's contacts and velocity, see `EngineOutput.place`; None without them.
        """
        numbers: list[float] | None = None if place is None else place.tolist()
        if numbers is not None and not math.isfinite(sum(numbers)):
            place = numbers = None
        # NaN compares false, and products of larger numbers along the body might not be finite.
        if np.vdot(rotations, rotations) < _MOST_SQUARES and math.isfinite(time_s):
            self._follow(time_s, self._points.positions(rotations), rotations[0], numbers)
        contacts = None if place is None else np.asarray(place[: len(CONTACTS)], np.float32)
        return Place(np.array(self._position), contacts)

    def _follow(self, time_s: float, points: list[Point], pelvis: Input, numbers: list[float] | None) -> None:
        """Move to the next frame."""
        before, dt = self._before, time_s - self._time_s
        self._time_s, self._before = time_s, points
        if before is None:
            self._position[1] = self._ground.height_of(points)
            return
        if not 0.0 < dt <= GAP_S:
            self._velocity.reset()
            self._ground.lift()
            self._position[1] += self._ground.height_of(points) - self._ground.height_of(before)
            return
        if numbers is None:
            probabilities, velocity = self._lower_foot(points), None
        else:
            probabilities = numbers[: len(CONTACTS)]
            velocity = _along_t(numbers[len(CONTACTS) :], pelvis)
        share = shares(probabilities)
        x, y, z = self._velocity.update(dt, before, points, share, velocity)
        position = self._position
        position[0] += x * dt
        position[1] += y * dt
        position[2] += z * dt
        self._ground.correct(dt, position, points, probabilities, share)

    def _lower_foot(self, points: list[Point]) -> list[float]:
        """Return contacts of the lower foot only, or of the pelvis if the body does not stand on its feet."""
        other = 1 - self._standing
        if points[other][1] < points[self._standing][1] - _LOWER:
            self._standing = other
        lifted = self._ground.height_of(points) + points[self._standing][1] > _UPSET
        stands_on = _PELVIS if lifted else self._standing
        return [float(i == stands_on) for i in range(len(CONTACTS))]


def _along_t(velocity: list[float], pelvis: Input) -> list[float]:
    """Return a velocity in the level frame of the pelvis along the axes of T."""
    (xx, _, xz), _, (zx, _, zz) = pelvis.tolist()
    cosine, sine = xx + zz, xz - zx
    length = math.hypot(cosine, sine) or 1.0
    cosine, sine = cosine / length, sine / length
    x, y, z = velocity
    return [cosine * x + sine * z, y, cosine * z - sine * x]
