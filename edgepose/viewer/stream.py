"""Poses as they come over UDP, and the text beside the figure."""

from __future__ import annotations

import math
import re
import socket
import time
from collections import deque
from collections.abc import Sequence
from statistics import median
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError
from edgepose.placements import PLACEMENTS
from edgepose.pose import PoseFrame, held_sensors, known_sensors, longest_holds
from edgepose.sinks.udp import decode

WINDOW_S = 5.0
"""Time over which rates and gaps are computed, seconds."""


STILL_DEG, STILL_S = 0.5, 3.0
"""Angle by which no joint has turned for this time, if nothing moves: people sway more."""

MOST_LATE_S = 10.0
"""Age from which on a pose is no pose of this moment, but of a recording or another clock."""


class _Recent(NamedTuple):
    """Arrival of a pose, its held sensors, and its age then by the clock of this machine."""

    arrival_s: float
    held: frozenset[str]
    age_s: float


class UdpPoseStream:
    """Receives poses as datagrams, with statistics of the last seconds."""

    def __init__(self, now: float) -> None:
        """Start with no poses; `now` is on a monotonic clock, seconds."""
        self.poses, self.lost, self.bad = 0, 0, 0
        self._last: PoseFrame | None = None
        self._recent: deque[_Recent] = deque()
        self._newest_s = self._moved_s = now
        self._moved = np.zeros((24, 3, 3))  # pose when something moved last

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
        while self._recent and self._recent[0].arrival_s < now - WINDOW_S:
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
        self._recent.append(_Recent(now, pose.held, time.time() - pose.time_s))
        cosines = (np.einsum("jab,jab->j", self._moved, pose.rotations) - 1.0) / 2.0
        if cosines.min() < math.cos(math.radians(STILL_DEG)):
            self._moved, self._moved_s = pose.rotations.astype(float), now
        return pose

    def text(self, now: float) -> str:
        """Return Markdown about the poses so far."""
        if self._last is None:
            bad = f"; {self.bad} datagrams were not poses" if self.bad else ""
            waited = now - self._newest_s
            long = f" for {waited:.0f} s: do the sensors send?" if waited >= STILL_S else ""
            return f"waiting for poses{long}{bad}"
        span = min(WINDOW_S, max(1.0, now - self._recent[0].arrival_s)) if self._recent else WINDOW_S
        rate = len(self._recent) / span
        names = known_sensors([recent.held for recent in self._recent])
        held = held_sensors([recent.held for recent in self._recent], names)
        counts = [f"{rate:.0f} poses/s", f"{self.poses} poses", f"{self.lost} lost"]
        counts += [f"{self.bad} bad"] if self.bad else []
        counts += self._latency()
        return f"{', '.join(counts)}\n\n**{self._state(now)}**\n\n{sensor_table(held, rate or 60.0, names)}"

    def _state(self, now: float) -> str:
        """Return the status of the newest pose, and whether anything comes and moves."""
        assert self._last is not None
        if (silent := now - self._newest_s) >= 1.0:
            return f"nothing for {silent:.0f} s: do the sensors send?"
        still = now - self._moved_s
        return plain(self._last.status) + (
            f", nothing has moved for {still:.0f} s" if still >= STILL_S else ""
        )

    def _latency(self) -> list[str]:
        """Return the median age of the last poses; nothing if they are no poses of this moment."""
        ages = [recent.age_s for recent in self._recent]
        age_s = median(ages) if ages else math.inf
        return [f"{age_s * 1e3:.0f} ms late"] if 0.0 <= age_s < MOST_LATE_S else []


def plain(status: str) -> str:
    """Remove from a status, which anyone may have sent, everything that a browser could interpret."""
    return re.sub(r"[^A-Za-z0-9_ ;]", "?", status[:200])


def sensor_table(held: NDArray[np.bool_], rate: float, names: Sequence[str] = PLACEMENTS) -> str:
    """Format a Markdown table of the sensors with these names in the last poses: held (T, N), oldest first.

    A held sensor has sent nothing new for a pose, so the table shows rates up to that of the poses.
    """
    lines = ["| sensor | new/s | longest gap | now |", "|---|--:|--:|---|"]
    for name, column, longest in zip(names, held.T, longest_holds(held), strict=True):
        new = rate * float((~column).mean()) if len(column) else 0.0
        gap = longest / rate
        now = "held" if len(column) and column[-1] else "ok"
        lines.append(f"| {name.replace('_', ' ')} | {new:.0f} | {f'{gap:.2f} s' if gap else '-'} | {now} |")
    return "\n".join(lines)
