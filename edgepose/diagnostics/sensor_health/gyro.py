"""Agreement between gyroscope and orientation."""

from __future__ import annotations

import math
from itertools import permutations
from typing import NamedTuple

import numpy as np

from edgepose import rotations as rot
from edgepose.diagnostics.sensor_health.columns import GYR, QUAT, TIME
from edgepose.rotations import Array

_STEP_S, _LEAST, _MOST = 0.1, math.radians(3.0), 1.0  # step, and range of rotations in a step, rad
_FEWEST_STEPS = 10


class GyroResult(NamedTuple):
    """Fields of `SensorHealth`."""

    gyro_ratio: float = math.nan
    gyro_agreement: float = math.nan
    gyro_exchanged: float = math.nan


class GyroAgreement:
    """Sums over the rotations of orientation and gyroscope in steps of a tenth of a second."""

    def __init__(self) -> None:
        """Start with no step."""
        self._products = np.zeros((3, 3))  # of orientation (row) and gyroscope
        self._squares = np.zeros(2)
        self._steps = 0

    def update(self, rows: Array, period_s: float) -> None:
        """Take in rows (n, 15), `period_s` seconds apart, of a sensor that sends both."""
        step = max(1, round(_STEP_S / period_s)) if period_s > 0.0 else 1
        quat, gyr, times = rows[:, QUAT], rows[:, GYR], rows[:, TIME]
        between = 0.5 * (gyr[1:] + gyr[:-1]) * np.diff(times)[:, None]
        at = np.arange(0, len(rows), step)
        if len(at) < 2:
            return
        by_gyr = np.diff(np.concatenate([np.zeros((1, 3)), np.cumsum(between, axis=0)])[at], axis=0)
        by_quat = rot.quat_to_rotvec(rot.quat_multiply(rot.quat_conjugate(quat[at[:-1]]), quat[at[1:]]))
        size, other = np.linalg.norm(by_quat, axis=1), np.linalg.norm(by_gyr, axis=1)
        use = (np.diff(times[at]) < 2.0 * step * period_s) & (size < _MOST)
        use &= np.maximum(size, other) > _LEAST
        self._products += by_quat[use].T @ by_gyr[use]
        self._squares += [np.square(size[use]).sum(), np.square(other[use]).sum()]
        self._steps += int(np.count_nonzero(use))

    def result(self) -> GyroResult:
        """Return the result so far."""
        if self._steps < _FEWEST_STEPS or not self._squares.all():
            return GyroResult()
        size = math.sqrt(self._squares.prod())
        best = max(np.abs(self._products)[range(3), order].sum() for order in permutations(range(3)))
        return GyroResult(
            math.sqrt(self._squares[1] / self._squares[0]),
            float(np.trace(self._products)) / size,
            float(best) / size,
        )
