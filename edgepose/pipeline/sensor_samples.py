"""The samples of one sensor that frames are made from, and a frame's values from them.

Plain floats are used on purpose: at six sensors of 100 Hz and more, numpy on four numbers at a time costs ten
times as much.
"""

from __future__ import annotations

from collections import deque
from math import asin, inf, sin, sqrt
from typing import NamedTuple

from edgepose.imu import HOLD_PERIODS, Quaternion, Vector3

_WAIT_PERIODS, _WAIT_S = 1.5, 0.010  # see `SensorSamples.wait_s`
_PERIOD_RANGE_S = (0.001, 0.2)
_PERIOD_MEMORY = 20  # samples


class Entry(NamedTuple):
    """A sample.

    Attributes:
        time_s: time of the measurement on the source's clock, seconds.
        quat: unit quaternion w, x, y, z, sensor to inertial.
        force: specific force in the inertial frame, m/s^2.
        arrival_s: time on the source's clock at which it came, seconds.
    """

    time_s: float
    quat: Quaternion
    force: Vector3
    arrival_s: float


class SensorState(NamedTuple):
    """A sensor at a tick.

    Attributes:
        quat: unit quaternion w, x, y, z, sensor to inertial.
        is_held: its last sample is too old, or there is none: `quat` is a repetition.
        arrival_s: time on the source's clock at which the newest sample that counts came, seconds; -inf if
            the sensor is held.
        last_force: specific force of its last sample, m/s^2.
        entries: samples from which the force is computed, oldest first; empty if there is nothing new.
    """

    quat: Quaternion
    is_held: bool
    arrival_s: float
    last_force: Vector3
    entries: list[Entry]

    def force(self, start_s: float, tick_s: float) -> Vector3:
        """Return the mean specific force in the inertial frame from `start_s` to the tick, m/s^2."""
        return _mean_force(self.entries, start_s, tick_s) if self.entries else self.last_force


_UNSEEN = SensorState((1.0, 0.0, 0.0, 0.0), True, -inf, (0.0, 0.0, 0.0), [])


class SensorSamples:
    """One sensor's samples that are needed for future ticks.

    Attributes:
        last: newest sample at or before the last tick.
        pending: samples after it, oldest first.
        newest_s: time of the newest sample, seconds; -inf before the first.
        intervals: number of intervals averaged in `period_s`.
        period_s: mean time between samples, seconds.
    """

    __slots__ = ("intervals", "last", "newest_s", "pending", "period_s")

    def __init__(self) -> None:
        """Start without a sample."""
        self.last: Entry | None = None
        self.pending: deque[Entry] = deque()
        self.newest_s = -inf
        self.intervals = 0
        self.period_s = _PERIOD_RANGE_S[1]

    def add(self, entry: Entry) -> bool:
        """Insert an entry in time order; return False, and drop it, if its time is taken."""
        if entry.time_s > self.newest_s:
            self.newest_s = entry.time_s
            self.pending.append(entry)
            return True
        index = len(self.pending)
        while index and self.pending[index - 1].time_s > entry.time_s:
            index -= 1
        before = self.pending[index - 1] if index else self.last
        if before is not None and before.time_s >= entry.time_s:
            return False
        self.pending.insert(index, entry)
        return True

    def advance(self, tick_s: float, frame_s: float, interpolate: bool) -> SensorState:
        """Move on to a tick, and return the sensor's state there.

        Args:
            tick_s: time of the tick on the source's clock, seconds; not before the last one.
            frame_s: time between ticks, seconds.
            interpolate: the orientation is one between the samples before and after the tick, instead of that
                of the last sample.
        """
        before, pending, entries = self.last, self.pending, []
        while pending and pending[0].time_s <= tick_s:
            entries.append(self._take())
        last = self.last
        if last is None:
            return _UNSEEN
        age_s = tick_s - last.time_s
        longest_s = max(HOLD_PERIODS * self.period_s, frame_s)
        if age_s > longest_s:
            return SensorState(last.quat, True, -inf, last.force, [])
        quat, arrival_s = last.quat, last.arrival_s
        # A later sample would not have been waited for; using it would depend on timing.
        if pending and age_s > 0.0 and pending[0].time_s - tick_s <= self.wait_s:
            following = pending[0]
            arrival_s = max(arrival_s, following.arrival_s)
            if interpolate:
                quat = _slerp(quat, following.quat, age_s / (following.time_s - last.time_s))
            entries.append(following)
        if before is not None and entries and entries[0].time_s - before.time_s <= longest_s:
            entries.insert(0, before)
        return SensorState(quat, False, arrival_s, last.force, entries)

    def _take(self) -> Entry:
        """Move the oldest pending entry to `last`, update the period, and return the entry."""
        entry = self.pending.popleft()
        # Updated here and not in `add`: the period must not depend on how far samples run ahead of the ticks.
        if self.last is not None:
            interval = entry.time_s - self.last.time_s
            if self.intervals:
                # A moving average in which a single gap has little weight.
                change = min(interval, 4.0 * self.period_s) - self.period_s
                interval = self.period_s + change / min(self.intervals + 1, _PERIOD_MEMORY)
            self.intervals += 1
            self.period_s = min(max(interval, _PERIOD_RANGE_S[0]), _PERIOD_RANGE_S[1])
        self.last = entry
        return entry

    @property
    def wait_s(self) -> float:
        """Longest time after a tick for which this sensor's next sample is waited for, seconds."""
        return _WAIT_PERIODS * self.period_s + _WAIT_S


def _mean_force(entries: list[Entry], start_s: float, end_s: float) -> Vector3:
    """Mean over the time from start to end of a force that is linear between entries and constant beyond.

    It is a mean over time, not over samples: with 5 samples in 3 frames, the mean over samples would jitter
    by a fraction of a period.
    """
    x = y = z = 0.0
    t0 = start_s
    left = entries[0]
    for right in entries:
        t1 = right.time_s if right.time_s < end_s else end_s
        if t1 > t0:
            span = right.time_s - left.time_s
            # Force in the middle of [t0, t1]; constant before the first entry, where left is right.
            share = (0.5 * (t0 + t1) - left.time_s) / span if span > 0.0 else 0.0
            (ax, ay, az), (bx, by, bz) = left.force, right.force
            weight = t1 - t0
            x += weight * (ax + share * (bx - ax))
            y += weight * (ay + share * (by - ay))
            z += weight * (az + share * (bz - az))
            t0 = t1
        left = right
    weight = end_s - t0  # after the last entry
    fx, fy, fz = left.force
    total = end_s - start_s
    return ((x + weight * fx) / total, (y + weight * fy) / total, (z + weight * fz) / total)


def _slerp(p: Quaternion, q: Quaternion, share: float) -> Quaternion:
    """Unit quaternion on the shorter arc from p (share 0) to q (share 1)."""
    pw, px, py, pz = p
    qw, qx, qy, qz = q
    if pw * qw + px * qx + py * qy + pz * qz < 0.0:
        qw, qx, qy, qz = -qw, -qx, -qy, -qz
    # The chord keeps its precision where the arc is short; arccos of the scalar product does not.
    angle = 2.0 * asin(
        min(1.0, 0.5 * sqrt((qw - pw) ** 2 + (qx - px) ** 2 + (qy - py) ** 2 + (qz - pz) ** 2))
    )
    if angle < 1e-8:
        return p
    sine = sin(angle)
    a, b = sin((1.0 - share) * angle) / sine, sin(share * angle) / sine
    return (a * pw + b * qw, a * px + b * qx, a * py + b * qy, a * pz + b * qz)
