"""Detection of rest of one sensor."""

from __future__ import annotations

from math import exp, hypot, sqrt

import numpy as np
from numpy.typing import NDArray

from edgepose.orientation.settings import FilterSettings

Array = NDArray[np.float64]

_MEAN_S = 0.5
_SWAY_S = 1.5


class RestDetector:
    """Follows rate and force, block by block; at rest neither changes.

    Attributes:
        rest: whether the sensor is at rest.
        rate: (3,) mean rate of the last block, rad/s.
        rate_sigma: part of it that may be motion, rad/s; larger on a person who stands still than on a table.
    """

    def __init__(self, settings: FilterSettings) -> None:
        """Start in motion."""
        self.rest = False
        self.rate = np.zeros(3)
        self.rate_sigma = 0.0
        self._settings = settings
        self._mean: Array | None = None  # of rate and force
        self._still_s = 0.0
        self._sway = 0.0  # rad^2/s^2
        self._rested = False

    def restart(self) -> None:
        """Forget everything before the next block."""
        self.rest = False
        self._mean = None
        self._still_s = 0.0

    def update(self, duration_s: float, measured: Array, bias: Array, bias_sigma: float) -> None:
        """Take a block of measured rates and forces (N, 6), the current bias (3,) and its sigma."""
        s = self._settings
        mean = measured.sum(axis=0) / len(measured)
        if self._mean is None:
            self._mean = mean
        change = measured - self._mean
        change = change.reshape(-1, 2, 3)
        gyr_change, acc_change = np.einsum("nij,nij->ni", change, change).max(axis=0).tolist()
        self.rate = mean[:3]
        x, y, z = (mean - self._mean)[:3].tolist()
        sway = (x * x + y * y + z * z) / 3.0
        self._mean = self._mean + (1.0 - exp(-duration_s / _MEAN_S)) * (mean - self._mean)
        excess = hypot(*(self.rate - bias).tolist())
        largest = s.rest_bias + 3.0 * bias_sigma if self._rested else s.rest_bias_first
        still = gyr_change < s.rest_gyr**2 and acc_change < s.rest_acc**2 and excess < largest
        self._still_s = self._still_s + duration_s if still else 0.0
        self._sway = sway if not still else self._sway + min(1.0, duration_s / _SWAY_S) * (sway - self._sway)
        # The rates of swaying are correlated for about as long as they are averaged.
        self.rate_sigma = sqrt(self._sway * max(1.0, _MEAN_S / duration_s))
        self.rest = self._still_s >= s.rest_time
        self._rested |= self.rest
