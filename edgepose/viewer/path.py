"""Lines on the floor along which figures go."""

from __future__ import annotations

from collections import deque
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
"""Segments of a piece of the line, and pieces that are kept: the last 300 m. A browser gets whole pieces."""


class FloorPath:
    """A line on the floor that grows with its figure."""

    def __init__(self, server: Any, name: str, colour: tuple[int, ...]) -> None:
        """Start without points in the scene of a viser server."""
        self._server, self._name, self._colour = server, name, colour
        self._last: Array | None = None
        self._segments: list[Array] = []  # of the newest piece, not all of them full
        self._pieces: deque[Any] = deque()
        self._count = 0

    def extend(self, positions: Iterable[Array]) -> None:
        """Lead the line on to further positions (3,) of the pelvis, metres."""
        drawn = True
        for position in positions:
            point = np.array([position[0], HEIGHT_M, position[2]])
            if self._last is None:
                self._last = point
            length = np.linalg.norm(point - self._last)
            if length < STEP_M:
                continue
            if length < JUMP_M:
                self._segments.append(np.stack([self._last, point]))
                drawn = False
            self._last = point
            if len(self._segments) == SEGMENTS:
                self._draw()
                self._count, self._segments, drawn = self._count + 1, [], True
        if not drawn:
            self._draw()

    def _draw(self) -> None:
        """Draw the newest piece, in the place of its shorter self."""
        piece = self._server.scene.add_line_segments(
            f"/{self._name}/{self._count}", np.stack(self._segments), self._colour, thickness=0.02
        )
        if self._pieces and self._pieces[-1].name == piece.name:
            self._pieces.pop()
        self._pieces.append(piece)
        if len(self._pieces) > PIECES:
            self._pieces.popleft().remove()
