"""What a sensor sends, and samples that lack a part of it or hold impossible numbers."""

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
        """Nothing is known."""
        self.has = dict.fromkeys(QUANTITIES, False)
        self._counted = self._incomplete = self._invalid = 0

    def update(self, window: Array, fresh: int) -> NDArray[np.bool_]:
        """Which rows of the window (n, 15) have all that the sensor sends; so many at its end are new."""
        measured = {name: ~np.isnan(window[:, columns]).any(axis=1) for name, columns in QUANTITIES.items()}
        self.has = {name: bool(own.mean() > 0.2) for name, own in measured.items()}
        needed = [measured[name] for name, has in self.has.items() if has]
        complete: NDArray[np.bool_] = np.all(needed, axis=0) if needed else np.zeros(len(window), bool)
        self._incomplete += int(np.count_nonzero(~complete[-fresh:]))
        self._counted += fresh
        self._invalid += _invalid(window[-fresh:])
        return complete

    def result(self) -> CompletenessResult:
        """What is known."""
        percent = 100.0 * self._incomplete / max(1, self._counted)
        return CompletenessResult(self._invalid, **self.has, incomplete_percent=percent)


def _invalid(rows: Array) -> int:
    """Rows with a number that is NaN in part of a quantity, infinite, or a quaternion that is no rotation."""
    bad = np.isinf(rows[:, :ARRIVAL]).any(axis=1)
    for columns in (*QUANTITIES.values(), MAG):
        unknown = np.isnan(rows[:, columns])
        bad |= unknown.any(axis=1) & ~unknown.all(axis=1)
    norm = np.linalg.norm(rows[:, QUAT], axis=1)
    return int(np.count_nonzero(bad | (np.abs(norm - 1.0) > 0.01)))
