"""The result of all measurements of one sensor."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class SensorHealth:
    """What is known of one sensor; NaN and None where it is not.

    Attributes:
        placement: its name.
        samples: that have come.
        age_s: of the newest one.
        rate_hz: samples a second, gaps left out.
        jitter_ms: deviation of the intervals, gaps left out.
        lost: samples missing in the times of the sensor, lost_percent of all.
        late_ms: 95 % of the packets come no later than this after the fastest ones.
        invalid: samples with a NaN or with a quaternion that is no rotation.
        orientation: whether it sends one; acceleration, gyroscope and magnetometer alike.
        incomplete_percent: samples without something that others have.
        rests: attitudes in which it has been at rest.
        norm_m_s2: length of the acceleration at rest; 9.81.
        gravity_error_m_s2: largest length of R f + g at rest; 0.
        tilt_deg: largest angle at rest between the acceleration in the inertial frame and up.
        convention: what would explain that angle.
        acc_noise_m_s2: deviation of the acceleration at rest, gyr_noise_deg_s that of the rate.
        bias_deg_s: mean rate at rest.
        clock_ppm: what the device's clock loses against this machine's, with its standard error.
        clock_restarts: times that it began anew.
        field_ut: median length of the magnetic field, in uT or in the device's own unit.
        field_change_percent: between the 5th and 95th percentile of that length.
        heading_deg: against the median of all sensors, lying side by side or standing in the pose.
        heading_on: "table" or "body".
        pose_tilt_deg: tilt against the calibration's pose in which the wearer stands.
        swapped_with: the placement with which exchanged it would stand in that pose.
        repeated_percent: samples that are the same as the one before, in motion.
        frozen: what stands still while the sensor moves, or "everything" while the others go on.
        saturated: what has been at the end of its range.
        gyro_ratio: rate of the gyroscope over that of the orientation.
        gyro_agreement: correlation of the two; 1.
        gyro_exchanged: the same with the best exchange of axes and signs.
        two_devices_deg: angle between two devices that alternate under this name.
        same_as: a placement that sends the same values.
    """

    placement: str
    samples: int = 0
    age_s: float = math.nan
    rate_hz: float = math.nan
    jitter_ms: float = math.nan
    lost: int = 0
    lost_percent: float = math.nan
    late_ms: float = math.nan
    invalid: int = 0
    orientation: bool = False
    acceleration: bool = False
    gyroscope: bool = False
    magnetometer: bool = False
    incomplete_percent: float = math.nan
    rests: int = 0
    norm_m_s2: float = math.nan
    gravity_error_m_s2: float = math.nan
    tilt_deg: float = math.nan
    convention: str | None = None
    acc_noise_m_s2: float = math.nan
    gyr_noise_deg_s: float = math.nan
    bias_deg_s: float = math.nan
    clock_ppm: float = math.nan
    clock_ppm_error: float = math.nan
    clock_restarts: int = 0
    field_ut: float = math.nan
    field_change_percent: float = math.nan
    heading_deg: float = math.nan
    heading_on: str | None = None
    pose_tilt_deg: float = math.nan
    swapped_with: str | None = None
    repeated_percent: float = math.nan
    frozen: str | None = None
    saturated: str | None = None
    gyro_ratio: float = math.nan
    gyro_agreement: float = math.nan
    gyro_exchanged: float = math.nan
    two_devices_deg: float | None = None
    same_as: str | None = None
