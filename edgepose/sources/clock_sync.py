"""Mapping of device clocks to the source's clock, free of arrival jitter, robust to drift and reboots.

A device stamps samples with microseconds that start at any value and wrap (in native packets after 71.6
minutes). Samples without time stamps are timed by their arrivals.
"""

from __future__ import annotations

from collections import deque
from math import inf, nan

import numpy as np

WRAP_US = 1 << 32
"""Value at which the clocks of native packets wrap, microseconds."""

STEP_S = 1e-6
"""Smallest step between two times of one sensor, seconds."""

FOLLOWED_PPM = 200.0
"""Largest drift of a device's clock that is followed, parts per million."""

_LATE_S, _LATE_FOR_S = 0.05, 1.0  # lateness, and for how long, that restarts the offset
_DRIFT_S, _DRIFT_BLOCKS, _DRIFT_LEAST = 1.0, 120, 8  # drift is fitted to the fastest arrival of each second
_AHEAD_S, _BACK_S = 1.0, 0.1  # jumps ahead and back that are reboots

# Gains of ArrivalClock: of the times for early and for late arrivals, and of the period.
_PULL_BACK, _PULL_ON, _PULL_PERIOD = 0.5, 0.05, 0.02
_FIRST = 16  # arrivals that give the first estimate of the period
_CHECK, _WRONG = 50, 0.1  # arrivals between checks of the period, and the relative error that resets it
_UNEVEN_S = 0.02  # a USB converter delivers every 16 ms
_SHORTEST_S = 0.0005  # period
_PAUSE_S, _PAUSE_PERIODS = 0.25, 4.0


def unwrap(t_us: int, expected_s: float, wrap_us: int = WRAP_US) -> float:
    """Unwrap a microsecond clock to the seconds nearest to the expected time."""
    wraps = round((expected_s * 1e6 - t_us) / wrap_us)
    return (t_us + wraps * wrap_us) * 1e-6


