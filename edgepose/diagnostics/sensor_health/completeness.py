"""Quantities that a sensor sends, and samples that lack some of them or hold impossible numbers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose.diagnostics.sensor_health.columns import ARRIVAL, MAG, QUANTITIES, QUAT
from edgepose.rotations import Array


class CompletenessResult(NamedTuple):
    """Fields of `SensorHealth`."""

    invalid: int
    orientation: bool
    acceleration: bool
    gyroscope: bool
    incomplete_percent: float


class Completeness:
    """Counts of good and of bad samples.

    Attributes:
        has: which of `QUANTITIES` the sensor sends.
    """

    def __init__(self) -> None:
        """Start with no sample counted."""
        self.has = dict.fromkeys(QUANTITIES, False)
        self._counted = self._incomplete = self._invalid = 0

    def update(self, window: Array, fresh: int) -> NDArray[np.bool_]:
        """Return which rows of the window (n, 15) are complete; the last `fresh` rows are new."""
        measured = {name: ~np.isnan(window[:, columns]).any(axis=1) for name, columns in QUANTITIES.items()}
        self.has = {name: bool(rows.mean() > 0.2) for name, rows in measured.items()}
        needed = [measured[name] for name, has in self.has.items() if has]
        complete: NDArray[np.bool_] = np.all(needed, axis=0) if needed else np.zeros(len(window), bool)
        self._incomplete += int(np.count_nonzero(~complete[-fresh:]))
        self._counted += fresh
        self._invalid += _invalid(window[-fresh:])
        return complete

    def result(self) -> CompletenessResult:
        """Return the result so far."""
        percent = 100.0 * self._incomplete / max(1, self._counted)
        return CompletenessResult(self._invalid, **self.has, incomplete_percent=percent)


def _invalid(rows: Array) -> int:
    """Count rows with an incomplete quantity, an infinite number, or a quaternion that is not a rotation."""
    bad = np.isinf(rows[:, :ARRIVAL]).any(axis=1)
    for columns in (*QUANTITIES.values(), MAG):
        missing = np.isnan(rows[:, columns])
        bad |= missing.any(axis=1) & ~missing.all(axis=1)
    norm = np.linalg.norm(rows[:, QUAT], axis=1)
    return int(np.count_nonzero(bad | (np.abs(norm - 1.0) > 0.01)))
