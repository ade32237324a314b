"""The place of one wearer in a run: added to each pose, reset on request, and summed to the way walked."""

from __future__ import annotations

from collections.abc import Callable
from math import hypot, inf

import numpy as np
from numpy.typing import NDArray

from edgepose.inference.engine import EngineOutput
from edgepose.place import Place, PlaceTracker
from edgepose.placements import PLACEMENTS
from edgepose.pose import PoseFrame
from edgepose.skeleton import Body

Array = NDArray[np.float64]

STEP_M = 0.25
"""Least change of place that counts as walking, metres: a body that stands or sits sways by less."""


class PlaceStage:
    """Adds translation and contacts to the poses of one wearer.

    While all sensors are silent nothing is known, and the wearer stays where they were.
    """

    def __init__(
        self,
        body: Body,
        requests: Callable[[], list[float]] = list,
        notify: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Put the wearer above the origin.

        Args:
            body: the wearer's body.
            requests: called at each pose; returns the delay in seconds of each newly requested reset.
            notify: called with a message after each reset.
        """
        self._tracker = PlaceTracker(body)
        self._requests, self._notify = requests, notify
        self._reset_at_s = inf
        self._place: Place | None = None
        self._way = Way()

    @property
    def way_m(self) -> float:
        """Way walked so far, metres, without what is less than `STEP_M`."""
        return self._way.length_m

    def add_to(self, pose: PoseFrame, output: EngineOutput) -> PoseFrame:
        """Return a pose with translation and contacts, given the network's output for it."""
        self._reset_if_due(pose.time_s)
        if self._place is None or len(pose.held) < len(PLACEMENTS):
            self._place = self._tracker.update(pose.time_s, pose.rotations, output.place)
            self._way.add(self._place.translation)
        return pose._replace(translation=self._place.translation, contacts=self._place.contacts)

    def _reset_if_due(self, time_s: float) -> None:
        self._reset_at_s = min([self._reset_at_s, *(time_s + delay_s for delay_s in self._requests())])
        if time_s >= self._reset_at_s:
            self._reset_at_s, self._place = inf, None
            self._tracker.reset()
            self._way.interrupt()
            self._notify("place reset: the wearer is back at the origin, on the ground")


class Way:
    """Length of a horizontal path without its sway: that of the polygon whose corners are `STEP_M` apart."""

    def __init__(self) -> None:
        self._to_corner_m, self._beyond_m = 0.0, 0.0
        self._corner: tuple[float, float] | None = None

    @property
    def length_m(self) -> float:
        return self._to_corner_m + self._beyond_m

    def add(self, position: Array) -> None:
        """Go on to a position (3,), metres."""
        x, _, z = position.tolist()
        self._corner = self._corner or (x, z)
        self._beyond_m = hypot(x - self._corner[0], z - self._corner[1])
        if self._beyond_m >= STEP_M:
            self.interrupt()
            self._corner = x, z

    def interrupt(self) -> None:
        """Go on from wherever the next position is."""
        self._to_corner_m, self._beyond_m, self._corner = self.length_m, 0.0, None
