"""Resampling of a rig's sensors, each at its own rate, to frames at one fixed rate.

Frames depend only on the samples' own times, so a recording yields the same frames whether it is read at once
or bit by bit. Plain floats are used on purpose: at six sensors of 100 Hz and more, numpy on four numbers at a
time costs ten times as much.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from math import asin, ceil, inf, sin, sqrt
from typing import Literal, NamedTuple

import numpy as np

from edgepose.errors import EdgeposeError
from edgepose.imu import GAP_S, AddedFrame, ImuFrame, ImuSample, Quaternion, Vector3
from edgepose.placements import PLACEMENTS, SENSORS

START_TIMEOUT_S = 3.0
"""Longest time until each of the six sensors, as far as the rig has them, has sent a sample, seconds."""

STALE_S = 0.5
"""Longest silence of a sensor that is still waited for, seconds."""

_HOLD_PERIODS = 2.5  # age of a sensor's last sample, in its periods, at which the sensor is held
_WAIT_PERIODS, _WAIT_S = 1.5, 0.010  # see `_Sensor.wait_s`
_PERIOD_RANGE_S = (0.001, 0.2)
_PERIOD_MEMORY = 20  # samples
_IDENTITY, _NO_FORCE = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)

Interpolation = Literal["slerp", "hold"]


class _Entry(NamedTuple):
    time_s: float
    quat: Quaternion
    force: Vector3  # specific force in the inertial frame
    arrival_s: float


class _Sensor:
    """One sensor's samples that are needed for future ticks."""

    __slots__ = ("intervals", "last", "newest_s", "pending", "period_s")

    def __init__(self) -> None:
        self.last: _Entry | None = None  # newest sample at or before the last tick
        self.pending: deque[_Entry] = deque()  # samples after it, oldest first
        self.newest_s = -inf
        self.intervals = 0  # number of intervals averaged in period_s
        self.period_s = _PERIOD_RANGE_S[1]

    def add(self, entry: _Entry) -> bool:
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

    def take(self) -> _Entry:
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


