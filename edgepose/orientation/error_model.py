"""How small errors of the filter's state grow over a block of samples, and what measurements say of them.

The error is 15 numbers: orientation (a rotation vector in the inertial frame, R_true = exp(error) R), bias of
the gyroscope, velocity in the inertial frame, bias of the accelerometer, relative scale of the gyroscope.
Errors are true minus estimated values; the rate is (1 - scale) gyr - bias, the force acc - its bias.
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
"""Where the parts of the error are."""

HEADING = 2
"""Where the error about the vertical is."""

SIZE = 15

_UP = np.array([0.0, 0.0, 1.0])


class Transition(NamedTuple):
    """Over a block.

    Attributes:
        matrix: (15, 15) what becomes of an error.
        velocity: (3,) change of velocity, m/s.
    """

    matrix: Array
    velocity: Array


def transition(dt: Array, rotation: Array, gyr: Array, force: Array) -> Transition:
    """How errors grow over a block.

    Args:
        dt: (N,) duration of each sample, s.
        rotation: (N, 3, 3) sensor to inertial in the middle of each.
        gyr: (N, 3) rates as measured, rad/s.
        force: (N, 3) specific force without the known bias, sensor frame, m/s^2.
    """
    turned = rotation * dt[:, None, None]
    passed = np.cumsum(dt) - 0.5 * dt
    pushes = np.einsum("nij,nj->ni", turned, force)
    push = pushes.sum(axis=0)
    # Of each force, the part of the block that lies before it: that is how far a bias has turned it by then.
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
    """Covariance (15, 15) that a block adds.

    Args:
        settings: of the filter.
        duration_s: of the block.
        rate: mean magnitude of the rotation, rad/s.
        lost_angle: rotation that may have gone unseen (gaps, ends of ranges), rad.
        lost_speed: change of velocity that may have, m/s.
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
    """Covariance (15, 15) of the error at the first sample; heading is its standard deviation, rad."""
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
