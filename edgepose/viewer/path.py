"""Lines on the floor along which figures go."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STEP_M = 0.05
"""Distance between the points of a line."""

JUMP_M = 1.0
"""Longer steps are no steps: the place was reset, or poses were lost. The line has a gap there."""

HEIGHT_M = 0.004
"""Height of the line above the floor, so that both are seen."""

SEGMENTS, PIECES = 100, 60
"""Segments of a piece of the line, which is sent as a whole, and pieces that are kept: the last 300 m."""


class FloorPath:
    """A line on the floor that grows with its figure."""

    def __init__(self, server: Any, name: str, colour: tuple[int, ...]) -> None:
        """Start without points in the scene of a viser server."""
        self._server, self._name, self._colour = server, name, colour
        self._last: Array | None = None
        self._count = 0  # segments so far
        self._newest = np.zeros((SEGMENTS, 2, 3), np.float32)  # the piece that grows
        self._pieces: list[Any] = []

    def extend(self, positions: Iterable[Array]) -> None:
        """Lead the line on to further positions (3,) of the pelvis, metres."""
        drawn = True
        for position in positions:
            point = np.array([position[0], HEIGHT_M, position[2]])
            length = STEP_M if self._last is None else np.linalg.norm(point - self._last)
            if length < STEP_M:
                continue
            if self._last is not None and length < JUMP_M:
                self._append(self._last, point)
                drawn = self._count % SEGMENTS == 0
                if drawn:
                    self._draw()
            self._last = point
        if not drawn:
            self._draw()

    def _append(self, start: Array, end: Array) -> None:
        i = self._count % SEGMENTS
        if i == 0:
            self._newest[...] = start  # segments without length are not seen
        self._newest[i] = start, end
        self._count += 1

    def _draw(self) -> None:
        """Draw the newest piece, after some time in the place of the oldest one."""
        slot = (self._count - 1) // SEGMENTS % PIECES
        if slot < len(self._pieces):
            self._pieces[slot].points = self._newest.copy()
            return
        name = f"/{self._name}/{slot}"
        self._pieces.append(
            self._server.scene.add_line_segments(name, self._newest.copy(), self._colour, thickness=0.02)
        )
