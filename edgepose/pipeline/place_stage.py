"""The place of one wearer in a run: added to each pose, reset on request; and the distance walked."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import inf

from edgepose.inference.engine import EngineOutput
from edgepose.place import DistanceWalked, Place, PlaceTracker
from edgepose.pose import PoseFrame
from edgepose.skeleton import Body

LOWER_BODY = frozenset({"left_lower_leg", "right_lower_leg", "pelvis"})
"""Sensors of which one must measure for the place to be followed."""


class PlaceStage:
    """Adds translation and contacts to the poses of one wearer.

    While the whole lower body is silent, the wearer stays where they were: the network would go on walking as
    in the last frame that it saw.
    """

    def __init__(
        self,
        body: Body,
        requests: Callable[[], list[float]] = list,
        notify: Callable[[str], None] = lambda text: None,
        without: Sequence[str] = (),
    ) -> None:
        """Put the wearer above the origin.

        Args:
            body: the wearer's body.
            requests: called at each pose; returns the delay in seconds of each newly requested reset.
            notify: called with a message after each reset.
            without: sensors that the rig lacks.
        """
        self._tracker = PlaceTracker(body)
        self._requests, self._notify = requests, notify
        self._lower_body = LOWER_BODY.difference(without)
        self._reset_at_s = inf
        self._place: Place | None = None
        self._distance = DistanceWalked()

    @property
    def distance_m(self) -> float:
        """Distance walked so far, metres, see `DistanceWalked`."""
        return self._distance.distance_m

    def add_to(self, pose: PoseFrame, output: EngineOutput) -> PoseFrame:
        """Return a pose with translation and contacts, given the network's output for it."""
        self._reset_if_due(pose.time_s)
        if self._place is None or not pose.held >= self._lower_body:
            self._place = self._tracker.update(pose.time_s, pose.rotations, output.place)
            self._distance.add(self._place.translation)
        return pose._replace(translation=self._place.translation, contacts=self._place.contacts)

    def _reset_if_due(self, time_s: float) -> None:
        self._reset_at_s = min([self._reset_at_s, *(time_s + delay_s for delay_s in self._requests())])
        if time_s >= self._reset_at_s:
            self._reset_at_s, self._place = inf, None
            self._tracker.reset()
            self._distance.interrupt()
            self._notify("place reset: the wearer is back at the origin, on the ground")
