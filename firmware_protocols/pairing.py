"""Assembly of one Sample from messages that a device sends separately.

`MessagePairer` and `InstantMerger` go by the times of the messages. HiPNUC on CAN and WitMotion have no times
and go by order, with `CycleDetector`. The MTi-600 (time or group counter) and the native packet on CAN have
their own rules.
"""

from __future__ import annotations

from collections.abc import Iterable

from firmware_protocols._recent import BoundedDict
from firmware_protocols.sample import Counters, Sample


class CycleDetector:
    """Learns from the last two cycles which quantities a device sends in every cycle."""

    def __init__(self) -> None:
        """Start without known quantities."""
        self._before: frozenset[str] = frozenset()
        self._last: frozenset[str] = frozenset()

    def is_complete(self, quantities: Iterable[str]) -> bool:
        """Return whether a cycle has all quantities that both previous ones had, and remember the cycle."""
        now = frozenset(quantities)
        usual = self._before & self._last
        self._before, self._last = self._last, now
        return usual <= now


class InstantMerger:
    """Merges messages of one sensor and one instant that hold different quantities.

    It learns which quantities come in every instant, and returns a sample as soon as it has these. Messages
    with the same quantities are never merged.
    """

    _USED = ("quat", "acc", "gyr", "mag")

    def __init__(self) -> None:
        """Start without held messages."""
        self._held: BoundedDict[int, tuple[int, Sample]] = BoundedDict()
        self._last: BoundedDict[int, tuple[int, frozenset[str]]] = BoundedDict()  # the last returned
        self._usual: BoundedDict[int, frozenset[str]] = BoundedDict()

    def completes(self, sample: Sample, instant: int) -> bool:
        """Return whether a message belongs to an instant that is held, or was returned without it."""
        names = self._names(sample)
        if not names:
            return False
        held = self._held.get(sample.sensor)
        if held is not None:
            return held[0] == instant and names.isdisjoint(self._names(held[1]))
        last = self._last.get(sample.sensor)
        return last is not None and last[0] == instant and names.isdisjoint(last[1])

    def add(self, sample: Sample, instant: int) -> list[Sample]:
        """Return the samples that a message completes, in order.

        Args:
            sample: content of the message.
            instant: time or count that all messages of one instant share.
        """
        sensor, result = sample.sensor, []
        if not self._names(sample):
            return [sample]
        completes = self.completes(sample, instant)
        held = self._held.pop(sensor, None)
        if held is not None and completes:
            sample = _merged(held[1], sample)
        elif completes:
            # The sample has been returned without it: wait for all of it from now on.
            self._usual[sensor] = self._last[sensor][1] | self._names(sample)
            self._last[sensor] = (instant, self._usual[sensor])
            return []
        elif held is not None:
            result.append(self._finish(*held))
        usual = self._usual.get(sensor, frozenset(("quat", "acc", "gyr")))
        if usual <= self._names(sample):
            result.append(self._finish(instant, sample))
        else:
            self._held[sensor] = (instant, sample)
        return result

    def flush(self) -> list[Sample]:
        """Return the held messages; for the end of a recording."""
        samples = [sample for _, sample in self._held.values()]
        self._held.clear()
        return samples

    def _finish(self, instant: int, sample: Sample) -> Sample:
        now = self._names(sample)
        before = self._last[sample.sensor][1] if sample.sensor in self._last else now
        # A magnetometer may be slower than the rest; without one of the others a message was lost.
        self._usual[sample.sensor] = (before | now) - ({"mag"} if "mag" not in before & now else set())
        self._last[sample.sensor] = (instant, now)
        return sample

    def _names(self, sample: Sample) -> frozenset[str]:
        return frozenset(name for name in self._USED if getattr(sample, name) is not None)


def _merged(one: Sample, other: Sample) -> Sample:
    """Return a sample with the quantities of both; the first one's where both have them."""
    missing = {name: value for name, value in other._asdict().items() if getattr(one, name) is None}
    return one._replace(**missing)


class MessagePairer:
    """Pairs the orientation and inertial messages of a sensor that belong to the same instant.

    The first message is held until its partner of the same time arrives. If a message of another time arrives
    instead, the partner is lost (or never sent), and the held message becomes a sample by itself: messages of
    different instants are never combined.
    """

    def __init__(self, counters: Counters, tolerance_us: int = 0, wrap_us: int = 1 << 64) -> None:
        """Start without held messages.

        Args:
            counters: where to count `skipped` and `packets`.
            tolerance_us: largest difference of the two times; keep it below half the sampling period.
            wrap_us: the device's clock restarts at 0 after this many microseconds.
        """
        self.counters = counters
        self.tolerance_us = tolerance_us
        self._wrap_us = wrap_us
        self._held: BoundedDict[int, tuple[bool, Sample]] = BoundedDict()
        self._done: BoundedDict[int, int] = BoundedDict()

    def add(self, sample: Sample, oriented: bool) -> list[Sample]:
        """Return the samples that a message completes; `oriented` is set for orientation messages."""
        sensor, time_us = sample.sensor, sample.time_us
        assert time_us is not None
        held = self._held.get(sensor)
        if held is None:
            if self._done.get(sensor) == time_us:
                # The same orientation in a second form; its sample has been returned.
                self.counters.skipped += 1
                return []
            self._held[sensor] = (oriented, sample)
            return []
        held_oriented, other = held
        assert other.time_us is not None
        difference_us = abs(time_us - other.time_us)
        difference_us = min(difference_us, self._wrap_us - difference_us)
        if held_oriented == oriented:
            if not difference_us:
                # x-IMU3's L or E with Q: keep the first, with the acceleration of the second if it has none.
                if other.acc is None and sample.acc is not None:
                    self._held[sensor] = (oriented, other._replace(acc=sample.acc))
                self.counters.skipped += 1
                return []
        elif difference_us <= self.tolerance_us:
            del self._held[sensor]
            self._done[sensor] = time_us
            orientation, inertial = (sample, other) if oriented else (other, sample)
            self.counters.packets += 1
            return [
                Sample(
                    sensor,
                    orientation.time_us,
                    orientation.quat,
                    orientation.acc if inertial.acc is None else inertial.acc,
                    orientation.gyr if inertial.gyr is None else inertial.gyr,
                    inertial.mag,
                    inertial.temperature,
                )
            ]
        self._held[sensor] = (oriented, sample)
        self.counters.packets += 1
        return [other]

    def flush(self) -> list[Sample]:
        """Return each held message as a sample by itself; for the end of a recording."""
        samples = [sample for _, sample in self._held.values()]
        self._held.clear()
        self.counters.packets += len(samples)
        return samples
