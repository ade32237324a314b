"""Messages about sensors that drop out during a run, and come back."""

from __future__ import annotations

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

    def __init__(self) -> None:
        """Start with all sensors live."""
        self._since_s: list[float | None] = [None] * len(PLACEMENTS)
        self._reported_s = [-inf] * len(PLACEMENTS)
        self._is_reported = [False] * len(PLACEMENTS)
        self.any_held = False

    def update(self, frame: ImuFrame) -> list[str]:
        """Return one message per sensor that dropped out or came back."""
        lines: list[str] = []
        now_held = frame.held.tolist()
        before, self.any_held = self.any_held, True in now_held
        if not before and not self.any_held:
            return lines
        for i, (name, held) in enumerate(zip(PLACEMENTS, now_held, strict=True)):
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
                lines.append(
                    f"{name}: no data for {frame.time_s - since_s:.0f} s; its last values are repeated: "
                    "check its power and connection"
                )
        return lines
