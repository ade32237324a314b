"""Detection of lost packets by the counters that devices send."""

from __future__ import annotations

from firmware_protocols.sample import Counters

# A step of a 16 bit counter is believable if the pause between two packets is too short for the counter to
# wrap at the highest rate (2 kHz: 33 s), and if it is no larger than this rate allows, plus some slack for a
# coarse clock.
MAX_PAUSE_US = 30_000_000
_MIN_PERIOD_US = 500
_SLACK = 64
_LATE_US = 1_000_000
_MAX_STEP = 1000  # without a clock


class Sequence:
    """Counts missing packets by the 16 bit packet counters of up to 256 sensors on a line."""

    def __init__(self, counters: Counters, wrap_us: int) -> None:
        """Count into `counters`; device clocks wrap at `wrap_us`."""
        self._counters = counters
        self._wrap_us = wrap_us
        self._last: dict[int, tuple[int, int | None]] = {}  # count, time by sensor

    def is_last(self, sensor: int, count: int) -> bool:
        """Return whether a count is that of a sensor's last new packet."""
        return sensor in self._last and self._last[sensor][0] == count

    def is_new(self, sensor: int, count: int, time_us: int | None) -> bool:
        """Return whether a packet is neither a duplicate nor late, and count the packets lost before it."""
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
            # A step of 0 with a new time means that the sensor does not count.
            self._counters.lost += max(step - 1, 0)
        else:
            self._counters.restarts += 1
        return True


def count_byte(counters: Counters, last: int | None, count: int) -> None:
    """Count the packets missing between two others by their 8 bit counter.

    An unchanged count means that the device does not count, a step of more than half the range is a restart.
    No packet counts as late: the counter is too short to tell.
    """
    step = 0 if last is None else (count - last) & 0xFF
    if step > 128:
        counters.restarts += 1
    else:
        counters.lost += max(step - 1, 0)
