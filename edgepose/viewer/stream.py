"""Poses as they come over UDP, and the text beside the figure."""

from __future__ import annotations

import re
import socket
from collections import deque

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError
from edgepose.placements import PLACEMENTS
from edgepose.pose import PoseFrame, held_sensors, longest_holds
from edgepose.sinks.udp import decode

WINDOW_S = 5.0
"""Time over which rates and gaps are computed, seconds."""


class UdpPoseStream:
    """Receives poses as datagrams, with statistics of the last seconds."""

    def __init__(self) -> None:
        """Start with no poses."""
        self.poses, self.lost, self.bad = 0, 0, 0
        self._last: PoseFrame | None = None
        self._recent: deque[tuple[float, frozenset[str]]] = deque()
        self._newest_s = 0.0

    def take(self, receiver: socket.socket, now: float) -> PoseFrame | None:
        """Return the newest pose waiting at a non-blocking socket; `now` is on a monotonic clock, seconds."""
        newest = None
        for _ in range(1000):  # limited, so that a flood of datagrams cannot stop the picture
            try:
                datagram = receiver.recv(65536)
            except OSError:
                break
            try:
                newest = self._add(decode(datagram), now) or newest
            except EdgeposeError:
                self.bad += 1
        while self._recent and self._recent[0][0] < now - WINDOW_S:
            self._recent.popleft()
        return newest

    def _add(self, pose: PoseFrame, now: float) -> PoseFrame | None:
        if self._last is not None:
            step = pose.index - self._last.index
            if -60 < step <= 0:  # late or duplicated; further back is a new run
                return None
            self.lost += max(0, step - 1)
        self.poses += 1
        self._last, self._newest_s = pose, now
        self._recent.append((now, pose.held))
        return pose

    def text(self, now: float) -> str:
        """Return Markdown about the poses so far."""
        if self._last is None:
            bad = f"; {self.bad} datagrams were not poses" if self.bad else ""
            return f"waiting for poses{bad}"
        span = min(WINDOW_S, max(1.0, now - self._recent[0][0])) if self._recent else WINDOW_S
        rate = len(self._recent) / span
        held = held_sensors([held for _, held in self._recent])
        silent = now - self._newest_s
        state = plain(self._last.status) if silent < 1.0 else f"nothing for {silent:.0f} s"
        counts = [f"{rate:.0f} poses/s", f"{self.poses} poses", f"{self.lost} lost"]
        counts += [f"{self.bad} bad"] if self.bad else []
        return f"{', '.join(counts)}\n\n**{state}**\n\n{sensor_table(held, rate or 60.0)}"


def plain(status: str) -> str:
    """Remove from a status, which anyone may have sent, everything that a browser could interpret."""
    return re.sub(r"[^A-Za-z0-9_ ;]", "?", status[:200])


def sensor_table(held: NDArray[np.bool_], rate: float) -> str:
    """Format a Markdown table of the sensors in the last poses: held (N, 6), oldest first.

    A held sensor has sent nothing new for a pose, so the table shows rates up to that of the poses.
    """
    lines = ["| sensor | new/s | longest gap | now |", "|---|--:|--:|---|"]
    for name, column, longest in zip(PLACEMENTS, held.T, longest_holds(held), strict=True):
        new = rate * float((~column).mean()) if len(column) else 0.0
        gap = longest / rate
        now = "held" if len(column) and column[-1] else "ok"
        lines.append(f"| {name.replace('_', ' ')} | {new:.0f} | {f'{gap:.2f} s' if gap else '-'} | {now} |")
    return "\n".join(lines)
