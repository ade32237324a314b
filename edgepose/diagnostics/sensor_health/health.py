"""Health monitor for all sensors of a rig."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence

from edgepose.calibration.checks import GRAVITY_TILT_LIMIT_DEG
from edgepose.calibration.sensor_to_segment import Calibration
from edgepose.diagnostics.sensor_health.columns import TIME, joined_rows, row_of
from edgepose.diagnostics.sensor_health.comparison import RigComparison, compare_values
from edgepose.diagnostics.sensor_health.report import SensorHealth
from edgepose.diagnostics.sensor_health.sensor import Sensor
from edgepose.imu import ImuSample
from edgepose.placements import PLACEMENTS, SENSORS
from edgepose.sources.clock_sync import DeviceClock
from edgepose.utils.fault_messages import shared_convention

_MOST_PENDING = 5000


class SensorHealthMonitor:
    """Takes the samples of a rig and reports the health of its sensors at any time."""

    def __init__(
        self,
        calibration: Calibration | None = None,
        names: Sequence[str] = PLACEMENTS,
        fold_s: float = 2.0,
    ) -> None:
        """Create the monitor.

        Args:
            calibration: with it, headings and placements of the six sensors are checked on the body.
            names: sensors of the rig; others are reported only if they send something.
            fold_s: time between two measurements if no report is requested, seconds.
        """
        self._names, self._fold_s = names, fold_s
        self._sensors = [Sensor() for _ in SENSORS]
        self._comparison = RigComparison(calibration)
        self._next_fold_s = -math.inf

    def add(self, samples: Iterable[ImuSample], arrival_s: float = math.nan) -> None:
        """Take samples.

        Args:
            samples: of any sensors, each sensor's in time order.
            arrival_s: time of their arrival, on their clock, seconds; NaN if unknown.
        """
        for sample in samples:
            pending = self._sensors[sample.sensor].pending
            row = row_of(sample, arrival_s)
            same_time = pending and pending[-1][TIME] == sample.time_s
            joined = joined_rows(pending[-1], row) if same_time else None
            if joined is None:
                pending.append(row)
            else:
                pending[-1] = joined
            if sample.time_s >= self._next_fold_s or len(pending) >= _MOST_PENDING:
                self._fold()
                self._next_fold_s = sample.time_s + self._fold_s

    def report(
        self, now_s: float, clocks: Mapping[int, DeviceClock] | None = None, lag_ms: float = 0.0
    ) -> list[SensorHealth]:
        """Return the health of the sensors, in the order of SENSORS.

        Args:
            now_s: time up to which all samples have been added, on their clock, seconds.
            clocks: of the sensors that send a time.
            lag_ms: delay with which this machine reads packets, see `SensorHealth`.
        """
        self._fold()
        self._next_fold_s = now_s + 2.0 * self._fold_s  # the next report comes before
        result = []
        rig, values = self._comparison.result(), compare_values(self._sensors)
        for i, (name, sensor) in enumerate(zip(SENSORS, self._sensors, strict=True)):
            fields = rig[i] | values[i] | {"lag_ms": lag_ms}
            if clocks is not None and i in clocks:
                ppm, error = clocks[i].drift_ppm()
                fields |= {
                    "clock_ppm": ppm,
                    "clock_ppm_error": error,
                    "clock_restarts": clocks[i].resets,
                }
            result.append(dataclasses.replace(sensor.health(name, now_s), **fields))
        tilted = {
            health.placement: sensor.fitting_conventions()
            for sensor, health in zip(self._sensors, result, strict=True)
            if health.tilt_deg > GRAVITY_TILT_LIMIT_DEG
        }
        conventions = shared_convention(tilted)
        return [
            dataclasses.replace(health, convention=conventions.get(health.placement))
            for health in result
            if health.samples or health.placement in self._names
        ]

    def _fold(self) -> None:
        for sensor in self._sensors:
            sensor.fold()
        self._comparison.update(self._sensors)
