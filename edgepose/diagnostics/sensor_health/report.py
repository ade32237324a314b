"""Result of all measurements of one sensor."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class SensorHealth:
    """Health of one sensor; NaN and None mean unknown.

    Attributes:
        placement: its name.
        samples: number of samples so far.
        age_s: age of the newest sample.
        rate_hz: samples a second, without gaps.
        jitter_ms: deviation of the intervals, without gaps.
        lost: number of samples missing in the sensor's times; lost_percent: their share of all.
        late_ms: 95 % of the packets come no later than this after the fastest ones.
        lag_ms: delay that is this machine's: 95 % of its threads' waits end no later than this.
        invalid: number of samples with a NaN or with a quaternion that is not a rotation.
        orientation: whether it sends one; acceleration, gyroscope and magnetometer likewise.
        incomplete_percent: samples without a quantity that others have.
        rests: number of attitudes in which it has been at rest.
        norm_m_s2: length of the acceleration at rest; ideally 9.81.
        gravity_error_m_s2: largest length of R f + g at rest; ideally 0.
        tilt_deg: largest angle at rest between the acceleration in the inertial frame and up.
        convention: a convention that would explain that angle.
        acc_noise_m_s2: deviation of the acceleration at rest; gyr_noise_deg_s: that of the rate.
        bias_deg_s: mean rate at rest.
        clock_ppm: loss of the device's clock against this machine's; clock_ppm_error: its standard error.
        clock_restarts: number of restarts of the device's clock.
        field_ut: median strength of the magnetic field, in uT or in the device's own unit.
        field_change_percent: range of that strength from the 5th to the 95th percentile.
        heading_deg: against the median of all sensors, lying side by side or standing in the pose.
        heading_on: "table" or "body".
        pose_tilt_deg: tilt against the calibration's pose in which the wearer stands, or should.
        in_pose: whether most sensors say that the wearer stands in it.
        swapped_with: the placement with which it must be swapped to fit that pose.
        impossible: what is wrong with its bone over time: an orientation that no body can take, or a slip.
        repeated_percent: samples that are the same as the one before, in motion.
        frozen: quantity that does not change while the sensor moves, or "everything" if only the other
            sensors change.
        saturated: quantities that have been at the end of their range.
        gyro_ratio: rate of the gyroscope over that of the orientation.
        gyro_agreement: correlation of the two; ideally 1.
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
    lag_ms: float = 0.0
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
    in_pose: bool | None = None
    swapped_with: str | None = None
    impossible: str | None = None
    repeated_percent: float = math.nan
    frozen: str | None = None
    saturated: str | None = None
    gyro_ratio: float = math.nan
    gyro_agreement: float = math.nan
    gyro_exchanged: float = math.nan
    two_devices_deg: float | None = None
    same_as: str | None = None
