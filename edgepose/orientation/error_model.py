"""Error model of the filter: growth of small errors of its state over a block of samples.

The error has 15 components: orientation (a rotation vector in the inertial frame, R_true = exp(error) R),
gyroscope bias, velocity in the inertial frame, accelerometer bias, relative gyroscope scale. Errors are true
minus estimated values; the rate is (1 - scale) gyr - bias, the force acc - its bias.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose.orientation.settings import FilterSettings
from edgepose.rotations import cross_matrix
from firmware_protocols.sample import STANDARD_G

Array = NDArray[np.float64]

TURN, BIAS, VEL, ACC_BIAS, SCALE = (slice(i, i + 3) for i in range(0, 15, 3))
"""Components of the error vector."""

HEADING = 2
"""Index of the error about the vertical."""

SIZE = 15

_UP = np.array([0.0, 0.0, 1.0])


class Transition(NamedTuple):
    """Propagation over a block.

    Attributes:
        matrix: (15, 15) maps the error before the block to the error after it.
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
    turned = rotation * dt[:, None, None]
    passed = np.cumsum(dt) - 0.5 * dt
    pushes = np.einsum("nij,nj->ni", turned, force)
    push = pushes.sum(axis=0)
    # Each force is weighted with the share of the block before it, in which a bias has rotated it.
    late_push = passed / dt.sum() @ pushes
    bias, scale = turned.sum(axis=0), np.einsum("nij,nj->ij", turned, gyr)
    matrix = np.eye(SIZE)
    matrix[TURN, BIAS] = -bias
    matrix[TURN, SCALE] = -scale
    pushed, late_pushed = cross_matrix([push, late_push])
    matrix[VEL, TURN] = -pushed
    matrix[VEL, BIAS] = late_pushed @ bias
    matrix[VEL, SCALE] = late_pushed @ scale
    matrix[VEL, ACC_BIAS] = -bias
    return Transition(matrix, push - STANDARD_G * dt.sum() * _UP)


def process_noise(
    settings: FilterSettings, duration_s: float, rate: float, lost_angle: float, lost_speed: float
) -> Array:
    """Return the covariance (15, 15) that a block adds.

    Args:
        settings: of the filter.
        duration_s: of the block.
        rate: mean magnitude of the rotation, rad/s.
        lost_angle: rotation that may have gone unseen (gaps, ends of ranges), rad.
        lost_speed: change of velocity that may have gone unseen, m/s.
    """
    growth = np.repeat(
        [
            settings.gyr_noise + settings.gyr_noise_per_rate * rate,
            settings.bias_walk,
            settings.vel_noise,
            settings.acc_bias_walk,
            settings.scale_walk,
        ],
        3,
    )
    variance = growth**2 * duration_s
    variance[TURN] += lost_angle**2
    variance[VEL] += lost_speed**2
    return np.diag(variance)


def start_covariance(settings: FilterSettings, heading: float) -> Array:
    """Return the error covariance (15, 15) at the first sample; `heading` is a standard deviation, rad."""
    sigma = np.repeat(
        [
            settings.tilt_start,
            settings.bias_start,
            settings.vel,
            settings.acc_bias_start,
            settings.scale_start,
        ],
        3,
    )
    sigma[HEADING] = heading
    return np.diag(sigma**2)
