"""Watch over a rig at the start of a run, for faults of sensors that make poses wrong without any sign."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from edgepose.diagnostics.rules import MAKE_POSES_WRONG, diagnose
from edgepose.diagnostics.sensor_health import WINDOW_S, SensorHealthMonitor
from edgepose.imu import ImuSample
from edgepose.placements import PLACEMENTS

WATCHED_S = 60.0
"""Length of the watch, seconds: its cost is small, but there is little left to see after that."""

_EVERY_S = 2.0
"""Time between two judgements of a rig, seconds."""

_EVERY_S_PER_RIG = 1.0
"""Least time between judgements of the rigs of one process, seconds, so that they hold up no poses."""


class RigMonitor:
    """Checks samples like `edgepose check`, and reports each fault once, in the same words.

    More than ten rigs of one process are watched in turns, each for the time of `WINDOW_S` and from scratch.
    """

    def __init__(self, names: Sequence[str] = PLACEMENTS, phase: float = 0.0, rigs: int = 1) -> None:
        """Start the watch with the first samples.

        Args:
            names: sensors of the rig.
            phase: from 0 to 1, makes several rigs of one process take turns: a judgement takes as long as a
                frame lasts.
            rigs: number of rigs of this process; many are judged less often.
        """
        self._names = names
        self._every_s = max(_EVERY_S, _EVERY_S_PER_RIG * rigs)
        self._first_s = min(self._every_s, WINDOW_S) + phase * self._every_s
        self._health: SensorHealthMonitor | None = self._new_health()
        self._start_s = self._next_s = math.nan
        self._now_s = math.nan
        self._reported: set[tuple[str, str]] = set()

    def _new_health(self) -> SensorHealthMonitor:
        return SensorHealthMonitor(names=self._names, fold_s=self._every_s)

    def add(self, samples: Iterable[ImuSample], now_s: float) -> list[str]:
        """Take samples as they were measured, and return a line on each fault that has become clear.

        Args:
            samples: of any sensors.
            now_s: time up to which all samples have been added, seconds.
        """
        if self._health is None:
            return []
        if math.isnan(self._start_s):
            self._start_s, self._next_s = now_s, now_s + self._first_s
        if self._every_s > WINDOW_S and now_s < self._next_s - WINDOW_S:
            return []  # it is the turn of others
        self._health.add(samples)
        self._now_s = now_s
        if now_s < self._next_s:
            return []
        self._next_s = now_s + self._every_s
        lines = self.judge()
        if now_s - self._start_s > WATCHED_S:
            self._health = None
        elif self._every_s > WINDOW_S:
            self._health = self._new_health()
        return lines

    def judge(self) -> list[str]:
        """Return a line on each fault that has not been reported yet."""
        if self._health is None or math.isnan(self._now_s):
            return []
        lines = []
        for sensor in self._health.report(self._now_s):
            if sensor.placement not in self._names:
                continue
            finding = diagnose(sensor)
            key = (sensor.placement, finding.name)
            if finding.name in MAKE_POSES_WRONG and key not in self._reported:
                self._reported.add(key)
                lines.append(f"warning: {sensor.placement}: {finding.advice}")
        return lines
