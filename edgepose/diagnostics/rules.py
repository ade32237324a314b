"""Rules that turn the measurements of `sensor_health` into a diagnosis of a sensor, with advice."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

from edgepose.calibration.checks import GRAVITY_TILT_LIMIT_DEG
from edgepose.calibration.fit import POSE_TILT_DEG
from edgepose.calibration.misfit import UPSIDE_DOWN_DEG
from edgepose.diagnostics.sensor_health import REST_ACC, REST_S, SensorHealth
from edgepose.sources.clock_sync import FOLLOWED_PPM
from edgepose.utils import fault_messages as messages

SILENT_S = 1.0
LOWEST_RATE_HZ = 50.0
LOSS_LEAST = 20  # without device times, the first losses are guesses
INVALID_LIMIT_PERCENT = LOSS_LIMIT_PERCENT = 2.0
INCOMPLETE_LIMIT_PERCENT = 5.0
JITTER_LIMIT_PERIODS = 0.3
LATE_LIMIT_MS, LATE_LIMIT_PERIODS = 10.0, 1.5  # delay that a frame waits for
REPEATED_LIMIT_PERCENT = 25.0
GYR_NOISE_LIMIT_DEG_S, BIAS_LIMIT_DEG_S = 5.0, 3.0
TABLE_HEADING_LIMIT_DEG, BODY_HEADING_LIMIT_DEG, FOREARM_HEADING_LIMIT_DEG = 10.0, 30.0, 60.0
FIELD_CHANGE_LIMIT_PERCENT, FIELD_RANGE_UT = 35.0, (15.0, 90.0)
AGREEMENT_LIMIT, GYRO_SCALE_LIMIT = 0.7, 0.25
DEGREES_IN_RADIAN = 57.3


class Diagnosis(NamedTuple):
    """The most important finding about a sensor.

    Attributes:
        name: "ok" or one of the names in docs/guide/check.md.
        advice: the finding and what to do, one line; empty if there is nothing to do.
        problem: whether poses suffer; if not, the advice only says how to find out more.
    """

    name: str
    advice: str = ""
    problem: bool = False


def diagnose(sensor: SensorHealth) -> Diagnosis:
    """Return the most important problem of a sensor; "ok" if there is none."""
    for name, rule in _PROBLEMS.items():
        if (advice := rule(sensor)) is not None:
            return Diagnosis(name, advice, True)
    if not sensor.rests:
        return Diagnosis(
            "ok, moving",
            f"hold it still for {2 * REST_S:g} s: gravity, noise and bias only show at rest",
        )
    if not sensor.orientation:
        return Diagnosis("ok, raw", "it sends no orientation: calibrate and run with --filter kalman or vqf")
    return Diagnosis("ok")


def _no_packets(s: SensorHealth) -> str | None:
    if s.samples:
        return None
    return "no packet came from it: switch it on, check its link, and check that its id is right"


def _silent(s: SensorHealth) -> str | None:
    if s.age_s > SILENT_S:
        return f"nothing for {s.age_s:.1f} s: check its power, battery and link"
    return None


def _nothing_to_fuse(s: SensorHealth) -> str | None:
    if math.isnan(s.rate_hz) or (s.acceleration and (s.orientation or s.gyroscope)):
        return None
    missing = "acceleration" if not s.acceleration else "orientation and no angular rate"
    return f"it sends no {missing}: enable it in the device's settings"


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
            f"{s.invalid} of {s.samples} samples are not measurements (not a number, or not a rotation): "
            "check --protocol and the sensor"
        )
    return None


def _two_devices(s: SensorHealth) -> str | None:
    if s.two_devices_deg is None and s.clock_restarts < messages.JUMPS_OF_TWO:
        return None
    return messages.two_devices(s.two_devices_deg)


def _same(s: SensorHealth) -> str | None:
    if s.same_as is None:
        return None
    return f"it sends the same values as {s.same_as}: one device is read twice; check ids and --sensors"


def _frozen(s: SensorHealth) -> str | None:
    if s.frozen is None:
        return None
    frozen = "none of its values changes" if s.frozen == "everything" else f"its {s.frozen} does not change"
    return f"{frozen} while it sends: restart the sensor; if it happens again, its firmware or chip hangs"


def _no_gravity(s: SensorHealth) -> str | None:
    return messages.no_gravity(s.norm_m_s2)


def _unit(s: SensorHealth) -> str | None:
    return messages.wrong_unit(s.norm_m_s2)


def _scale(s: SensorHealth) -> str | None:
    return messages.wrong_scale(s.norm_m_s2)


def _frame(s: SensorHealth) -> str | None:
    if s.tilt_deg > GRAVITY_TILT_LIMIT_DEG:
        return messages.wrong_frame(s.tilt_deg, s.convention)
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
                f"its rate is {s.gyro_ratio:.3g} times that of its orientation: "
                f"it sends {sent} instead of {expected}"
            )
    return None


def _gyro_axes(s: SensorHealth) -> str | None:
    if math.isnan(s.gyro_agreement) or s.gyro_agreement >= AGREEMENT_LIMIT:
        return None
    if s.gyro_exchanged >= AGREEMENT_LIMIT:
        return (
            "gyroscope and orientation differ in axes or signs: output both in the axes of the sensor's case"
        )
    return (
        "gyroscope and orientation disagree: is the quaternion sensor to inertial, w, x, y, z, "
        "and were both measured at the same time?"
    )


def _gyro_scale(s: SensorHealth) -> str | None:
    if abs(s.gyro_ratio - 1.0) > GYRO_SCALE_LIMIT:
        return (
            f"its rate is {s.gyro_ratio:.2f} times that of its orientation: "
            "check the gyroscope's range setting"
        )
    return None


def _slow(s: SensorHealth) -> str | None:
    if math.isnan(s.rate_hz):
        return f"only {s.samples} samples came: check its settings and its link"
    if s.rate_hz < 0.96 * LOWEST_RATE_HZ:
        return f"{s.rate_hz:.0f} samples a second: set 100, or at least {LOWEST_RATE_HZ:g}, with enough baud"
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
        return f"its intervals vary by {s.jitter_ms:.0f} ms: trigger its measurements by a timer"
    return None


def _late(s: SensorHealth) -> str | None:
    # Both the reading thread and what it waits for may be late.
    if s.late_ms > _late_limit_ms(s) + 2.0 * s.lag_ms:
        return (
            f"packets come up to {s.late_ms:.0f} ms late, in bursts: "
            "shorten the USB adapter's latency timer, reduce the load on radio or line, or end other programs"
        )
    return None


def _late_limit_ms(s: SensorHealth) -> float:
    return LATE_LIMIT_MS + LATE_LIMIT_PERIODS * 1e3 / s.rate_hz


def busy_machine(sensors: Iterable[SensorHealth]) -> str | None:
    """Return a message if packets come late, but perhaps only because this machine is busy."""
    lags = [s.lag_ms for s in sensors if s.late_ms > _late_limit_ms(s) and _late(s) is None]
    if not lags:
        return None
    return (
        f"this machine is busy: programs wait up to {max(lags):.0f} ms for their turn, which hides whether "
        "packets come late; end other programs"
    )


def _drift(s: SensorHealth) -> str | None:
    if abs(s.clock_ppm) - 3.0 * s.clock_ppm_error > FOLLOWED_PPM:
        return (
            f"its clock is {abs(s.clock_ppm):.0f} ppm {'slow' if s.clock_ppm > 0.0 else 'fast'}, but at most "
            f"{FOLLOWED_PPM:g} can be followed: run it on a crystal, or send no time"
        )
    return None


def _restarts(s: SensorHealth) -> str | None:
    if s.clock_restarts:
        return f"{messages.clock_restarted(s.clock_restarts)}: check its power"
    return None


def _range(s: SensorHealth) -> str | None:
    if s.saturated is None:
        return None
    return f"{s.saturated} at the end of the range: set 16 g and 2000 deg/s"


def _repeats(s: SensorHealth) -> str | None:
    if s.repeated_percent > REPEATED_LIMIT_PERCENT:
        return (
            f"{s.repeated_percent:.0f} % of its samples repeat the one before: "
            "it measures more slowly than it sends"
        )
    return None


def _noise(s: SensorHealth) -> str | None:
    if s.gyr_noise_deg_s > GYR_NOISE_LIMIT_DEG_S or s.acc_noise_m_s2 > REST_ACC:
        return (
            f"at rest its noise is {s.acc_noise_m_s2:.2f} m/s² and {s.gyr_noise_deg_s:.1f} deg/s: "
            "lay it down; if that does not help, enable its low-pass filter"
        )
    return None


def _bias(s: SensorHealth) -> str | None:
    if s.bias_deg_s > BIAS_LIMIT_DEG_S:
        return f"its rate is {s.bias_deg_s:.1f} deg/s at rest: keep it still while it starts, or calibrate it"
    return None


def _heading(s: SensorHealth) -> str | None:
    if s.heading_on == "table" and abs(s.heading_deg) > TABLE_HEADING_LIMIT_DEG:
        return (
            f"lying like the others, its heading is {s.heading_deg:+.0f} deg off: "
            "calibrate with --heading-reset live"
        )
    limit = FOREARM_HEADING_LIMIT_DEG if "forearm" in s.placement else BODY_HEADING_LIMIT_DEG
    if s.heading_on == "body" and abs(s.heading_deg) > limit:
        return (
            f"its heading has moved by {s.heading_deg:+.0f} deg against the others since the calibration: "
            "stand as you did then, or calibrate again with a heading reset"
        )
    return None


def _placement(s: SensorHealth) -> str | None:
    if s.swapped_with is not None:
        return f"it is where {s.swapped_with} was calibrated: swap the two"
    if s.pose_tilt_deg > POSE_TILT_DEG and not s.in_pose:
        return (
            f"it is tilted by {s.pose_tilt_deg:.0f} deg against the calibration, as are others: stand in its "
            "pose; if you did, it is the calibration of another wearer or rig: calibrate again"
        )
    if s.pose_tilt_deg > UPSIDE_DOWN_DEG:
        return (
            f"it is turned by {s.pose_tilt_deg:.0f} deg against the calibration: it sits upside down; "
            "turn it round, or calibrate again"
        )
    if s.pose_tilt_deg > POSE_TILT_DEG:
        return (
            f"it is tilted by {s.pose_tilt_deg:.0f} deg against the calibration: "
            "stand as you did then; if it has slipped, calibrate again"
        )
    return s.impossible


def _field(s: SensorHealth) -> str | None:
    if s.field_change_percent > FIELD_CHANGE_LIMIT_PERCENT:
        return (
            f"its magnetic field changes by {s.field_change_percent:.0f} %: keep it away from magnets and "
            "iron, and calibrate the magnetometer"
        )
    low, high = FIELD_RANGE_UT
    # Some calibrated devices scale the field to about 1.
    if s.field_ut > 5.0 and not low < s.field_ut < high:
        return (
            f"its magnetic field is {s.field_ut:.0f} uT, but the Earth's is 25 to 65: "
            "move it away from magnets and iron"
        )
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
    "placement": _placement,
    "heading": _heading,
    "field": _field,
}
"""Rules by name, most important first."""

MAKE_POSES_WRONG = frozenset(("two devices", "same data", "no gravity", "unit", "scale", "frame"))
"""Names of the problems that make poses wrong without any other sign."""
