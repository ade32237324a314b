"""Messages about sensors that drop out during a run, and come back."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf

from edgepose.imu import ImuFrame
from edgepose.placements import PLACEMENTS

SILENT_S = 1.0
"""Time a sensor is held before it is reported, seconds; shorter dropouts are only counted."""

QUIET_S = 30.0
"""Least time between two reports about one sensor, seconds: a loose plug would cause a flood of them."""


class DropoutMonitor:
    """Watches the frames of a run for sensors that are held.

    Attributes:
        any_held: whether a sensor was held in the last frame.
    """

    def __init__(self, added: Sequence[str] = (), without: Sequence[str] = ()) -> None:
        """Start with all sensors live.

        Args:
            added: sensors besides the six.
            without: those of the six that the rig lacks, which are not reported.
        """
        self._names = [*PLACEMENTS, *added]
        self._without = without
        self._since_s: list[float | None] = [None] * len(self._names)
        self._reported_s = [-inf] * len(self._names)
        self._is_reported = [False] * len(self._names)
        self.any_held = False
        self._was_held = False

    def update(self, frame: ImuFrame) -> list[str]:
        """Return one message per sensor that dropped out or came back."""
        lines: list[str] = []
        states = frame.held.tolist()
        self.any_held = True in states
        if frame.added is not None:
            states += frame.added.held.tolist()
        before, self._was_held = self._was_held, True in states
        if not before and not self._was_held:
            return lines
        for i, (name, held) in enumerate(zip(self._names, states, strict=True)):
            if name in self._without:
                continue
            since_s = self._since_s[i]
            if not held:
                if self._is_reported[i] and since_s is not None:
                    lines.append(f"{name}: back after {frame.time_s - since_s:.1f} s")
                self._since_s[i], self._is_reported[i] = None, False
            elif since_s is None:
                self._since_s[i] = frame.time_s
            elif (
                frame.time_s - since_s >= SILENT_S
                and not self._is_reported[i]
                and frame.time_s - self._reported_s[i] >= QUIET_S
            ):
                self._is_reported[i], self._reported_s[i] = True, frame.time_s
                replaced = "its last values are repeated" if i < len(PLACEMENTS) else "its bone is predicted"
                lines.append(
                    f"{name}: no data for {frame.time_s - since_s:.0f} s; {replaced}: "
                    "check its power and connection"
                )
        return lines
