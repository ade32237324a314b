"""Turning rates of a sensor at rest.

Assumptions:
- A sensor that moves by less than `STILL` in a block is at rest; what it turns then is its bias.
- A wearer at rest sways and turns slowly, each as much as before. The more they do, the less a rest counts.
"""

from __future__ import annotations

import math

STILL = math.radians(1.5)
"""Largest angle by which a sensor at rest moves in half a second, rad."""
REST_S = 2.0
"""Length of the rests whose rates are measured, seconds."""
_SETTLE_S = 1.0
"""Beginning of a rest that does not count, seconds."""
_LEAST_SWAY = math.radians(0.05)
"""Least standard deviation of the angle turned in `REST_S` beside the bias, rad."""
_SWAY = math.radians(0.6)
"""The same as long as it is unknown, rad."""
_MEMORY = 20.0
"""Number of rests over which the sway is averaged."""


class Rests:
    """Measures the turning rate of one sensor whenever it is at rest."""

    def __init__(self) -> None:
        """Start in motion."""
        self._still_s = self._turned = self._seconds = 0.0
        self._sway, self._count = _SWAY**2, 1.0
        self._last: float | None = None  # angle turned in the REST_S before

    def update(self, seconds: float, turned: float, moved: float) -> tuple[float, float] | None:
        """Take a block; after each REST_S at rest, return rate and standard deviation, rad/s.

        Args:
            seconds: length of the block.
            turned: angle about the vertical in it, rad.
            moved: largest angle to its first orientation, rad; infinite if that is unknown.
        """
        if moved > STILL:
            self._still_s = self._turned = self._seconds = 0.0
            self._last = None
            return None
        self._still_s += seconds
        if self._still_s <= _SETTLE_S:
            return None
        self._turned += turned
        self._seconds += seconds
        if self._seconds < REST_S - 1e-6:
            return None
        if self._last is not None:
            # The difference of two rests does not depend on the bias, and has twice their variance.
            sway = max((self._turned - self._last) ** 2 / 2.0, _LEAST_SWAY**2)
            self._count = min(self._count + 1.0, _MEMORY)
            self._sway += (sway - self._sway) / self._count
        self._last = self._turned
        rate, sigma = self._turned / self._seconds, math.sqrt(self._sway) / self._seconds
        self._turned = self._seconds = 0.0
        return rate, sigma