class DeviceClock:
    """Maps the clock of one sensor to host time.

    A packet can come late but never early, so `arrival - device time` is the clocks' offset plus a delay that
    is often near its smallest value. The offset is therefore a leaky minimum: it drops at once and rises by
    200 ppm, more than quartz clocks drift apart. The offset is estimated from scratch if the device rebooted
    (its time jumps back, or ahead of the time that has passed here) or has been late by more than 50 ms for a
    whole second (its clock was stopped, or is worse than quartz).

    Attributes:
        resets: number of times the offset was estimated from scratch.
    """

    def __init__(self, wrap_us: int = WRAP_US) -> None:
        """Create the clock; device times wrap at wrap_us."""
        self.resets = 0
        self._wrap_us = wrap_us
        self._started = False
        self._device_s = 0.0  # newest device time, unwrapped
        self._arrival_s = 0.0
        self._offset = 0.0
        self._result = 0.0
        self._window_s = 0.0  # arrival time at which the present watch for lateness began
        self._least_late = 0.0
        # Per second since the last reset: its start, and the least arrival minus device time in it.
        self._fastest: deque[tuple[float, float]] = deque(maxlen=_DRIFT_BLOCKS)
        self._least_delay_s, self._block_end_s = inf, -inf  # of the last of them

    def host_time(self, t_us: int, arrival_s: float) -> float:
        """Return the host time of a measurement, seconds; always later than the previous call's result.

        Args:
            t_us: device time, microseconds modulo wrap_us.
            arrival_s: host time at which the packet came, seconds.
        """
        if not self._started:
            self._started = True
            self._restart(t_us, arrival_s)
            self._result = arrival_s
            return arrival_s
        # Written out, without min, max and further calls: there are ten packets in a frame.
        device_s = time_s = unwrap(t_us, self._device_s + arrival_s - self._arrival_s, self._wrap_us)
        step = device_s - self._device_s
        late = arrival_s - device_s - self._offset
        if step < -_BACK_S or late < -_AHEAD_S:
            self.resets += 1
            self._restart(t_us, arrival_s)
            time_s = self._device_s
        elif step > 0:
            if arrival_s - self._arrival_s > _LATE_FOR_S:
                # One late packet after a pause proves nothing; a second of late packets does.
                self._window_s, self._least_late = arrival_s, inf
            self._device_s, self._arrival_s = device_s, arrival_s
            if arrival_s - device_s < self._least_delay_s or arrival_s >= self._block_end_s:
                self._add_delay(arrival_s, arrival_s - device_s)
            rise = FOLLOWED_PPM * 1e-6 * step
            if late < rise:
                rise = late  # negative if this packet came faster than any before
            self._offset += rise
            if late - rise < self._least_late:
                self._least_late = late - rise
            if arrival_s - self._window_s > _LATE_FOR_S:
                if self._least_late > _LATE_S:
                    self.resets += 1
                    self._offset += self._least_late
                    self._clear_delays()
                self._window_s, self._least_late = arrival_s, inf
        else:
            time_s = unwrap(t_us, self._device_s, self._wrap_us)
        # Not the arrival: a packet can be measured long before it comes.
        result, soonest_s = time_s + self._offset, self._result + STEP_S
        self._result = result if result > soonest_s else soonest_s
        return self._result

    def drift_ppm(self) -> tuple[float, float]:
        """Return the device clock's loss against the host's and its standard error, parts per million.

        Both are NaN in the first seconds.
        """
        if len(self._fastest) < _DRIFT_LEAST:
            return nan, nan
        fastest = np.array(self._fastest)
        arrival_s, delay_s = (fastest - fastest.mean(axis=0)).T
        square = float(arrival_s @ arrival_s)
        slope = float(arrival_s @ delay_s) / square
        residuals = delay_s - slope * arrival_s
        error = float(np.sqrt(residuals @ residuals / (len(residuals) - 2) / square))
        return 1e6 * slope, 1e6 * error

    def _add_delay(self, arrival_s: float, delay_s: float) -> None:
        self._least_delay_s = delay_s
        if arrival_s < self._block_end_s:
            self._fastest[-1] = (self._fastest[-1][0], delay_s)
        else:
            self._block_end_s = arrival_s + _DRIFT_S
            self._fastest.append((arrival_s, delay_s))

    def _clear_delays(self) -> None:
        self._fastest.clear()
        self._block_end_s = -inf

    def _restart(self, t_us: int, arrival_s: float) -> None:
        self._clear_delays()
        self._device_s = t_us * 1e-6
        self._arrival_s = self._window_s = arrival_s
        self._offset = arrival_s - self._device_s
        self._least_late = inf


class ArrivalClock:
    """Times one sensor's samples by their arrivals, smoothed, if the device sends no time stamps.

    The sensor is assumed to have a steady rate, which is followed: samples that a line delivers all at once
    are timed one period apart. As no sample comes before it was measured, an early arrival corrects the times
    at once, a late one slowly, unless it is so late that samples must be missing. After a pause the times
    start again from the arrival. A period estimated from buffered samples, which come at no steady rate, is
    detected and replaced.
    """

    def __init__(self) -> None:
        """Create the clock."""
        self._count = 0
        self._checked = (0, 0.0)  # count and arrival at the last check of the period
        self._mean_s = 0.0  # mean interval before that check
        self._first_s = 0.0
        self._period_s = 0.0
        self._result = -inf

    def host_time(self, arrival_s: float) -> float:
        """Return the host time of a measurement, seconds; always later than the previous call's result."""
        self._count += 1
        expected_s = self._result + self._period_s
        late = arrival_s - expected_s
        if self._correct_period(arrival_s):
            time_s = arrival_s
        elif self._count == 1:
            self._first_s = time_s = arrival_s
        elif late > max(_PAUSE_S, _PAUSE_PERIODS * self._period_s):
            # A period that is known already is kept.
            if self._count <= _FIRST:
                self._count, self._first_s = 1, arrival_s
            self._checked = (self._count, arrival_s)
            time_s = arrival_s
        elif self._count <= _FIRST:
            if self._count == _FIRST:
                self._period_s = max((arrival_s - self._first_s) / (_FIRST - 1), _SHORTEST_S)
            time_s = arrival_s
        else:
            if late > max(_UNEVEN_S, 0.6 * self._period_s):
                missing = round(late / self._period_s) * self._period_s
                expected_s += missing
                late -= missing
            pull = late * (_PULL_BACK if late < 0.0 else _PULL_ON)
            self._period_s = max(self._period_s + _PULL_PERIOD * pull, _SHORTEST_S)
            time_s = expected_s + pull
        self._result = max(self._result + STEP_S, time_s)
        return self._result

    def _correct_period(self, arrival_s: float) -> bool:
        """Replace the period if recent arrivals show that it is far off; return whether it was replaced."""
        count, checked_s = self._checked
        if self._count - count < _CHECK:
            return False
        before_s, self._mean_s = self._mean_s, (arrival_s - checked_s) / (self._count - count)
        self._checked = (self._count, arrival_s)
        # Two stretches must agree: a single one may contain a gap or a burst.
        if abs(self._mean_s - before_s) > _WRONG * before_s:
            return False
        if abs(self._mean_s - self._period_s) <= _WRONG * self._period_s or self._mean_s < _SHORTEST_S:
            return False
        self._period_s = self._mean_s
        return True


