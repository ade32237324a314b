"""All measurements of one sensor."""

from __future__ import annotations

import math

import numpy as np

from edgepose.calibration.checks import detect_alternating_devices
from edgepose.diagnostics.sensor_health.columns import FEWEST, QUAT, TIME, WIDTH, WINDOW_S
from edgepose.diagnostics.sensor_health.completeness import Completeness
from edgepose.diagnostics.sensor_health.field import measure_field
from edgepose.diagnostics.sensor_health.gyro import GyroAgreement
from edgepose.diagnostics.sensor_health.repeats import Repeats
from edgepose.diagnostics.sensor_health.report import SensorHealth
from edgepose.diagnostics.sensor_health.rest import Rest, Rests
from edgepose.diagnostics.sensor_health.timing import Timing
from edgepose.rotations import Array

_MOST_ROWS = 10_240  # of a window


class Sensor:
    """Keeps the newest rows of a sensor and passes each to the measurements once.

    Attributes:
        pending: rows since the last `fold`, see `columns`.
        window: (n, 15) the newest rows before the last `fold`.
    """

    def __init__(self) -> None:
        """Start with no samples."""
        self.pending: list[tuple[float, ...]] = []
        self.window = np.empty((0, WIDTH))
        self._samples = 0
        self._first_s = math.nan
        self._fresh = 0  # rows at the end of the window that have not been measured
        self._timing, self._completeness = Timing(), Completeness()
        self._rests, self._repeats, self._gyro = Rests(), Repeats(), GyroAgreement()
        self._two_devices_deg: float | None = None  # angle between devices that have alternated

    def fold(self) -> None:
        """Measure the pending samples."""
        if self.pending:
            self._extend(np.array(self.pending))
            self.pending = []
        if self._fresh and len(self.window) >= FEWEST:
            self._measure()
            self._fresh = 0

    def _extend(self, new: Array) -> None:
        """Move the window forward over new rows."""
        if not self._samples:
            self._first_s = float(new[0, TIME])
        self._samples += len(new)
        self._fresh += len(new)
        rows = np.concatenate([self.window, new])
        present = int(np.count_nonzero(rows[:, TIME] > rows[-1, TIME] - WINDOW_S))
        self.window = rows[-min(max(self._fresh + 1, present), _MOST_ROWS) :]
        self._fresh = min(self._fresh, len(self.window))

    def _measure(self) -> None:
        self._timing.update(self.window, self._fresh)
        complete = self._completeness.update(self.window, self._fresh)
        if not np.any(complete):
            return
        rows, new = self.window[complete], int(np.count_nonzero(complete[-self._fresh :]))
        has, period_s = self._completeness.has, self._timing.period_s
        still = self._rests.update(rows, has, period_s)
        self._repeats.update(rows, still, new, period_s)
        if has["orientation"]:
            apart_deg = detect_alternating_devices(rows[-max(new, FEWEST) :, QUAT])
            self._two_devices_deg = self._two_devices_deg or apart_deg
        if has["orientation"] and has["gyroscope"]:
            self._gyro.update(rows[-new - 1 :], period_s)

    def present_rest(self) -> Rest | None:
        """Return the current rest; None if the sensor moves or measures too little."""
        if not len(self.window):
            return None
        return self._rests.lasting(self.window[-1, TIME] - 3.0 * self._timing.period_s)

    def health(self, placement: str, now_s: float) -> SensorHealth:
        """Return the health of this sensor, without comparisons to others."""
        if not self._samples:
            return SensorHealth(placement)
        return SensorHealth(
            placement,
            self._samples,
            **self._timing.result(self.window, self._samples, self._first_s, now_s)._asdict(),
            **self._completeness.result()._asdict(),
            **self._rests.result(self._completeness.has)._asdict(),
            **self._repeats.result()._asdict(),
            **self._gyro.result()._asdict(),
            **measure_field(self.window)._asdict(),
            two_devices_deg=self._two_devices_deg,
        )

    def fitting_conventions(self) -> list[str]:
        """Return the conventions that would explain the gravity of its rests; there must be one."""
        return self._rests.fitting_conventions()
