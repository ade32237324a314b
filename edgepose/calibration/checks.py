"""Checks of a hold: all sensors reported, held still and measured gravity upwards."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from edgepose import rotations as rot
from edgepose.calibration.static_pose import (
    MIN_SAMPLES,
    Hold,
    SensorHold,
    check_reported,
    sensor_names,
    unit_or_zero,
)
from edgepose.errors import CalibrationError
from edgepose.placements import PLACEMENTS
from edgepose.rotations import Array, tilt_deg
from edgepose.utils import fault_messages as messages

SPREAD_LIMIT_DEG = 3.0  # RMS about the mean over a hold; standing people sway 0.1 - 0.5
GAP_LIMIT_S = 0.5  # longest time without a sample within a hold; radios lose some tenths of a second
DRIFT_LIMIT_DEG = 5.0  # first against last quarter of a hold
RATE_LIMIT_DEG_S = (
    20.0  # RMS of the angular rate without its mean, which may be bias; standing people 0.3 - 3
)
GRAVITY_TILT_LIMIT_DEG = 10.0

_EARLIER = (2, 3)  # samples between those of one device, if two alternate


class HoldError(CalibrationError):
    """A hold that cannot be used; the wearer can try again."""


class MovedError(HoldError):
    """A hold with movement in it."""


class HoldSummary(NamedTuple):
    """Means of a hold of N sensors that passed its checks.

    Attributes:
        samples: (N,) number of samples.
        orientation: (N, 4) mean quaternions, sensor to inertial, without any heading offset.
        spread_deg: (N,) RMS angle about the mean, degrees.
        force: (N, 3) mean specific force in I, m/s^2; NaN where a sensor measures none.
        warnings: one line each, naming the sensor.
        names: of the sensors.
    """

    samples: list[int]
    orientation: Array
    spread_deg: Array
    force: Array
    warnings: list[str]
    names: Sequence[str] = PLACEMENTS


def check_hold(hold: Hold, advice: str = "stand still and repeat") -> HoldSummary:
    """Check that every sensor reported, was held still and measured gravity along +Z of I; return the means.

    Args:
        hold: the sensors' samples.
        advice: what to do about movement, for the message.

    Raises:
        MovedError: sensors moved; names all of them and their movement.
        HoldError: sensors were silent for a part of it; names them.
        CalibrationError: any other fault of the hold; names the sensors and what to do.
    """
    check_reported(hold)
    few = [f"{s.name} {len(s.quat)}" for s in hold if len(s.quat) < MIN_SAMPLES]
    if few:
        raise CalibrationError(
            f"too few samples in the hold ({', '.join(few)}; at least {MIN_SAMPLES}): "
            "check the rate and the link, or hold longer"
        )
    check_covered(hold, min(s.time_s.min() for s in hold), max(s.time_s.max() for s in hold))
    broken = [f"{s.name} ({bad} of {len(s.quat)})" for s in hold if (bad := _not_rotations(s.quat))]
    if broken:
        raise CalibrationError(
            f"quaternions that are not rotations (not of length 1): {', '.join(broken)}; "
            "check the protocol and the sensor's settings"
        )
    quats = [unit_or_zero(s.quat) for s in hold]
    shared = [
        (s.name, apart)
        for s, quat in zip(hold, quats, strict=True)
        if (apart := detect_alternating_devices(quat)) is not None
    ]
    if shared:
        raise CalibrationError("; ".join(f"{name}: {messages.two_devices(apart)}" for name, apart in shared))
    mean = np.stack([rot.mean_rotation(quat) for quat in quats])
    spread = np.array([_rms(_angles(quat, centre)) for quat, centre in zip(quats, mean, strict=True)])
    moved = [
        text for s, quat, rms in zip(hold, quats, spread, strict=True) if (text := _movement(s, quat, rms))
    ]
    if moved:
        raise MovedError(f"moved during the hold: {', '.join(moved)}; {advice}")
    force, warnings = _gravity(hold, quats)
    counts = [len(s.quat) for s in hold]
    return HoldSummary(counts, mean, np.degrees(spread), force, warnings, sensor_names(hold))


def check_covered(hold: Hold, start_s: float, end_s: float) -> None:
    """Check that every sensor sent samples during all of a hold.

    Args:
        hold: the sensors' samples.
        start_s: start of the hold, on the clock of the samples, seconds.
        end_s: its end.

    Raises:
        HoldError: sensors were silent for a part of it; names them.
        CalibrationError: a sensor sent nothing at all, or no orientation.
    """
    check_reported(hold)
    gaps = [np.diff(np.sort([start_s, *s.time_s, end_s])).max() for s in hold]
    if silent := [
        f"{s.name} for {gap:.1f} s" for s, gap in zip(hold, gaps, strict=True) if gap > GAP_LIMIT_S
    ]:
        raise HoldError(
            f"silent during a part of the hold: {', '.join(silent)}; check power and link, and hold again or "
            "choose another part of the recording"
        )


def _not_rotations(quat: Array) -> int:
    # `not x < limit` instead of `x >= limit`, so that NaN counts.
    return int(np.count_nonzero(~(np.abs(np.linalg.norm(quat, axis=-1) - 1.0) < 0.01)))


def _angles(quat: Array, reference: Array) -> Array:
    """Return the rotation angles (n,) between unit quaternions (n, 4) and one (4,), radians."""
    return np.linalg.norm(rot.quat_to_rotvec(rot.quat_multiply(rot.quat_conjugate(reference), quat)), axis=-1)


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


def detect_alternating_devices(quat: Array) -> float | None:
    """Return the angle, degrees, between two devices whose samples (n, 4) alternate; None if it is one."""
    at_rest = _alternating_at_rest(quat)
    return _alternating_in_motion(quat) if at_rest is None else at_rest


def _alternating_at_rest(quat: Array) -> float | None:
    from_first = _angles(quat, quat[0])
    far = from_first > from_first.max() / 2
    # A single moving sensor passes through the angles between, and does not change sides every few samples.
    if np.count_nonzero(far[1:] != far[:-1]) < max(4, len(quat) / 10):
        return None
    near, other = quat[~far], quat[far]
    centre, other_centre = rot.mean_rotation(near), rot.mean_rotation(other)
    spread = math.degrees(max(_rms(_angles(near, centre)), _rms(_angles(other, other_centre))))
    apart = math.degrees(_angles(other_centre[None], centre)[0])
    return apart if spread < SPREAD_LIMIT_DEG and apart > max(2.0 * SPREAD_LIMIT_DEG, 4.0 * spread) else None


def _alternating_in_motion(quat: Array) -> float | None:
    # A single device is nearest to where it was a sample ago, except at the turning points of a fast swing.
    if len(quat) <= _EARLIER[-1]:
        return None
    now = quat[_EARLIER[-1] :]
    apart = [rot.angle_between_quats(quat[_EARLIER[-1] - k : len(quat) - k], now) for k in (1, *_EARLIER)]
    jumps = (apart[0] > math.radians(2.0 * SPREAD_LIMIT_DEG)) & (np.min(apart[1:], axis=0) < apart[0] / 4.0)
    if np.count_nonzero(jumps) < max(4, len(now) / 2):
        return None
    return math.degrees(float(np.median(apart[0][jumps])))


def _movement(s: SensorHold, quat: Array, spread: float) -> str | None:
    """Describe the movement of one sensor; None if it held still."""
    quarter = max(1, len(quat) // 4)
    drift = _angles(rot.mean_rotation(quat[-quarter:])[None], rot.mean_rotation(quat[:quarter]))[0]
    if math.degrees(spread) > SPREAD_LIMIT_DEG or math.degrees(drift) > DRIFT_LIMIT_DEG:
        return f"{s.name} {math.degrees(max(spread, drift)):.1f} deg"
    gyr = s.gyr[np.isfinite(s.gyr).all(axis=-1)]
    rate = math.degrees(_rms(np.linalg.norm(gyr - gyr.mean(axis=0), axis=-1))) if len(gyr) else 0.0
    return f"{s.name} {rate:.0f} deg/s" if rate > RATE_LIMIT_DEG_S else None


def _gravity(hold: Hold, quats: list[Array]) -> tuple[Array, list[str]]:
    """Return mean specific forces in I (N, 3), m/s^2, and warnings about their size; raise if not upwards."""
    force, warnings = np.full((len(hold), 3), np.nan), []
    removed: list[str] = []
    tilted: dict[str, float] = {}
    fitting: dict[str, list[str]] = {}
    for i, (s, quat) in enumerate(zip(hold, quats, strict=True)):
        name = s.name
        measured = np.isfinite(s.acc).all(axis=-1)
        if not measured.any():
            warnings.append(f"{name} measures no acceleration: gravity was not checked")
            continue
        acc, quat = s.acc[measured], quat[measured]
        force[i] = rot.quat_rotate(quat, acc).mean(axis=0)
        size = float(np.linalg.norm(acc.mean(axis=0)))
        if (problem := messages.no_gravity(size)) is not None:
            removed.append(f"{name}: {problem}")
        elif tilt_deg(force[i]) > GRAVITY_TILT_LIMIT_DEG:
            tilted[name], fitting[name] = tilt_deg(force[i]), fitting_conventions(quat, acc)
        elif (problem := messages.wrong_unit(size) or messages.wrong_scale(size)) is not None:
            warnings.append(f"{name}: {problem}")
    conventions = messages.shared_convention(fitting)
    wrong = [f"{name}: {messages.wrong_frame(tilt, conventions[name])}" for name, tilt in tilted.items()]
    if removed or wrong:
        raise CalibrationError("; ".join([*removed, *wrong]))
    return force, warnings


def fitting_conventions(quat: Array, acc: Array) -> list[str]:
    """Return the conventions, other than ours, in which gravity would point the right way in one hold.

    Args:
        quat: (n, 4) quaternions of one sensor.
        acc: (n, 3) specific forces, m/s^2.
    """
    guesses: list[tuple[str, Array]] = [
        ("looks negated: acceleration instead of specific force, or Z down", -rot.quat_rotate(quat, acc)),
        (
            "looks like an inverse: the quaternion must rotate sensor to inertial",
            rot.quat_rotate(rot.quat_conjugate(quat), acc),
        ),
        (
            "looks like x, y, z, w: the quaternion must be w, x, y, z",
            rot.quat_rotate(quat[:, [3, 0, 1, 2]], acc),
        ),
        (
            "looks like a frame with Y up: the inertial frame must have Z up",
            rot.quat_rotate(quat, acc)[:, [2, 0, 1]],
        ),
    ]
    return [why for why, f in guesses if tilt_deg(f.mean(axis=0)) < GRAVITY_TILT_LIMIT_DEG]
