"""One Sample of messages that a device sends apart.

By their times: `MessagePairer`. By the order in which they come, where they have none: HiPNUC on CAN and
WitMotion, with `CycleDetector`. The MTi-600 (time or group counter) and the native packet on CAN have rules
of their own.
"""

from __future__ import annotations

from collections.abc import Iterable

from firmware_protocols._recent import BoundedDict
from firmware_protocols.sample import Counters, Sample


class CycleDetector:
    """What a device sends in every cycle, as far as two cycles show it."""

    def __init__(self) -> None:
        """Nothing is usual yet."""
        self._before: frozenset[str] = frozenset()
        self._last: frozenset[str] = frozenset()

    def whole(self, quantities: Iterable[str]) -> bool:
        """If a cycle has all that both before it had; it is then the last one."""
        now = frozenset(quantities)
        usual = self._before & self._last
        self._before, self._last = self._last, now
        return usual <= now


class MessagePairer:
    """Pairs orientation and inertial messages of a sensor that belong to the same instant.

    The message that comes first is held until its partner of the same time comes. If one of another time
    comes instead, the partner is lost (or never sent), and what is held goes out alone: nothing is ever
    combined with the partner of another instant.
    """

    def __init__(self, counters: Counters, tolerance_us: int = 0, wrap_us: int = 1 << 64) -> None:
        """Nothing held.

        Args:
            counters: `skipped` and `packets` are counted here.
            tolerance_us: how far apart the two times may be; keep it below half of the sampling period.
            wrap_us: where the device's clock starts again from 0.
        """
        self.counters = counters
        self.tolerance_us = tolerance_us
        self._wrap_us = wrap_us
        self._held: BoundedDict[int, tuple[bool, Sample]] = BoundedDict()
        self._done: BoundedDict[int, int] = BoundedDict()

    def add(self, sample: Sample, oriented: bool) -> list[Sample]:
        """The samples that this message completes; oriented says if it is the orientation of its instant."""
        sensor, time_us = sample.sensor, sample.time_us
        assert time_us is not None
        held = self._held.get(sensor)
        if held is None:
            if self._done.get(sensor) == time_us:
                # A second form of an orientation that has gone out already.
                self.counters.skipped += 1
                return []
            self._held[sensor] = (oriented, sample)
            return []
        held_oriented, other = held
        assert other.time_us is not None
        apart = abs(time_us - other.time_us)
        apart = min(apart, self._wrap_us - apart)
        if held_oriented == oriented:
            if not apart:
                # L or E beside Q: the first one stays, with the force of the second if it has none.
                if other.acc is None and sample.acc is not None:
                    self._held[sensor] = (oriented, other._replace(acc=sample.acc))
                self.counters.skipped += 1
                return []
        elif apart <= self.tolerance_us:
            del self._held[sensor]
            self._done[sensor] = time_us
            turn, inertial = (sample, other) if oriented else (other, sample)
            self.counters.packets += 1
            return [
                Sample(
                    sensor,
                    turn.time_us,
                    turn.quat,
                    turn.acc if inertial.acc is None else inertial.acc,
                    turn.gyr if inertial.gyr is None else inertial.gyr,
                    inertial.mag,
                    inertial.temperature,
                )
            ]
        self._held[sensor] = (oriented, sample)
        self.counters.packets += 1
        return [other]

    def flush(self) -> list[Sample]:
        """Everything held, each as a sample of its own; for the end of a recording."""
        samples = [sample for _, sample in self._held.values()]
        self._held.clear()
        self.counters.packets += len(samples)
        return samples
