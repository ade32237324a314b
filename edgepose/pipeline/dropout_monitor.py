"""Tells when a sensor falls silent during a run, and when it is back."""

from __future__ import annotations

from math import inf

from edgepose.imu import ImuFrame
from edgepose.placements import PLACEMENTS

SILENT_S = 1.0
"""How long a sensor is held before it is told; shorter losses are counted only."""

QUIET_S = 30.0
"""Least time between two losses of one sensor that are told, seconds: a loose plug comes and goes."""


class DropoutMonitor:
    """Watches frames."""

    def __init__(self) -> None:
        """Nothing is silent."""
        self._since_s: list[float | None] = [None] * len(PLACEMENTS)
        self._told_s = [-inf] * len(PLACEMENTS)
        self._is_told = [False] * len(PLACEMENTS)

    def update(self, frame: ImuFrame) -> list[str]:
        """What there is to tell of a frame: one line for each sensor that is lost or back."""
        lines = []
        for i, (name, held) in enumerate(zip(PLACEMENTS, frame.held.tolist(), strict=True)):
            since_s = self._since_s[i]
            if not held:
                if self._is_told[i] and since_s is not None:
                    lines.append(f"{name}: back after {frame.time_s - since_s:.1f} s")
                self._since_s[i], self._is_told[i] = None, False
            elif since_s is None:
                self._since_s[i] = frame.time_s
            elif (
                frame.time_s - since_s >= SILENT_S
                and not self._is_told[i]
                and frame.time_s - self._told_s[i] >= QUIET_S
            ):
                self._is_told[i], self._told_s[i] = True, frame.time_s
                lines.append(
                    f"{name}: nothing for {frame.time_s - since_s:.0f} s; its last values are repeated: "
                    "check its power and link"
                )
        return lines
