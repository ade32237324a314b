"""Kalman filter of the heading errors of the sensors on one body.

Assumptions:
- The heading error of a gyroscope grows with its bias, which changes over minutes, and with its scale error
  times the angle that it has turned.
- The heading of a bone against the pelvis is that of the straight pose plus habits, which last for a while,
  then change slowly or all at once. Legs keep closest to the pelvis, arms least.
- The pelvis has no reference: only its bias can be found, at rest.
- One measurement in twenty shows nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_OUTLIERS = 0.05
"""Share of measurements that show nothing."""
_JUMPS = 0.02
"""Share of measurements of a new posture."""
_BIAS_MEMORY_S = 1800.0
"""Time within which a bias changes by its usual size, seconds."""
_DEPENDENT = 0.5
"""Weight of the likelihood of measurements that follow each other closely."""
_ANY_HEADING = 2.0 * np.pi
_ANY_RATE = np.radians(1.0)
"""Ranges of measurements that show nothing, rad and rad/s."""
_ZERO_SIGMA = np.radians(2.0)
"""Standard deviation of headings after a calibration or a re-zero, rad."""


class Gyroscopes(NamedTuple):
    """The quality of a rig's gyroscopes, as standard deviations.

    Attributes:
        bias: rad/s.
        scale: error of the scale.
        walk: growth of the heading error beside both, rad per square root of a second.
    """

    bias: float
    scale: float
    walk: float


class Habit(NamedTuple):
    """A posture that lasts.

    Attributes:
        seconds: time for which it lasts.
        sigma: (S,) standard deviations of the headings of bones against the pelvis, rad; 0 for the pelvis.
    """

    seconds: float
    sigma: Array


class HeadingFilter:
    """Estimates heading error, bias and scale error of each of S sensors, given how good they are.

    Attributes:
        log_likelihood: of all measurements so far, weighted by how independent they are.
    """

    def __init__(self, gyroscopes: Gyroscopes, habits: Sequence[Habit], root: int) -> None:
        """Start after a calibration.

        Args:
            gyroscopes: of the rig.
            habits: of the wearer, which add up.
            root: index of the pelvis.
        """
        n = len(habits[0].sigma)
        self._n, self._root, self._gyroscopes = n, root, gyroscopes
        start = np.where(np.arange(n) == root, 0.0, _ZERO_SIGMA)
        rest = np.repeat([gyroscopes.bias, gyroscopes.scale], n)
        self._states = (3 + len(habits)) * n
        self._state = np.zeros(self._states)  # heading errors, biases, scale errors, habits
        self._habits = np.concatenate([habit.sigma for habit in habits])
        self._habits_s = np.repeat([habit.seconds for habit in habits], n)
        self._cov = np.diag(np.concatenate([start, rest, self._habits]) ** 2)
        self.log_likelihood = 0.0

    @property
    def error(self) -> Array:
        """(S,) estimated heading errors, rad."""
        return self._state[: self._n]

    @property
    def bias(self) -> Array:
        """(S,) estimated biases, rad/s."""
        return self._state[self._n : 2 * self._n]

    def predict(self, seconds: float, turned: Array) -> None:
        """Move on by a time in which the sensors turned by angles (S,) about the vertical, rad."""
        n, g = self._n, self._gyroscopes
        rows, step = np.arange(n), np.eye(self._states)
        stay = np.exp(-seconds / self._habits_s)
        step[rows, n + rows] = seconds
        step[rows, 2 * n + rows] = turned
        step[np.arange(3 * n, self._states), np.arange(3 * n, self._states)] = stay
        growth = np.repeat([g.walk**2, g.bias**2 / _BIAS_MEMORY_S, 0.0], n) * seconds
        noise = np.concatenate([growth, self._habits**2 * (1.0 - stay**2)])
        self._state = step @ self._state
        self._cov = step @ self._cov @ step.T + np.diag(noise)

    def at_rest(self, sensor: int, rate: float, sigma: float) -> None:
        """Take the turning rate of a sensor at rest, rad/s, with its standard deviation."""
        h = np.zeros(self._states)
        h[self._n + sensor] = 1.0
        self._take(h, rate - self.bias[sensor], sigma, _ANY_RATE, _DEPENDENT)

    def heading(self, sensor: int, heading: float, sigma: float, *, habit: bool = True) -> None:
        """Take the measured heading of a bone against the pelvis, rad, with its standard deviation.

        Args:
            sensor: on the bone.
            heading: from that of the straight pose.
            sigma: standard deviation, rad.
            habit: whether the wearer may have another posture; if not, this is the straight pose.
        """
        h = np.zeros(self._states)
        h[sensor], h[self._root], h[3 * self._n + sensor :: self._n] = 1.0, -1.0, habit
        if habit:
            kept = self._state, self._cov
            likelihood = (1.0 - _JUMPS) * self._density(h, self._away(h, heading), sigma)
            self._forget_habit(sensor)
            jump = _JUMPS * self._density(h, self._away(h, heading), sigma)
            jumped = jump > likelihood
            if not jumped:
                self._state, self._cov = kept
            self.log_likelihood += _DEPENDENT * math.log(_JUMPS if jumped else 1.0 - _JUMPS)
        weight = _DEPENDENT if habit else 1.0
        self._take(h, self._away(h, heading), sigma, _ANY_HEADING, weight)

    def rezero(self, errors: Array) -> None:
        """Set the heading errors (S,), rad, whose present values have been taken by `heading` before."""
        n = self._n
        self._state[:n] = errors
        self._cov[:n], self._cov[:, :n] = 0.0, 0.0
        others = np.arange(n) != self._root
        self._cov[:n, :n] = np.diag(np.where(others, _ZERO_SIGMA, 0.0) ** 2)

    def _forget_habit(self, sensor: int) -> None:
        """Let the wearer take another posture with a bone."""
        rows = np.arange(3 * self._n + sensor, self._states, self._n)
        self._state, self._cov = self._state.copy(), self._cov.copy()
        self._state[rows] = 0.0
        self._cov[rows], self._cov[:, rows] = 0.0, 0.0
        self._cov[rows, rows] = self._habits[rows - 3 * self._n] ** 2

    def _away(self, h: Array, heading: float) -> float:
        """Return the angle from the expected heading to a measured one."""
        return (heading - float(h @ self._state) + math.pi) % (2.0 * math.pi) - math.pi

    def _density(self, h: Array, innovation: float, sigma: float) -> float:
        variance = float(h @ self._cov @ h) + sigma**2
        return math.exp(-0.5 * innovation**2 / variance) / math.sqrt(2.0 * math.pi * variance)

    def _take(self, h: Array, innovation: float, sigma: float, any_value: float, weight: float) -> None:
        column = self._cov @ h
        variance = float(h @ column) + sigma**2
        near = (1.0 - _OUTLIERS) * self._density(h, innovation, sigma)
        far = _OUTLIERS / any_value
        self.log_likelihood += weight * math.log(near + far)
        trust = near / (near + far)
        self._state = self._state + trust * innovation / variance * column
        self._cov = self._cov - trust / variance * np.outer(column, column)
