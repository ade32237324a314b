"""Tracker of a wearer's place, frame by frame."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose.skeleton import Body, grounded_pelvis_position

Array = NDArray[np.float64]
Input = NDArray[np.floating[Any]]


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
        self._offsets = body.offsets

    def update(self, time_s: float, rotations: Input, place: Input | None) -> Place:
        """Return the place in the next frame.

        Args:
            time_s: time of the frame, seconds, later than that of the frame before.
            rotations: (24, 3, 3) local rotations, joint 0 relative to T.
            place: (10,) the network's contacts and velocity, see `EngineOutput.place`; None without them.
        """
        contacts = None if place is None else np.asarray(place[:7], np.float32)
        return Place(grounded_pelvis_position(rotations, self._offsets), contacts)

    def reset(self) -> None:
        """Put the wearer back above the origin of T, on the ground."""
