"""Resampling of a rig's sensors, each at its own rate, to frames at one fixed rate.

Frames depend only on the samples' own times, so a recording yields the same frames whether it is read at once
or bit by bit.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from math import ceil, inf
from typing import Literal

import numpy as np

from edgepose.errors import EdgeposeError
from edgepose.imu import GAP_S, AddedFrame, ImuFrame, ImuSample
from edgepose.pipeline.sensor_samples import Entry, SensorSamples, SensorState
from edgepose.placements import PLACEMENTS, SENSORS

START_TIMEOUT_S = 3.0
"""Longest time until each of the six sensors, as far as the rig has them, has sent a sample, seconds."""

STALE_S = 0.5
"""Longest silence of a sensor that is still waited for, seconds."""

_NO_FORCE = (0.0, 0.0, 0.0)

Interpolation = Literal["slerp", "hold"]


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
        self._sensors = [SensorSamples() for _ in PLACEMENTS]
        self._missing = [name in without for name in PLACEMENTS]
        self._added = {SENSORS.index(name): SensorSamples() for name in added}
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
            if self._after_gap or self._restarts_ticks(sample):
                self._after_gap.append((sample, arrival_s))
            else:
                self._take(sample, arrival_s)

    def _restarts_ticks(self, sample: ImuSample) -> bool:
        """Whether a sample ends a gap: only the six that the rig has do, as there are no frames without."""
        return self._is_after_gap(sample) and self._is_one_of_six(sample.sensor)

    def _is_after_gap(self, sample: ImuSample) -> bool:
        return -inf < self._newest_s < sample.time_s - GAP_S

    def _is_one_of_six(self, sensor: int) -> bool:
        return sensor < len(PLACEMENTS) and not self._missing[sensor]

    def _take(self, sample: ImuSample, arrival_s: float) -> None:
        sensor, time_s, quat, acc, _, _ = sample
        if not self._is_one_of_six(sensor):
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
        if not self._sensors[sensor].add(Entry(time_s, quat, force, arrival_s)):
            self.dropped += 1
        elif time_s > self._newest_s:
            self._newest_s = time_s

    def _take_added(self, sample: ImuSample, arrival_s: float) -> None:
        sensor = self._added.get(sample.sensor)
        if sensor is None or sample.quat is None:
            unknown = "the calibration does not have them; calibrate again to use them"
            raw = "they have no orientation; let them send quaternions, or calibrate with --filter kalman"
            self.unused.setdefault(SENSORS[sample.sensor], unknown if sensor is None else raw)
        elif self._is_after_gap(sample):
            pass  # there are no frames until the six are back
        elif sample.time_s <= self._last_tick_s or not sensor.add(
            Entry(sample.time_s, sample.quat, _NO_FORCE, arrival_s)
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
        while queue and not self._restarts_ticks(queue[0][0]):
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
        states = self._states(self._sensors, tick_s)
        ready_s = max(state.arrival_s for state in states)
        return ImuFrame(
            self._index,
            tick_s,
            np.array([state.quat for state in states]),
            np.array([state.force(start_s, tick_s) for state in states]),
            np.array([state.is_held for state in states]),
            ready_s if ready_s > -inf else min(now_s, tick_s),
            self._added_frame(tick_s) if self._added else None,
        )

    def _added_frame(self, tick_s: float) -> AddedFrame:
        states = self._states(self._added.values(), tick_s)
        return AddedFrame(
            np.array([state.quat for state in states]), np.array([state.is_held for state in states])
        )

    def _states(self, sensors: Iterable[SensorSamples], tick_s: float) -> list[SensorState]:
        return [sensor.advance(tick_s, 1.0 / self._rate, self._slerp) for sensor in sensors]
