"""Error model of the filter: growth of small errors of its state over a block of samples.

The error has 21 components: orientation (a rotation vector in the inertial frame, R_true = exp(error) R),
gyroscope bias, velocity in the inertial frame, accelerometer bias, and the gyroscope's sensitivity, row by
row: its relative scale errors on the diagonal, and off it how much each axis senses of rotations about the
others (its axes are not quite at right angles, and not quite those of the accelerometer). Errors are true
minus estimated values; the rate is (1 - sensitivity) gyr - bias, the force acc - its bias.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose.orientation.settings import FilterSettings
from firmware_protocols.sample import STANDARD_G

Array = NDArray[np.float64]

TURN, BIAS, VEL, ACC_BIAS = (slice(i, i + 3) for i in range(0, 12, 3))
SENSITIVITY = slice(12, 21)
"""Components of the error vector."""

HEADING = 2
"""Index of the error about the vertical."""

SIZE = 21

IDENTITY = np.eye(SIZE)

_WIDTHS = (3, 3, 3, 3, 9)


class Transition(NamedTuple):
    """Propagation over a block.

    Attributes:
        matrix: (21, 21) maps the error before the block to the error after it.
        velocity: (3,) change of velocity, m/s.
    """

    matrix: Array
    velocity: Array


def transition(dt: Array, rotation: Array, gyr: Array, force: Array) -> Transition:
    """Propagate errors and velocity over a block.

    Args:
        dt: (N,) duration of each sample, s.
        rotation: (N, 3, 3) sensor to inertial, in the middle of each sample.
        gyr: (N, 3) rates as measured, rad/s.
        force: (N, 3) specific force without the known bias, sensor frame, m/s^2.
    """
    # One product sums the rotations, weighted with the time and with each component of the rate.
    weights = np.empty((len(dt), 4))
    weights[:, 0] = 1.0
    weights[:, 1:] = gyr
    sums = rotation.reshape(-1, 9).T @ (weights * dt[:, None])
    bias, sensitivity = sums[:, 0].reshape(3, 3), sums[:, 1:].reshape(3, 9)
    pushes = np.einsum("nij,nj->ni", rotation, force * dt[:, None])
    push = pushes.sum(axis=0)
    # Each force is weighted with the share of the block before it, in which a bias has rotated it.
    passed = np.cumsum(dt)
    duration = passed[-1]
    late_push = _cross((passed - 0.5 * dt) @ pushes / duration)
    matrix = IDENTITY.copy()
    matrix[TURN, BIAS] = matrix[VEL, ACC_BIAS] = -bias
    matrix[TURN, SENSITIVITY] = -sensitivity
    matrix[VEL, TURN] = -_cross(push)
    matrix[VEL, BIAS] = late_push @ bias
    matrix[VEL, SENSITIVITY] = late_push @ sensitivity
    push[2] -= STANDARD_G * duration
    return Transition(matrix, push)


def _cross(v: Array) -> Array:
    """Return the matrix (3, 3) of the map w -> v x w; `rotations.cross_matrix` takes ten times longer."""
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def noise_density(settings: FilterSettings) -> Array:
    """Return the variances (21,) that the error gains in a second."""
    growth = (
        settings.gyr_noise,
        settings.bias_walk,
        settings.vel_noise,
        settings.acc_bias_walk,
        settings.sensitivity_walk,
    )
    return np.repeat(growth, _WIDTHS) ** 2


def process_noise(density: Array, duration_s: float, lost_angle: float, lost_speed: float) -> Array:
    """Return the covariance (21, 21) that a block adds.

    Args:
        density: (21,) see `noise_density`.
        duration_s: of the block.
        lost_angle: rotation that may have gone unseen (gaps, ends of ranges), rad.
        lost_speed: change of velocity that may have gone unseen, m/s.
    """
    variance = density * duration_s
    if lost_angle or lost_speed:
        variance[TURN] += lost_angle**2
        variance[VEL] += lost_speed**2
    return np.diag(variance)


def start_covariance(settings: FilterSettings, heading: float) -> Array:
    """Return the error covariance (21, 21) at the first sample; `heading` is a standard deviation, rad."""
    start = (
        settings.tilt_start,
        settings.bias_start,
        settings.vel,
        settings.acc_bias_start,
        settings.sensitivity_start,
    )
    sigma = np.repeat(start, _WIDTHS)
    sigma[HEADING] = heading
    return np.diag(sigma**2)
