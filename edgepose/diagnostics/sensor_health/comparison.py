"""Comparison of the sensors of a rig: headings, swapped sensors, shared values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np

from edgepose.calibration.fit import POSE_TILT_DEG, fit_pose, from_median
from edgepose.calibration.heading_reset import RESET_TILT_LIMIT_DEG, headings_from_pose, turn_about_z
from edgepose.calibration.sensor_to_segment import Calibration
from edgepose.diagnostics.sensor_health.columns import FEWEST
from edgepose.diagnostics.sensor_health.repeats import FROZEN_S, is_constant, newest_values
from edgepose.diagnostics.sensor_health.rest import is_table
from edgepose.diagnostics.sensor_health.sensor import Sensor
from edgepose.placements import PLACEMENTS
from edgepose.rotations import Array

_POSE_OFF_DEG = 30.0  # sum over six sensors: accuracy with which a wearer takes the pose again


class HeadingComparison:
    """Headings of sensors that are all at rest, side by side or on a wearer who stands in the pose."""

    def __init__(self, calibration: Calibration | None) -> None:
        """Create the comparison; without a calibration only sensors that lie side by side are compared."""
        self._calibration = calibration
        self._headings: tuple[str | None, Array] = (None, np.full(len(PLACEMENTS), np.nan))
        self._pose: tuple[Array, list[str | None]] | None = None
        self._pose_off_deg = math.inf

    def update(self, sensors: Sequence[Sensor]) -> None:
        """Compare the sensors, in the order of PLACEMENTS, in their current state."""
        resting = {i: rest for i, sensor in enumerate(sensors) if (rest := sensor.present_rest()) is not None}
        reporting = sum(len(sensor.window) > 0 for sensor in sensors)
        if len(resting) < 2 or len(resting) < reporting:
            return
        rests = list(resting.values())
        quats = np.stack([rest.quat for rest in rests])
        if is_table(rests):
            reset = turn_about_z(quats, quats[-1])
            if reset.error_deg.max() < RESET_TILT_LIMIT_DEG:
                headings = np.full(len(PLACEMENTS), np.nan)
                headings[list(resting)] = from_median(-reset.offset)
                self._headings = "table", headings
        elif self._calibration is not None and len(resting) == len(PLACEMENTS):
            self._compare_pose(self._calibration, quats)

    def result(self) -> list[dict[str, Any]]:
        """Return fields for the `SensorHealth` of each sensor."""
        on, headings = self._headings
        fields: list[dict[str, Any]] = [
            {"heading_deg": heading, "heading_on": on} for heading in headings.tolist()
        ]
        if self._pose is not None:
            for sensor_fields, tilt, swap in zip(fields, self._pose[0].tolist(), self._pose[1], strict=True):
                sensor_fields |= {"pose_tilt_deg": tilt, "swapped_with": swap}
        return fields

    def _compare_pose(self, calibration: Calibration, quats: Array) -> None:
        """Compare the sensors of a wearer who stands in the pose, or should."""
        fit = fit_pose(calibration, quats)
        if fit.off_deg > self._pose_off_deg + _POSE_OFF_DEG:
            return  # the wearer has been nearer to the pose before
        self._pose_off_deg = min(fit.off_deg, self._pose_off_deg)
        if fit.in_pose:
            self._headings = "body", fit.heading_deg
        swaps: list[str | None] = [None] * len(PLACEMENTS)
        if fit.sits_at is not None:
            swaps = [PLACEMENTS[at] if at != i else None for i, at in enumerate(fit.sits_at)]
        elif fit.in_pose:
            swaps = _swaps(calibration, quats, fit.tilt_deg)
        self._pose = fit.tilt_deg, swaps


def compare_values(sensors: Sequence[Sensor]) -> list[dict[str, Any]]:
    """Return `SensorHealth` fields of each sensor: values equal to another's, or frozen alone."""
    fields: list[dict[str, Any]] = [{} for _ in sensors]
    values = [newest_values(sensor.window) for sensor in sensors]
    for (i, one), (j, other) in combinations(enumerate(values), 2):
        if FEWEST < len(one) * 0.8 <= len(one & other):
            fields[i]["same_as"], fields[j]["same_as"] = PLACEMENTS[j], PLACEMENTS[i]
    # All sensors of a simulated rig at rest are constant, though not from exactly the same time.
    if sum(is_constant(sensor.window, FROZEN_S) is False for sensor in sensors) >= 2:
        for sensor_fields, sensor in zip(fields, sensors, strict=True):
            if is_constant(sensor.window, 2.0 * FROZEN_S):
                sensor_fields["frozen"] = "everything"
    return fields


def _swaps(calibration: Calibration, quats: Array, tilt: Array) -> list[str | None]:
    """Find for each sensor the one with which it must be swapped so that both fit the pose."""
    result: list[str | None] = [None] * len(PLACEMENTS)
    for i, j in combinations(np.flatnonzero(tilt > POSE_TILT_DEG), 2):
        swapped = quats.copy()
        swapped[[i, j]] = quats[[j, i]]
        if headings_from_pose(calibration, swapped).error_deg[[i, j]].max() < POSE_TILT_DEG:
            result[i], result[j] = PLACEMENTS[j], PLACEMENTS[i]
    return result