class FrameSynchronizer:
    """Makes frames at ticks `t0 + k / rate`; t0 is the time of the first sample of the last sensor to start.

    A frame is ready once every sensor has a sample at or after its tick. A late sensor is waited for, on the
    source's clock, for one and a half of its own periods plus 10 ms after the tick; a sensor that has been
    silent for half a second is not waited for. If a sensor had nothing new for two and a half of its periods
    (and at least a frame), its last values are repeated and the frame marks it as `held`.

    Frames do not wait for the first sample of an added sensor, which is held until then; after that, it
    counts like the others.

    On a grid, t0 is rounded up to a multiple of `1 / rate`, so that the clocks of several wearers tick at
    once.

    Attributes:
        dropped: samples ignored because they came after their frame, or were duplicates.
        restarts: restarts of the ticks, after all sensors were silent for over a minute; frame numbers go on.
        unused: why samples of sensors that are not needed are left out, by name.
    """

    def __init__(
        self,
        rate: float = 60.0,
        interpolation: Interpolation = "slerp",
        grid: bool = False,
        added: Sequence[str] = (),
        without: Sequence[str] = (),
    ) -> None:
        """Create the synchroniser.

        Args:
            rate: frames per second.
            interpolation: orientation at a tick: "slerp" between the samples before and after it, or "hold"
                for the last one.
            grid: place ticks at multiples of `1 / rate` on the source's clock.
            added: sensors of the rig besides the six.
            without: those of the six that the rig lacks; they are held in all frames.
        """
        self.dropped = 0
        self.restarts = 0
        self.unused: dict[str, str] = {}
        self._rate = rate
        self._slerp = interpolation == "slerp"
        self._grid = grid
        self._sensors = [_Sensor() for _ in PLACEMENTS]
        self._missing = [name in without for name in PLACEMENTS]
        self._added = {SENSORS.index(name): _Sensor() for name in added}
        worn = [s for s, missing in zip(self._sensors, self._missing, strict=True) if not missing]
        self._awaited = [*worn, *self._added.values()]
        self._index = 0
        self._t0: float | None = None
        self._tick = 0  # k of the next tick since t0
        self._last_tick_s = -inf
        self._first_arrival_s: float | None = None
        self._newest_s = -inf  # over all sensors
        # Samples after a gap, kept until all frames before it are made.
        self._after_gap: deque[tuple[ImuSample, float]] = deque()

    def push(self, samples: Iterable[ImuSample], arrival_s: float) -> None:
        """Add samples.

        Args:
            samples: samples of any sensors; each sensor's in time order, with few exceptions.
            arrival_s: time on the source's clock at which they came, seconds.

        Raises:
            EdgeposeError: a sample has no orientation or no acceleration.
        """
        if self._first_arrival_s is None:
            self._first_arrival_s = arrival_s
        for sample in samples:
            if self._after_gap or self._is_after_gap(sample):
                # Only the six restart the ticks.
                if self._after_gap or sample.sensor < len(PLACEMENTS):
                    self._after_gap.append((sample, arrival_s))
            else:
                self._take(sample, arrival_s)

    def _is_after_gap(self, sample: ImuSample) -> bool:
        return -inf < self._newest_s < sample.time_s - GAP_S

    def _take(self, sample: ImuSample, arrival_s: float) -> None:
        sensor, time_s, quat, acc, _, _ = sample
        if sensor >= len(PLACEMENTS) or self._missing[sensor]:
            self._take_added(sample, arrival_s)
            return
        if quat is None:
            raise EdgeposeError(
                f"{PLACEMENTS[sensor]}: the device sends no orientation; set it to send quaternions, "
                "or compute it here from gyroscope and accelerometer: calibrate with --filter kalman"
            )
        if acc is None:
            raise EdgeposeError(
                f"{PLACEMENTS[sensor]}: the device sends no acceleration; enable it in the device's settings"
            )
        if time_s <= self._last_tick_s:
            self.dropped += 1
            return
        w, x, y, z = quat
        ax, ay, az = acc
        # v + 2 w (u x v) + 2 u x (u x v)
        tx, ty, tz = 2.0 * (y * az - z * ay), 2.0 * (z * ax - x * az), 2.0 * (x * ay - y * ax)
        force = (ax + w * tx + y * tz - z * ty, ay + w * ty + z * tx - x * tz, az + w * tz + x * ty - y * tx)
        if not self._sensors[sensor].add(_Entry(time_s, quat, force, arrival_s)):
            self.dropped += 1
        elif time_s > self._newest_s:
            self._newest_s = time_s

    def _take_added(self, sample: ImuSample, arrival_s: float) -> None:
        sensor = self._added.get(sample.sensor)
        if sensor is None or sample.quat is None:
            unknown = "the calibration does not have them; calibrate again to use them"
            raw = "they have no orientation; let them send quaternions, or calibrate with --filter kalman"
            self.unused.setdefault(SENSORS[sample.sensor], unknown if sensor is None else raw)
        elif sample.time_s <= self._last_tick_s or not sensor.add(
            _Entry(sample.time_s, sample.quat, _NO_FORCE, arrival_s)
        ):
            self.dropped += 1

    def frames(self, now_s: float) -> list[ImuFrame]:
        """Return the frames that are ready.

        Args:
            now_s: time on the source's clock up to which everything has been pushed, seconds.

        Raises:
            EdgeposeError: not all sensors have sent samples within the start timeout.
        """
        if self._t0 is None and not self._start(now_s):
            return []
        result = self._until(now_s)
        while self._after_gap:
            result += self._until(inf)
            self._restart()
            result += self._until(now_s)
        return result

    def next_ready_s(self) -> float:
        """Return a time before which no frame will be ready, seconds: each sensor sends once a period.

        Sensors that send nothing, or whose period is unknown, are left out.
        """
        if self._t0 is None:
            return -inf
        tick_s = self._t0 + self._tick / self._rate
        result = tick_s
        for sensor in self._sensors:
            missing_s = tick_s - sensor.newest_s
            if 0.0 < missing_s <= STALE_S and sensor.intervals:
                result = max(result, sensor.newest_s + ceil(missing_s / sensor.period_s) * sensor.period_s)
        return result

    def flush(self) -> list[ImuFrame]:
        """Return the frames up to the newest sample, at the end of the samples.

        Raises:
            EdgeposeError: some sensors have never sent a sample.
        """
        if self._first_arrival_s is None:
            return []
        return self.frames(inf)

    def _start(self, now_s: float) -> bool:
        if self._first_arrival_s is None:
            return False
        worn = [
            (name, sensor)
            for name, sensor, missing in zip(PLACEMENTS, self._sensors, self._missing, strict=True)
            if not missing
        ]
        silent = [name for name, sensor in worn if sensor.newest_s == -inf]
        if silent:
            if now_s - self._first_arrival_s > START_TIMEOUT_S or self._after_gap:
                span = "up to the end" if now_s == inf else f"in the first {START_TIMEOUT_S:g} s"
                raise EdgeposeError(
                    f"no samples of {', '.join(silent)} {span}; switch these sensors on and check their ids"
                )
            return False
        self._t0 = self._first_tick(max(sensor.pending[0].time_s for _, sensor in worn))
        return True

    def _first_tick(self, time_s: float) -> float:
        return ceil(time_s * self._rate) / self._rate if self._grid else time_s

    def _restart(self) -> None:
        queue = self._after_gap
        self._t0, self._tick, self._newest_s = self._first_tick(queue[0][0].time_s), 0, -inf
        self.restarts += 1
        while queue and not self._is_after_gap(queue[0][0]):
            self._take(*queue.popleft())

    def _until(self, now_s: float) -> list[ImuFrame]:
        assert self._t0 is not None
        result: list[ImuFrame] = []
        # Frames stop after a minute of repeated values; the clock then waits for new samples.
        end_s = self._newest_s + GAP_S if now_s < inf else self._newest_s
        while True:
            tick_s = self._t0 + self._tick / self._rate
            if tick_s > end_s:
                break
            for sensor in self._awaited:
                if sensor.newest_s >= tick_s:
                    continue
                if now_s - sensor.newest_s <= STALE_S:
                    if now_s < tick_s + sensor.wait_s:
                        return result
                elif max(now_s, self._newest_s) < tick_s:
                    return result
            result.append(self._frame(tick_s, now_s))
            self._index += 1
            self._tick += 1
            self._last_tick_s = tick_s
        return result

    def _frame(self, tick_s: float, now_s: float) -> ImuFrame:
        assert self._t0 is not None
        start_s = self._t0 + (self._tick - 1) / self._rate
        orientation, force, held = [], [], []
        ready_s = -inf
        for sensor, is_missing in zip(self._sensors, self._missing, strict=True):
            if is_missing:
                orientation.append(_IDENTITY)
                force.append(_NO_FORCE)
                held.append(True)
                continue
            pending = sensor.pending
            before = sensor.last
            inside = []
            while pending and pending[0].time_s <= tick_s:
                inside.append(sensor.take())
            last = sensor.last
            assert last is not None, "t0 is not before any sensor's first sample"
            age_s = tick_s - last.time_s
            longest_s = max(_HOLD_PERIODS * sensor.period_s, 1.0 / self._rate)
            is_held = age_s > longest_s
            quat, mean = last.quat, last.force
            if not is_held:
                ready_s = max(ready_s, last.arrival_s)
                # A later sample would not have been waited for; using it would depend on timing.
                if pending and age_s > 0.0 and pending[0].time_s - tick_s <= sensor.wait_s:
                    following = pending[0]
                    ready_s = max(ready_s, following.arrival_s)
                    if self._slerp:
                        quat = _slerp(quat, following.quat, age_s / (following.time_s - last.time_s))
                    inside.append(following)
                if before is not None and inside and inside[0].time_s - before.time_s <= longest_s:
                    inside.insert(0, before)
                if inside:
                    mean = _mean_force(inside, start_s, tick_s)
            orientation.append(quat)
            force.append(mean)
            held.append(is_held)
        return ImuFrame(
            self._index,
            tick_s,
            np.array(orientation),
            np.array(force),
            np.array(held),
            ready_s if ready_s > -inf else min(now_s, tick_s),
            self._added_frame(tick_s) if self._added else None,
        )

    def _added_frame(self, tick_s: float) -> AddedFrame:
        orientation, held = [], []
        for sensor in self._added.values():
            pending = sensor.pending
            while pending and pending[0].time_s <= tick_s:
                sensor.take()
            last = sensor.last
            quat, is_held = _IDENTITY, True
            if last is not None:
                quat, age_s = last.quat, tick_s - last.time_s
                is_held = age_s > max(_HOLD_PERIODS * sensor.period_s, 1.0 / self._rate)
                if not is_held and self._slerp and age_s > 0.0 and pending:
                    following = pending[0]
                    if following.time_s - tick_s <= sensor.wait_s:
                        quat = _slerp(quat, following.quat, age_s / (following.time_s - last.time_s))
            orientation.append(quat)
            held.append(is_held)
        return AddedFrame(np.array(orientation), np.array(held))


def _mean_force(entries: list[_Entry], start_s: float, end_s: float) -> Vector3:
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
