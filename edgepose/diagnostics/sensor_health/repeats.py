"""Values that freeze or repeat where they should change, and values at the end of a range."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.diagnostics.sensor_health.columns import (
    ACC,
    FEWEST,
    GYR,
    MOTION,
    QUANTITIES,
    QUAT,
    TIME,
    deviation,
)
from edgepose.imu import GRAVITY
from edgepose.rotations import Array

FROZEN_S = 1.0
"""Time without change, in motion, after which a quantity counts as frozen, seconds."""

_FULL_SCALES = {
    "acceleration": np.array([2, 4, 6, 8, 16, 32]) * GRAVITY,
    "gyroscope": np.radians([125, 250, 500, 1000, 2000, 4000]),
}


class RepeatsResult(NamedTuple):
    """Fields of `SensorHealth`."""

    repeated_percent: float
    frozen: str | None
    saturated: str | None


class Repeats:
    """Counts samples that are the same as the one before, in motion."""

    def __init__(self) -> None:
        """Start with no row counted."""
        self._moved = self._repeated = 0
        self._frozen: str | None = None
        self._saturated: set[str] = set()

    def update(self, rows: Array, still: NDArray[np.bool_], new: int, period_s: float) -> None:
        """Take rows.

        Args:
            rows: (n, 15) newest complete rows.
            still: (n,) which of them are at rest.
            new: number of new rows, at the end.
            period_s: mean interval between them, seconds.
        """
        values = rows[:, MOTION]
        first = max(len(rows) - 1 - new, 0)
        moving = np.logical_not(still[1:][first:])
        same = np.all((values[1:] == values[:-1]) | np.isnan(values[1:]), axis=1)[first:]
        self._moved += int(np.count_nonzero(moving))
        self._repeated += int(np.count_nonzero(same & moving))
        if period_s > 0.0:
            self._frozen = _frozen(rows[-max(10, round(FROZEN_S / period_s)) :]) or self._frozen
        for name, full_scales in _FULL_SCALES.items():
            if new and _saturates(rows[-new:, QUANTITIES[name]], full_scales):
                self._saturated.add(name)

    def result(self) -> RepeatsResult:
        """Return the result so far."""
        return RepeatsResult(
            100.0 * self._repeated / self._moved if self._moved >= FEWEST else math.nan,
            self._frozen,
            " and ".join(sorted(self._saturated)) or None,
        )


def newest_values(window: Array) -> set[bytes]:
    """Return the distinct newest samples of a window (n, 15)."""
    return {row.tobytes() for row in window[-300:, MOTION]}


def is_constant(window: Array, seconds: float) -> bool | None:
    """Return whether the last seconds of a window (n, 15) are constant; None if there are too few rows."""
    if not len(window):
        return None
    values = window[window[:, TIME] > window[-1, TIME] - seconds][:, MOTION]
    if len(values) < FEWEST:
        return None
    return bool(np.all((values == values[0]) | np.isnan(values)))


def _frozen(rows: Array) -> str | None:
    """Return a quantity that does not change in rows in which others show motion."""
    moving = {
        "orientation": 2.0 * math.degrees(deviation(rot.quat_continuous(rows[:, QUAT]))) > 5.0,
        "acceleration": deviation(rows[:, ACC]) > 1.0,
        "gyroscope": math.degrees(deviation(rows[:, GYR])) > 10.0,
    }
    if np.isfinite(rows[:, QUAT]).all():
        del moving["gyroscope"]  # in a wrong unit, its noise looks like movement
    for name, columns in QUANTITIES.items():
        values = rows[:, columns]
        others = any(is_moving for other, is_moving in moving.items() if other != name)
        if others and bool(np.all(values == values[0])):
            return name
    return None


def _saturates(values: Array, full_scales: Array) -> bool:
    """Return whether a number stays the same for three rows, near the end of a usual range."""
    size = np.abs(values)
    same = (size[2:] == size[1:-1]) & (size[1:-1] == size[:-2])
    stuck = size[2:][same]
    return bool(np.any(np.abs(stuck[:, None] / full_scales - 1.0) < 0.05))
