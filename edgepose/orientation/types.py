"""Results of an orientation filter: orientations, and events per sample."""

from __future__ import annotations

from enum import IntFlag
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Event(IntFlag):
    """Anomalies of a sample, as bits of `OrientationResult.flagged`."""

    GAP = 1
    """Samples are missing before this one."""
    BAD = 2
    """A number that no sensor measures: NaN, infinite or absurd. The sample is skipped."""
    STAMP = 4
    """Not later than the sample before it. Skipped, unless the clock has restarted."""
    SATURATED = 8
    """A rate or a force at the end of its range, or a shock."""
    MAG_LOST = 16
    """The magnetometer has dropped out; the heading drifts until it is back."""
    RESTART = 32
    """The tilt was taken from this sample's force again, after a long gap."""


class OrientationResult(NamedTuple):
    """Result of a filter, with one row per sample.

    Attributes:
        quat: (N, 4) unit quaternions w, x, y, z, sensor to inertial, Z up. With a magnetometer X is east and
            Y (magnetic) north; without one the heading is 0 at the first sample (`rotations.heading`) and
            drifts. The identity before the first good sample.
        bias: (N, 3) bias of the gyroscope, sensor frame, rad/s.
        bias_sigma: (N, 3) standard deviation of the bias, rad/s.
        rest: (N,) bool, the sensor is at rest.
        disturbed: (N,) bool, the magnetic field is not the usual one.
        flagged: (N,) uint8, bits of `Event`.
    """

    quat: Array
    bias: Array
    bias_sigma: Array
    rest: NDArray[np.bool_]
    disturbed: NDArray[np.bool_]
    flagged: NDArray[np.uint8]
