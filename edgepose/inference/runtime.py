"""The interface between engines and what runs a network: arrays in and out, and states between frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


class Results(NamedTuple):
    """A network's results for B wearers: T poses each.

    Attributes:
        rotations: (B, T, 24, 3, 3) local rotations, joint 0 relative to T.
        std: (B, T, 24) standard deviations, radians.
        place: (B, T, 10), see `engine.EngineOutput`; None if it is not wanted.
    """

    rotations: Array
    std: Array
    place: Array | None = None

    def of_wearers(self) -> Iterator[tuple[Array, Array, Sequence[Array | None]]]:
        """Yield rotations, deviations and places for each wearer."""
        place = [[None] * len(row) for row in self.std] if self.place is None else self.place
        return zip(self.rotations, self.std, place, strict=True)


class Runtime(Protocol):
    """A network that runs here.

    In all methods `orientation` is (B, [T,] 6, 3, 3), calibrated bone orientations R_TB, and `acceleration`
    (B, [T,] 6, 3), m/s^2 in T without gravity, float32, for B wearers. States are lists of arrays.
    """

    def start(self, batch: int, future: int) -> Any:
        """Return the state before the first frame of a stream whose poses use `future` later frames."""

    def window(self, orientation: Array, acceleration: Array, index: int) -> Results:
        """Return the results for frame `index` of a window (B, T, ...)."""

    def stream(self, orientation: Array, acceleration: Array, state: Any) -> tuple[Results, Any]:
        """Return the results that are ready after a frame (B, ...), and the new state."""

    def stream_many(self, orientation: Array, acceleration: Array, state: Any) -> tuple[Results, Any]:
        """Return the results that are ready after several frames (B, T, ...), and the new state."""

    def drain(self, state: Any) -> Results:
        """Return the results of the frames that still wait for their future."""

    def shapes(self, state: Any) -> tuple[Any, ...]:
        """Return what states must have in common to be joined; it can be a key."""

    def join(self, states: Sequence[Any]) -> Any:
        """Return one state for the wearers of several states, one each."""

    def split(self, state: Any, batch: int) -> list[Any]:
        """Return the states of single wearers; the inverse of `join`."""
