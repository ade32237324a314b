"""Comparison of the sensors of a rig: headings, swapped sensors, shared values."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np

from edgepose.calibration.fit import from_median
from edgepose.calibration.heading_reset import RESET_TILT_LIMIT_DEG, turn_about_z
from edgepose.calibration.sensor_to_segment import Calibration
from edgepose.diagnostics.sensor_health.columns import FEWEST
from edgepose.diagnostics.sensor_health.repeats import FROZEN_S, is_constant, newest_values
from edgepose.diagnostics.sensor_health.rest import is_table
from edgepose.diagnostics.sensor_health.sensor import Sensor
from edgepose.diagnostics.sensor_health.worn import WornComparison
from edgepose.placements import PLACEMENTS, SENSORS
from edgepose.rotations import Array


class RigComparison:
    """Sensors that are all at rest: side by side, or on a wearer who stands in the pose of a calibration."""

    def __init__(self, calibration: Calibration | None) -> None:
        """Create the comparison.

        Without a calibration, only sensors that lie side by side are compared.
        """
        self._worn = None if calibration is None else WornComparison(calibration)
        self._table_deg: Array | None = None

    def update(self, sensors: Sequence[Sensor]) -> None:
        """Compare the sensors, in the order of SENSORS, in their current state."""
        if self._worn is not None:
            self._worn.check_bones(sensors)
        resting = {i: rest for i, sensor in enumerate(sensors) if (rest := sensor.present_rest()) is not None}
        reporting = sum(len(sensor.window) > 0 for sensor in sensors)
        if len(resting) < 2 or len(resting) < reporting:
            return
        rests = list(resting.values())
        if is_table(rests):
            quats = np.stack([rest.quat for rest in rests])
            reset = turn_about_z(quats, quats[-1])
            if reset.error_deg.max() < RESET_TILT_LIMIT_DEG:  # false for sensors without orientation
                self._table_deg = np.full(len(SENSORS), np.nan)
                self._table_deg[list(resting)] = from_median(-reset.offset)
        elif self._worn is not None and set(self._worn.placements) <= resting.keys():
            self._table_deg = None
            self._worn.compare_pose(resting)

    def result(self) -> list[dict[str, Any]]:
        """Return fields for the `SensorHealth` of each sensor."""
        fields: list[dict[str, Any]] = [{} for _ in SENSORS]
        if self._worn is not None:
            fields[: len(PLACEMENTS)] = self._worn.result()
        if self._table_deg is not None:
            for of_sensor, heading in zip(fields, self._table_deg.tolist(), strict=True):
                of_sensor |= {"heading_deg": heading, "heading_on": "table"}
        return fields


def compare_values(sensors: Sequence[Sensor]) -> list[dict[str, Any]]:
    """Return `SensorHealth` fields of each sensor: values equal to another's, or frozen alone."""
    fields: list[dict[str, Any]] = [{} for _ in sensors]
    values = [newest_values(sensor.window) for sensor in sensors]
    for (i, one), (j, other) in combinations(enumerate(values), 2):
        if FEWEST < len(one) * 0.8 <= len(one & other):
            fields[i]["same_as"], fields[j]["same_as"] = SENSORS[j], SENSORS[i]
    # All sensors of a simulated rig at rest are constant, though not from exactly the same time.
    if sum(is_constant(sensor.window, FROZEN_S) is False for sensor in sensors) >= 2:
        for sensor_fields, sensor in zip(fields, sensors, strict=True):
            if is_constant(sensor.window, 2.0 * FROZEN_S):
                sensor_fields["frozen"] = "everything"
    return fields
