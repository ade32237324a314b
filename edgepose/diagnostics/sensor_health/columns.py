"""Samples as rows of numbers: time, quantities, time of arrival; NaN means not measured."""

from __future__ import annotations

import math

import numpy as np

from edgepose.imu import ImuSample
from edgepose.rotations import Array

WINDOW_S = 10.0
"""Length of the window of newest samples, seconds."""

TIME, ARRIVAL, WIDTH = 0, 14, 15
"""Columns of the time of measurement and of the time of arrival, seconds, and number of columns."""

QUAT, ACC, GYR, MAG = slice(1, 5), slice(5, 8), slice(8, 11), slice(11, 14)
"""Columns of each quantity, in the units of `ImuSample`."""

MOTION = slice(QUAT.start, GYR.stop)
"""Columns of orientation, acceleration and gyroscope together."""

QUANTITIES = {"orientation": QUAT, "acceleration": ACC, "gyroscope": GYR}
"""Columns of the quantities that a sensor should send."""

FEWEST = 20
"""Smallest number of rows from which a period can be measured."""

_NAN3, _NAN4 = (math.nan,) * 3, (math.nan,) * 4


def row_of(sample: ImuSample, arrival_s: float) -> tuple[float, ...]:
    """Return the row of a sample that arrived at `arrival_s`, seconds."""
    _, time_s, quat, acc, gyr, mag = sample
    return (time_s, *(quat or _NAN4), *(acc or _NAN3), *(gyr or _NAN3), *(mag or _NAN3), arrival_s)


def joined_rows(first: tuple[float, ...], second: tuple[float, ...]) -> tuple[float, ...] | None:
    """Return two rows of one instant that hold different quantities as one row; None for any others.

    Some devices send their magnetometer in packets of its own.
    """
    if first[TIME] != second[TIME]:
        return None
    pairs = list(zip(first[1:ARRIVAL], second[1:ARRIVAL], strict=True))
    if any(not math.isnan(a) and not math.isnan(b) for a, b in pairs):
        return None
    return (first[TIME], *(b if math.isnan(a) else a for a, b in pairs), first[ARRIVAL])


def deviation(values: Array) -> float:
    """Return the standard deviation of rows (n, k), over all columns together."""
    return float(np.sqrt(values.var(axis=0).sum()))
