"""The distance that a wearer has walked."""

from __future__ import annotations

from math import hypot

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STEP_M = 0.25
"""Least change of place that counts as walking, metres: a body that stands or sits sways by less."""


class DistanceWalked:
    """Length of the polygon over the ground whose corners a wearer passes, each `STEP_M` from the last."""

    def __init__(self) -> None:
        """Start without a position."""
        self._to_corner_m, self._beyond_m = 0.0, 0.0
        self._corner: tuple[float, float] | None = None

    @property
    def distance_m(self) -> float:
        """Distance so far, metres."""
        return self._to_corner_m + self._beyond_m

    def add(self, position: Array) -> None:
        """Go on to a position (3,) of the pelvis in T, metres."""
        x, _, z = position.tolist()
        self._corner = self._corner or (x, z)
        self._beyond_m = hypot(x - self._corner[0], z - self._corner[1])
        if self._beyond_m >= STEP_M:
            self.interrupt()
            self._corner = x, z

    def interrupt(self) -> None:
        """Go on from wherever the next position is."""
        self._to_corner_m, self._beyond_m, self._corner = self.distance_m, 0.0, None
