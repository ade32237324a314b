"""Timing of samples and of their arrival: period, jitter, losses, delay."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from edgepose.diagnostics.sensor_health.columns import ARRIVAL, TIME
from edgepose.rotations import Array

_GAP = 1.5  # periods
_SETTLE_S, _LATE_LEAST_S = 2.0, 3.0  # the first packets have waited in the system's buffers


class TimingResult(NamedTuple):
    """Fields of `SensorHealth`."""

    age_s: float
    rate_hz: float
    jitter_ms: float
    lost: int
    lost_percent: float
    late_ms: float


class Timing:
    """Measures the period of the samples and counts missing ones.

    Attributes:
        period_s: mean interval between samples, without gaps, seconds; NaN until it is known.
    """

    def __init__(self) -> None:
        """Start with no samples."""
        self.period_s = self._jitter_s = math.nan
        self._lost = 0

    def update(self, window: Array, fresh: int) -> None:
        """Measure the window (n, 15), whose last `fresh` rows are new."""
        times = window[:, TIME]
        intervals = np.diff(times)
        middle = float(np.median(intervals))
        if not middle > 0.0:
            return
        steps = intervals / middle
        # A long interval only means missing samples if nearly all intervals are multiples of one.
        regular = np.mean(np.abs(steps - np.round(steps)) < 0.2) > 0.9
        usual = intervals[steps < _GAP] if regular else intervals
        if not usual.mean() > middle / 10.0:  # times go to and fro
            return
        self.period_s, self._jitter_s = float(usual.mean()), float(usual.std())
        if regular:
            steps = np.diff(times[-fresh - 1 :]) / self.period_s
            self._lost += int(np.round(steps[steps > _GAP] - 1.0).sum())

    def result(self, window: Array, samples: int, first_s: float, now_s: float) -> TimingResult:
        """Return the result at a time.

        Args:
            window: (n, 15) newest rows, at least one.
            samples: number of all samples so far.
            first_s: time of the first of all samples.
            now_s: current time.
        """
        return TimingResult(
            max(0.0, now_s - float(window[-1, TIME])),
            1.0 / self.period_s,
            1e3 * self._jitter_s,
            self._lost,
            100.0 * self._lost / (self._lost + samples),
            1e3 * _late_s(window[window[:, TIME] > first_s + _SETTLE_S]),
        )


def _late_s(rows: Array) -> float:
    """Return the delay of most packets against the fastest ones, once the device's clock is known."""
    if not len(rows) or rows[-1, TIME] - rows[0, TIME] < _LATE_LEAST_S:
        return math.nan
    low, high = np.percentile(rows[:, ARRIVAL] - rows[:, TIME], [5, 95])
    return float(high - low)
