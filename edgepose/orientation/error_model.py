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
DIAGONAL = slice(None, None, SIZE + 1)
"""Diagonal of a raveled covariance."""

_WIDTHS = (3, 3, 3, 3, 9)


_ROTATION = np.zeros((3, 3, 4, 4))
"""Rotation matrix of a quaternion times its norm squared, as sums of products of its components."""
for _i in range(3):
    _j, _k = (_i + 1) % 3, (_i + 2) % 3
    _w, _x, _y, _z = 0, _i + 1, _j + 1, _k + 1
    _ROTATION[_i, _i, [_w, _x, _y, _z], [_w, _x, _y, _z]] = 1.0, 1.0, -1.0, -1.0
    _ROTATION[_i, _j, [_x, _w], [_y, _z]] = 2.0, -2.0
    _ROTATION[_i, _k, [_x, _w], [_z, _y]] = 2.0, 2.0
_FROM_PRODUCTS = _ROTATION.reshape(9, 16)


class Transition(NamedTuple):
    """Propagation over a block.

    Attributes:
        matrix: (21, 21) maps the error before the block to the error after it.
        velocity: (3,) change of velocity, m/s.
        field: (3,) sum of the fields, inertial frame.
    """

    matrix: Array
    velocity: Array
    field: Array


def transition(dt: Array, quat: Array, gyr: Array, force: Array, field: Array) -> Transition:
    """Propagate errors and velocity over a block, and sum its fields.

    Args:
        dt: (N,) duration of each sample, s.
        quat: (N, 4) sensor to inertial, in the middle of each sample; of any length but 0.
        gyr: (N, 3) rates as measured, rad/s.
        force: (N, 3) specific force without the known bias, sensor frame, m/s^2.
        field: (N, 3) magnetic fields, sensor frame; 0 where not measured.
    """
    passed = np.cumsum(dt)
    duration = float(passed[-1])
    weights = np.empty((len(dt), 13))
    weights[:, 0] = 1.0
    weights[:, 1:4] = gyr
    weights[:, 4:7] = force
    # Each force is weighted with the share of the block before it, in which a bias has rotated it.
    weights[:, 7:10] = force * ((passed - 0.5 * dt) / duration)[:, None]
    weights[:, :10] *= dt[:, None]
    weights[:, 10:] = field
    weights /= np.einsum("ni,ni->n", quat, quat)[:, None]
    # Matrices are linear in the products of a quaternion's components, so that these are summed, weighted.
    products = (quat[:, :, None] * quat[:, None, :]).reshape(-1, 16)
    sums = _FROM_PRODUCTS @ (products.T @ weights)
    bias, sensitivity = sums[:, 0].reshape(3, 3), sums[:, 1:4].reshape(3, 9)
    push, late_push, total_field = np.einsum("ijkj->ki", sums[:, 4:].reshape(3, 3, 3, 3))
    late_push = _cross(late_push)
    matrix = IDENTITY.copy()
    matrix[TURN, BIAS] = matrix[VEL, ACC_BIAS] = -bias
    matrix[TURN, SENSITIVITY] = -sensitivity
    matrix[VEL, TURN] = -_cross(push)
    matrix[VEL, BIAS] = late_push @ bias
    matrix[VEL, SENSITIVITY] = late_push @ sensitivity
    push[2] -= STANDARD_G * duration
    return Transition(matrix, push, total_field)


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
    noise = np.zeros((SIZE, SIZE))
    noise.reshape(-1)[DIAGONAL] = variance
    return noise


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
