"""Errors of IMU chips: noise and bias of rates, forces and magnetic field, and no orientation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from edgepose.calibration import GRAVITY
from edgepose.imu import SensorData
from edgepose.rotations import Array, quat_conjugate, quat_rotate


class ImuErrorModel(NamedTuple):
    """Errors of one type of chip; biases are standard deviations between chips.

    Attributes:
        gyr_noise: rad/s/sqrt(Hz).
        gyr_bias: rad/s.
        acc_noise: m/s^2/sqrt(Hz).
        acc_bias: m/s^2.
        mag_noise: uT, per sample.
    """

    gyr_noise: float
    gyr_bias: float
    acc_noise: float
    acc_bias: float
    mag_noise: float


BMI270 = ImuErrorModel(
    gyr_noise=np.radians(0.007), gyr_bias=np.radians(0.5),
    acc_noise=160e-6 * GRAVITY, acc_bias=20e-3 * GRAVITY, mag_noise=0.5,
)  # fmt: skip
"""Bosch BST-BMI270-DS000, revision 1.3: typical noise densities, zero-rate and zero-g offsets. The chip has
no magnetometer; that noise is typical of common ones.
"""

FIELD_UT = (0.0, 20.0, -40.0)
"""Magnetic field in the inertial frame, roughly that of central Europe."""


def raw(data: SensorData, chip: ImuErrorModel, seed: int, magnetometer: bool) -> SensorData:
    """Return the measurements of a chip instead of an ideal sensor: without orientation, with errors.

    Raises:
        ValueError: rates, forces, or the orientation that the magnetic field is derived from are missing.
    """
    if data.gyr is None or data.acc is None or (magnetometer and data.mag is None and data.quat is None):
        raise ValueError("errors can only be added to rates and forces, which are missing")
    rng = np.random.default_rng(seed)
    # The biases are drawn first, so that a chip's biases do not depend on what it records.
    gyr_bias, acc_bias = rng.normal(0.0, chip.gyr_bias, 3), rng.normal(0.0, chip.acc_bias, 3)
    # White noise up to half the sample rate.
    bandwidth = np.sqrt(0.5 / np.median(np.diff(data.time_s)))

    def add_errors(rows: Array, noise: float, bias: Array | float) -> Array:
        return rows + bias + rng.normal(0.0, noise, rows.shape)

    gyr = add_errors(data.gyr, chip.gyr_noise * bandwidth, gyr_bias)
    acc = add_errors(data.acc, chip.acc_noise * bandwidth, acc_bias)
    mag = None
    if magnetometer:
        ideal = data.mag if data.mag is not None else quat_rotate(quat_conjugate(data.quat), FIELD_UT)
        mag = add_errors(ideal, chip.mag_noise, 0.0)
    return SensorData(data.time_s, None, acc, gyr, mag)
