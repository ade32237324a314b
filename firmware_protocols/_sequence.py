"""Losses by the counters that devices send with their packets."""

from __future__ import annotations

from firmware_protocols.sample import Counters

# A counter of 16 bits can be believed if the pause between two packets is too short for it to go around at
# the highest rate (2 kHz: 33 s) and the step is no larger than that rate allows, plus some for a coarse
# clock.
MAX_PAUSE_US = 30_000_000
_MIN_PERIOD_US = 500
_SLACK = 64
_LATE_US = 1_000_000
_MAX_STEP = 1000  # without a clock


class Sequence:
    """Counts what is missing in the 16 bit packet counters of up to 256 sensors on a line."""

    def __init__(self, counters: Counters, wrap_us: int) -> None:
        """Count into `counters`; device clocks wrap at `wrap_us`."""
        self._counters = counters
        self._wrap_us = wrap_us
        self._last: dict[int, tuple[int, int | None]] = {}  # count, time by sensor

    def is_new(self, sensor: int, count: int, time_us: int | None) -> bool:
        """If a packet is none that came before; losses are counted."""
        last_count, last_us = self._last.get(sensor, (count - 1, time_us))
        step = (count - last_count) & 0xFFFF
        back = -step & 0xFFFF
        if time_us is None or last_us is None:
            late = back <= _SLACK
            believable = step <= _MAX_STEP
        else:
            half = self._wrap_us // 2
            pause = (time_us - last_us + half) % self._wrap_us - half
            late = -_LATE_US <= pause <= 0 and back <= _SLACK
            believable = (
                -_LATE_US <= pause <= MAX_PAUSE_US and step <= _SLACK + max(pause, 0) // _MIN_PERIOD_US
            )
        if late:
            self._counters.late += 1
            return False
        self._last[sensor] = (count, time_us)
        if believable:
            # A step of 0 with a new time is a sensor that does not count.
            self._counters.lost += max(step - 1, 0)
        else:
            self._counters.restarts += 1
        return True


def count_byte(counters: Counters, last: int | None, count: int) -> None:
    """Count what is missing between two packets by an 8 bit counter.

    The same count again is a device that does not count, half of the range or more a restart. Nothing is
    late: a counter this short cannot tell.
    """
    step = 0 if last is None else (count - last) & 0xFF
    if step > 128:
        counters.restarts += 1
    else:
        counters.lost += max(step - 1, 0)