class HostClocks:
    """The clocks of all sensors on a line with known arrival times.

    Attributes:
        devices: clocks of the sensors that send a time.
    """

    def __init__(self, wrap_us: int, devices: dict[int, DeviceClock] | None = None) -> None:
        """Create the clocks; device times wrap at wrap_us, and `devices` gets the clocks."""
        self.devices = {} if devices is None else devices
        self._arrivals: dict[int, ArrivalClock] = {}
        self._wrap_us = wrap_us

    @property
    def restarts(self) -> dict[int, int]:
        """Number of times that each sensor's clock was estimated from scratch."""
        return {sensor: clock.resets for sensor, clock in self.devices.items()}

    def time(self, sensor: int, t_us: int | None, arrival_s: float) -> float:
        """Return the host time of a measurement, seconds; t_us is None if the device sends no time."""
        if t_us is not None:
            clock = self.devices.get(sensor)
            if clock is None:
                clock = self.devices[sensor] = DeviceClock(self._wrap_us)
            return clock.host_time(t_us, arrival_s)
        arrivals = self._arrivals.get(sensor)
        if arrivals is None:
            arrivals = self._arrivals[sensor] = ArrivalClock()
        return arrivals.host_time(arrival_s)


class CaptureClock:
    """Device clocks of a raw capture without arrival times: the first sensor's clock is the reference.

    Another sensor's clock that starts more than a second away from it, and any clock that jumps back or ahead
    (reboot; a pause over a minute), is set to the newest time reached.

    Attributes:
        restarts: number of times that each sensor's clock was set in this way after its first sample.
    """

    def __init__(self, wrap_us: int = WRAP_US) -> None:
        """Create the clocks; device times wrap at wrap_us."""
        self.restarts: dict[int, int] = {}
        self._wrap_us = wrap_us
        self._now: float | None = None
        self._offsets: dict[int, float] = {}
        self._last: dict[int, float] = {}  # result of each sensor's last packet

    def time(self, sensor: int, t_us: int) -> float:
        """Return the time of a measurement, seconds; always later than the sensor's previous one."""
        last = self._last.get(sensor)
        now = t_us * 1e-6 if self._now is None else self._now
        offset = self._offsets.get(sensor, 0.0)
        result = unwrap(t_us, (now if last is None else last) - offset, self._wrap_us) + offset
        jumped = abs(result - now) > 1.0 if last is None else not -_BACK_S < result - last < 60.0
        if jumped:
            if last is not None:
                self.restarts[sensor] = self.restarts.get(sensor, 0) + 1
            self._offsets[sensor] = now - t_us * 1e-6
            result = now
        if last is not None:
            result = max(result, last + STEP_S)
        self._last[sensor] = result
        self._now = max(now, result)
        return result
