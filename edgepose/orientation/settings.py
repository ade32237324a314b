"""Constants of the orientation filter, in physical units; none depends on a sensor's rate."""

from __future__ import annotations

from dataclasses import dataclass
from math import radians


@dataclass(frozen=True)
class FilterSettings:
    """Assumptions that suit sensors the filter was not tuned for; SI units.

    Attributes:
        block_s: time between corrections, s. Orientations are integrated at every sample.
        gyr_noise: growth of the orientation error, rad / sqrt(s).
        vel_noise: growth of the velocity error, m/s / sqrt(s).
        bias_start: initial gyroscope bias, one sigma, rad/s.
        bias_walk: random walk of that bias, rad/s / sqrt(s). Forces and vibration move it by some 0.05 deg/s
            between rest and motion.
        sensitivity_start: relative error of the gyroscope's scale, per axis, and its sensitivity to rotation
            about each other axis, one sigma. Data sheets allow one or two percent of both.
        sensitivity_walk: random walk of each of these, 1 / sqrt(s).
        acc_bias_start: initial accelerometer bias, one sigma per axis, m/s^2.
        acc_bias_walk: random walk of that bias, m/s^2 / sqrt(s).
        tilt_start: error of the tilt taken from a first force, perhaps in motion, one sigma, rad.
        heading_start: error of the heading taken from the first field, one sigma, rad.
        vel: speed of the sensor, one sigma, m/s: a body does not go far in a room.
        vel_time: correlation time of the velocity, s.
        vel_limit: speed that a body hardly exceeds, m/s. A higher one that the error of the tilt does not
            explain shows no tilt.
        rest_gyr: largest change of the rate at rest, rad/s.
        rest_acc: largest change of the force at rest, m/s^2.
        rest_time: time for which both must hold before the sensor counts as at rest, s.
        rest_bias: largest rate at rest beyond the known bias, rad/s.
        rest_bias_first: largest rate at the first rest, when the bias is not yet known, rad/s.
        rest_rate: error of the bias measured in a block at rest, one sigma, rad/s.
        rest_vel: error of a velocity of zero in a block at rest, one sigma, m/s.
        mag_heading: heading error of an undisturbed field, one sigma, rad.
        mag_time: correlation time of that error, s.
        mag_norm: relative change of the field's strength above which it counts as disturbed.
        mag_dip: change of the field's dip above which it counts as disturbed, rad.
        mag_soft: growth of the heading's variance with the square of the change, per percent of strength and
            per degree of dip.
        mag_good_s: time without a disturbance before a field is trusted again, s.
        mag_reference_s: time constant of the undisturbed field's strength and dip, s.
        mag_first_s: time for which a field must have been constant to be the first reference, s.
        mag_new_s: time after which a field that is constant while the sensor turns becomes the new
            reference, s.
        mag_new_rate: slowest rotation for which that time counts, rad/s.
        mag_reject_s: longest time for which a disturbed field is ignored, s.
        mag_lost_s: time without a reading after which the magnetometer counts as lost, s.
        gap_periods: interval, in usual sample periods, above which samples count as missing.
        gap_turn: unseen change of the rate of rotation in a gap, rad/s^2.
        gap_acc: unseen acceleration in a gap, m/s^2.
        restart_s: gap after which the tilt is taken from the force again, s.
        lost_share: unseen part of a rate or a force at the end of its range, as a share of it.
        shock: force above which the accelerometer is not trusted, m/s^2.
    """

    block_s: float = 0.14
    gyr_noise: float = radians(0.2)
    vel_noise: float = 0.03
    bias_start: float = radians(3.0)
    bias_walk: float = radians(0.01)
    sensitivity_start: float = 0.01
    sensitivity_walk: float = 2e-5
    acc_bias_start: float = 0.1
    acc_bias_walk: float = 1e-3
    tilt_start: float = radians(20.0)
    heading_start: float = radians(60.0)
    vel: float = 1.0
    vel_time: float = 1.0
    vel_limit: float = 3.0
    rest_gyr: float = radians(2.0)
    rest_acc: float = 0.5
    rest_time: float = 1.5
    rest_bias: float = radians(2.0)
    rest_bias_first: float = radians(20.0)
    rest_rate: float = radians(0.03)
    rest_vel: float = 0.02
    mag_heading: float = radians(5.0)
    mag_time: float = 20.0
    mag_norm: float = 0.1
    mag_dip: float = radians(5.0)
    mag_soft: float = 0.5
    mag_good_s: float = 0.5
    mag_reference_s: float = 40.0
    mag_first_s: float = 2.0
    mag_new_s: float = 20.0
    mag_new_rate: float = radians(20.0)
    mag_reject_s: float = 60.0
    mag_lost_s: float = 1.0
    gap_periods: float = 1.75
    gap_turn: float = 10.0
    gap_acc: float = 5.0
    restart_s: float = 1.0
    lost_share: float = 0.3
    shock: float = 100.0
