"""Checks of one sensor's samples before filtering: numbers, time stamps, gaps, saturation."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf

from edgepose.orientation.settings import FilterSettings
from edgepose.orientation.types import Event

_MAX_RATE, _MAX_FORCE, _MAX_FIELD = 1e3, 1e4, 1e6  # rad/s, m/s^2, uT: no sensor measures more
_LONGEST_PERIOD_S = 0.04  # 25 Hz
_BACK_S = 1.0
_FOLLOW = 0.05
_LEAST_PEAK_RATE, _LEAST_PEAK_FORCE = 4.0, 19.0  # ranges end above 250 deg/s and 2 g

_GAP, _BAD, _STAMP, _SATURATED = (int(e) for e in (Event.GAP, Event.BAD, Event.STAMP, Event.SATURATED))


class SampleChecker:
    """Judges each sample of a sensor by the ones before it.

    Attributes:
        period_s: usual time between samples.
    """

    def __init__(self, settings: FilterSettings) -> None:
        """Create the checker; the first sample starts it."""
        self.period_s = _LONGEST_PERIOD_S
        self._settings = settings
        self._time_s: float | None = None
        self._rate_peak, self._force_peak = _LEAST_PEAK_RATE, _LEAST_PEAK_FORCE
        self._rate = self._force = 0.0  # largest components of the last good sample

    def check(self, time_s: float, gyr: Sequence[float], acc: Sequence[float]) -> tuple[int, float]:
        """Return the events of a sample, and the time since the last good one, s.

        The time is 0 if the sample is to be skipped, and inf if the filter has to restart: at the first
        sample, after a long gap, and when the device's clock has restarted.
        """
        a, b, c = gyr
        x, y, z = acc
        a, b, c, x, y, z = abs(a), abs(b), abs(c), abs(x), abs(y), abs(z)
        # Sums, because NaN compares false to everything.
        if not (a + b + c < _MAX_RATE and x + y + z < _MAX_FORCE and -inf < time_s < inf):
            return _BAD, 0.0
        rate, force = max(a, b, c), max(x, y, z)
        events = 0
        if rate > _LEAST_PEAK_RATE or force > _LEAST_PEAK_FORCE:
            events = self._saturation(rate, force)
        self._rate, self._force = rate, force
        if self._time_s is None:
            self._time_s = time_s
            return events, inf
        step_s = time_s - self._time_s
        if step_s <= 0.0:
            if step_s < -_BACK_S:
                self._time_s = time_s
                return events | _STAMP, inf
            return events | _STAMP, 0.0
        self._time_s = time_s
        if step_s > self._settings.gap_periods * self.period_s:
            events |= _GAP
        # The limit keeps gaps from raising the period fast.
        self.period_s += _FOLLOW * (min(step_s, 2.0 * self.period_s, _LONGEST_PERIOD_S) - self.period_s)
        return events, inf if step_s > self._settings.restart_s else step_s

    def _saturation(self, rate: float, force: float) -> int:
        """Check whether the largest value so far came twice in a row: within the range, noise prevents it."""
        end = (rate >= self._rate_peak and rate == self._rate) or (
            force >= self._force_peak and force == self._force
        )
        self._rate_peak = max(self._rate_peak, rate)
        self._force_peak = max(self._force_peak, force)
        return _SATURATED if end or force > self._settings.shock else 0


class MagnetometerMonitor:
    """Detects whether one sensor's magnetometer is present, and when it drops out.

    Attributes:
        seen: there was a field.
        lost: there was a field, but none for too long.
    """

    def __init__(self, settings: FilterSettings) -> None:
        """Start with no field seen."""
        self.seen = self.lost = False
        self._longest_s = settings.mag_lost_s
        self._since_s = 0.0

    def check(self, dt: float, mag: Sequence[float]) -> bool:
        """Return whether `mag` is a valid field; `dt` is the time since the sample before, s."""
        # Sum, because NaN compares false to everything.
        if 0.0 < abs(mag[0]) + abs(mag[1]) + abs(mag[2]) < _MAX_FIELD:
            self._since_s = 0.0
            self.seen, self.lost = True, False
            return True
        self._since_s += dt
        self.lost = self.seen and self._since_s > self._longest_s
        return False
