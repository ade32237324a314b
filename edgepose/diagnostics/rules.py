"""What is wrong with a sensor, and what to do about it, from what `sensor_health` measured."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from edgepose.calibration.checks import GRAVITY, GRAVITY_SCALE_LIMIT, GRAVITY_TILT_LIMIT_DEG
from edgepose.calibration.fit import POSE_TILT_DEG
from edgepose.diagnostics.sensor_health import REST_ACC, REST_S, SensorHealth
from edgepose.sources.clock_sync import FOLLOWED_PPM

SILENT_S = 1.0
LOWEST_RATE_HZ = 50.0
LOSS_LEAST = 20  # where devices send no time, the first ones are guessed
INVALID_LIMIT_PERCENT = LOSS_LIMIT_PERCENT = 2.0
INCOMPLETE_LIMIT_PERCENT = 5.0
JITTER_LIMIT_PERIODS = 0.3
LATE_LIMIT_MS, LATE_LIMIT_PERIODS = 10.0, 1.5  # what a frame waits for
REPEATED_LIMIT_PERCENT = 25.0
GYR_NOISE_LIMIT_DEG_S, BIAS_LIMIT_DEG_S = 5.0, 3.0
TABLE_HEADING_LIMIT_DEG, BODY_HEADING_LIMIT_DEG, FOREARM_HEADING_LIMIT_DEG = 10.0, 30.0, 60.0
FIELD_CHANGE_LIMIT_PERCENT, FIELD_RANGE_UT = 35.0, (15.0, 90.0)
AGREEMENT_LIMIT, GYRO_SCALE_LIMIT = 0.7, 0.25
DEGREES_IN_RADIAN = 57.3


class Diagnosis(NamedTuple):
    """The most important thing about a sensor.

    Attributes:
        name: "ok" or one of the names in docs/guide/check.md.
        advice: what it is and what to do, one line; empty where there is nothing to do.
        problem: whether poses suffer; without, the advice only says how more can be found out.
    """

    name: str
    advice: str = ""
    problem: bool = False


def diagnose(sensor: SensorHealth) -> Diagnosis:
    """The most important problem of a sensor; "ok" if there is none."""
    for name, rule in _PROBLEMS.items():
        if (advice := rule(sensor)) is not None:
            return Diagnosis(name, advice, True)
    if not sensor.rests:
        return Diagnosis(
            "ok, moving",
            f"hold it still for {2 * REST_S:g} s: gravity, noise and bias are only seen at rest",
        )
    if not sensor.orientation:
        return Diagnosis("ok, raw", "it sends no orientation: calibrate and run with --filter kalman or vqf")
    return Diagnosis("ok")


def _no_packets(s: SensorHealth) -> str | None:
    if s.samples:
        return None
    return "nothing came: switch it on, check its link, and that its id is right and no other sensor's"


def _silent(s: SensorHealth) -> str | None:
    if s.age_s > SILENT_S:
        return f"nothing for {s.age_s:.1f} s: check its power, battery and link"
    return None


def _nothing_to_fuse(s: SensorHealth) -> str | None:
    if math.isnan(s.rate_hz) or (s.acceleration and (s.orientation or s.gyroscope)):
        return None
    missing = "acceleration" if not s.acceleration else "orientation and no rate of turn"
    return f"it sends no {missing}: switch it on in the device's settings"


def _incomplete(s: SensorHealth) -> str | None:
    if s.incomplete_percent > INCOMPLETE_LIMIT_PERCENT:
        return (
            f"{s.incomplete_percent:.0f} % of its samples lack orientation, acceleration or rate: "
            "send all of them at one rate"
        )
    return None


def _invalid(s: SensorHealth) -> str | None:
    if s.samples and 100.0 * s.invalid / s.samples > INVALID_LIMIT_PERCENT:
        return (
            f"{s.invalid} of {s.samples} samples are no measurement (not a number, or no rotation): "
            "check --protocol, and the sensor"
        )
    return None


def _two_devices(s: SensorHealth) -> str | None:
    if s.two_devices_deg is None:
        return None
    return f"two devices, {s.two_devices_deg:.0f} deg apart, send under its id: give each an id of its own"


def _same(s: SensorHealth) -> str | None:
    if s.same_as is None:
        return None
    return f"it sends the same values as {s.same_as}: one device is read twice, check ids and --sensors"


def _frozen(s: SensorHealth) -> str | None:
    if s.frozen is None:
        return None
    what = "all its values stand" if s.frozen == "everything" else f"its {s.frozen} stands"
    return f"{what} still while it sends: restart the sensor; if it comes again, its firmware or chip hangs"


def _no_gravity(s: SensorHealth) -> str | None:
    if s.norm_m_s2 < 0.5:
        return (
            f"it reads {s.norm_m_s2:.2f} m/s² at rest, so gravity is taken out: "
            "send the acceleration as measured (specific force)"
        )
    return None


def _unit(s: SensorHealth) -> str | None:
    for unit, size in (("g", 1.0), ("milli-g", 1000.0), ("cm/s²", 100.0 * GRAVITY)):
        if abs(s.norm_m_s2 / size - 1.0) < 2.0 * GRAVITY_SCALE_LIMIT:
            return f"it reads {s.norm_m_s2:.4g} at rest, which is in {unit}: send m/s², {GRAVITY} at rest"
    return None


def _scale(s: SensorHealth) -> str | None:
    if abs(s.norm_m_s2 / GRAVITY - 1.0) > GRAVITY_SCALE_LIMIT:
        return (
            f"it reads {s.norm_m_s2:.2f} m/s² at rest, not {GRAVITY}: "
            "check the range that the accelerometer is set to, and calibrate it"
        )
    return None


def _frame(s: SensorHealth) -> str | None:
    if s.tilt_deg > GRAVITY_TILT_LIMIT_DEG:
        return f"orientation and gravity disagree by {s.tilt_deg:.0f} deg at rest: {s.convention}"
    return None


def _gyro_unit(s: SensorHealth) -> str | None:
    if max(s.gyro_agreement, s.gyro_exchanged) < AGREEMENT_LIMIT:
        return None
    for ratio, sent, expected in (
        (DEGREES_IN_RADIAN, "deg/s", "rad/s"),
        (1.0 / DEGREES_IN_RADIAN, "rad/s", "deg/s"),
    ):
        if 0.7 < s.gyro_ratio / ratio < 1.4:
            return (
                f"its rate is {s.gyro_ratio:.3g} times what the orientation turns: "
                f"{sent} is sent where {expected} is expected"
            )
    return None


def _gyro_axes(s: SensorHealth) -> str | None:
    if math.isnan(s.gyro_agreement) or s.gyro_agreement >= AGREEMENT_LIMIT:
        return None
    if s.gyro_exchanged >= AGREEMENT_LIMIT:
        return (
            "axes or signs of the gyroscope are not those of the orientation: bring both to the case's axes"
        )
    return (
        "gyroscope and orientation do not turn together: is the quaternion sensor to inertial, w, x, y, z, "
        "and are both of the same time?"
    )


def _gyro_scale(s: SensorHealth) -> str | None:
    if abs(s.gyro_ratio - 1.0) > GYRO_SCALE_LIMIT:
        return (
            f"its rate is {s.gyro_ratio:.2f} times what the orientation turns: "
            "check the range that the gyroscope is set to"
        )
    return None


def _slow(s: SensorHealth) -> str | None:
    if math.isnan(s.rate_hz):
        return f"only {s.samples} samples came: check its settings and its link"
    if s.rate_hz < 0.96 * LOWEST_RATE_HZ:
        return f"{s.rate_hz:.0f} samples a second: set 100, at least {LOWEST_RATE_HZ:g}, and the baud for it"
    return None


def _loss(s: SensorHealth) -> str | None:
    if s.lost >= LOSS_LEAST and s.lost_percent > LOSS_LIMIT_PERCENT:
        return (
            f"{s.lost_percent:.1f} % of its samples are missing: "
            "check cable, radio and baud, or send less on this line"
        )
    return None


def _irregular(s: SensorHealth) -> str | None:
    if 1e-3 * s.jitter_ms * s.rate_hz > JITTER_LIMIT_PERIODS:
        return f"its intervals vary by {s.jitter_ms:.0f} ms: let a timer start its measurements"
    return None


def _late(s: SensorHealth) -> str | None:
    if s.late_ms > LATE_LIMIT_MS + LATE_LIMIT_PERIODS * 1e3 / s.rate_hz:
        return (
            f"packets come up to {s.late_ms:.0f} ms late, in bursts: "
            "shorten the USB adapter's latency timer, relieve radio or line, or end other programs here"
        )
    return None


def _drift(s: SensorHealth) -> str | None:
    if abs(s.clock_ppm) - 3.0 * s.clock_ppm_error > FOLLOWED_PPM:
        return (
            f"its clock is {abs(s.clock_ppm):.0f} ppm {'slow' if s.clock_ppm > 0.0 else 'fast'}, and "
            f"{FOLLOWED_PPM:g} can be followed: run it on a crystal, or send no time"
        )
    return None


def _restarts(s: SensorHealth) -> str | None:
    if s.clock_restarts:
        return (
            f"its clock began anew {s.clock_restarts} times: check its power; "
            "after a restart its heading may be another"
        )
    return None


def _range(s: SensorHealth) -> str | None:
    if s.saturated is None:
        return None
    return f"{s.saturated} at the end of the range: set 16 g and 2000 deg/s"


def _repeats(s: SensorHealth) -> str | None:
    if s.repeated_percent > REPEATED_LIMIT_PERCENT:
        return (
            f"{s.repeated_percent:.0f} % of its samples are the one before again: "
            "it measures more slowly than it sends"
        )
    return None


def _noise(s: SensorHealth) -> str | None:
    if s.gyr_noise_deg_s > GYR_NOISE_LIMIT_DEG_S or s.acc_noise_m_s2 > REST_ACC:
        return (
            f"at rest it shakes by {s.acc_noise_m_s2:.2f} m/s² and {s.gyr_noise_deg_s:.1f} deg/s: "
            "lay it down; if it stays so, switch its low-pass filter on"
        )
    return None


def _bias(s: SensorHealth) -> str | None:
    if s.bias_deg_s > BIAS_LIMIT_DEG_S:
        return (
            f"it turns by {s.bias_deg_s:.1f} deg/s at rest: let it lie still while it starts, or calibrate it"
        )
    return None


def _heading(s: SensorHealth) -> str | None:
    if s.heading_on == "table" and abs(s.heading_deg) > TABLE_HEADING_LIMIT_DEG:
        return (
            f"lying as the others, its heading is {s.heading_deg:+.0f} deg off: "
            "calibrate with --heading-reset live"
        )
    limit = FOREARM_HEADING_LIMIT_DEG if "forearm" in s.placement else BODY_HEADING_LIMIT_DEG
    if s.heading_on == "body" and abs(s.heading_deg) > limit:
        return (
            f"its heading is {s.heading_deg:+.0f} deg off the others' since the calibration: "
            "stand as then, or calibrate again with a heading reset"
        )
    return None


def _place(s: SensorHealth) -> str | None:
    if s.swapped_with is not None:
        return f"it sits where {s.swapped_with} was calibrated: exchange the two"
    if s.pose_tilt_deg > POSE_TILT_DEG:
        return (
            f"it is tilted by {s.pose_tilt_deg:.0f} deg against the calibration: "
            "stand as then; if it has slipped, calibrate again"
        )
    return None


def _field(s: SensorHealth) -> str | None:
    if s.field_change_percent > FIELD_CHANGE_LIMIT_PERCENT:
        return (
            f"its magnetic field changes by {s.field_change_percent:.0f} %: keep it from magnets and iron, "
            "and calibrate the magnetometer"
        )
    low, high = FIELD_RANGE_UT
    # Some devices send a field of about 1 where they were calibrated.
    if s.field_ut > 5.0 and not low < s.field_ut < high:
        return f"its magnetic field is {s.field_ut:.0f} uT, the Earth's is 25 to 65: a magnet or iron is near"
    return None


_PROBLEMS: dict[str, Callable[[SensorHealth], str | None]] = {
    "no packets": _no_packets,
    "silent": _silent,
    "not sent": _nothing_to_fuse,
    "invalid": _invalid,
    "incomplete": _incomplete,
    "two devices": _two_devices,
    "same data": _same,
    "frozen": _frozen,
    "no gravity": _no_gravity,
    "unit": _unit,
    "scale": _scale,
    "frame": _frame,
    "gyro unit": _gyro_unit,
    "gyro axes": _gyro_axes,
    "gyro scale": _gyro_scale,
    "slow": _slow,
    "loss": _loss,
    "irregular": _irregular,
    "late": _late,
    "clock": _drift,
    "restarts": _restarts,
    "range": _range,
    "repeats": _repeats,
    "noise": _noise,
    "bias": _bias,
    "placement": _place,
    "heading": _heading,
    "field": _field,
}
"""Rules by name, the most important first."""
