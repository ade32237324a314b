"""Strength of the magnetic field at a sensor."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from edgepose.diagnostics.sensor_health.columns import MAG
from edgepose.rotations import Array


class FieldResult(NamedTuple):
    """Fields of `SensorHealth`."""

    magnetometer: bool = False
    field_ut: float = math.nan
    field_change_percent: float = math.nan


def measure_field(window: Array) -> FieldResult:
    """Measure the field's strength and its changes in the newest rows (n, 15) only."""
    norms = np.linalg.norm(window[:, MAG], axis=1)
    norms = norms[np.isfinite(norms)]
    if not len(norms):
        return FieldResult()
    low, middle, high = np.percentile(norms, [5, 50, 95])
    return FieldResult(True, float(middle), 100.0 * float(high - low) / max(float(middle), 1e-9))
