"""From oriented sensors to bones in the body frame (DIP 4.2): heading reset, body frame, bone offsets.

Frames: I inertial (Z up), S one sensor, T body (X to the wearer's left, Y up, Z forward), B one bone. Angles
are radians, except where a name ends in `_deg`: those are for a person.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from edgepose import rotations as rot
from edgepose.errors import EdgeposeError
from edgepose.imu import ImuSample
from edgepose.placements import PLACEMENTS, ROOT
from edgepose.recording import Recording
from edgepose.rotations import Array

GRAVITY = 9.81
"""What a sensor at rest measures, m/s^2; in I along +Z."""

MIN_SAMPLES = 10
SPREAD_LIMIT_DEG = 3.0  # RMS about the mean over a hold; standing people sway 0.1 - 0.5
DRIFT_LIMIT_DEG = 5.0  # first against last quarter of a hold
RATE_LIMIT_DEG_S = (
    20.0  # RMS of the angular rate without its mean, which may be bias; standing people 0.3 - 3
)
GRAVITY_SCALE_LIMIT = 0.05
GRAVITY_TILT_LIMIT_DEG = 10.0
RESET_TILT_LIMIT_DEG = 15.0
FRAME_TILT_LIMIT_DEG = 20.0

_FORMAT, _VERSION = "edgepose-calibration", 1
_UP = np.array([0.0, 0.0, 1.0])


def _arms(turn: float) -> Array:
    """R_TB0 (6, 3, 3) with the left forearm turned by `turn` about Z and the right one by the opposite."""
    bones = np.tile(np.eye(3), (len(PLACEMENTS), 1, 1))
    for name, angle in (("left_forearm", turn), ("right_forearm", -turn)):
        bones[PLACEMENTS.index(name)] = rot.about_axis("z", angle)
    return bones


POSES: Mapping[str, Array] = {"straight": _arms(-math.pi / 2), "t-pose": _arms(0.0)}
"""R_TB0 (6, 3, 3) of the poses to hold: `straight` is the N-pose, arms hanging, palms to the thighs."""


class MovedError(EdgeposeError):
    """A hold with movement in it: holding still once more helps."""


# --- holds --------------------------------------------------------------------------------------------------


class SensorHold(NamedTuple):
    """What one sensor said while it was held still.

    Attributes:
        time_s: (n,) seconds on the source's clock.
        quat: (n, 4) w, x, y, z, sensor to inertial; rows of NaN where not measured.
        acc: (n, 3) specific force in the sensor frame, m/s^2; rows of NaN where not measured.
        gyr: (n, 3) angular rate in the sensor frame, rad/s; rows of NaN where not measured.
    """

    time_s: Array
    quat: Array
    acc: Array
    gyr: Array


Hold = Sequence[SensorHold]
"""One `SensorHold` a placement, in the order of PLACEMENTS."""


class HoldSummary(NamedTuple):
    """A hold that passed its checks.

    Attributes:
        samples: (6,) number of samples.
        orientation: (6, 4) mean quaternions, sensor to inertial, without any heading offset.
        spread_deg: (6,) RMS angle about the mean, degrees.
        force: (6, 3) mean specific force in I, m/s^2; NaN where a sensor measures none.
        warnings: one line each, naming the sensor.
    """

    samples: list[int]
    orientation: Array
    spread_deg: Array
    force: Array
    warnings: list[str]


def hold_from_samples(samples: Iterable[ImuSample]) -> Hold:
    """Samples of all sensors, in order of arrival, sorted by placement; see `_oriented`."""
    missing = (math.nan,) * 4
    rows: list[list[ImuSample]] = [[] for _ in PLACEMENTS]
    for sample in samples:
        rows[sample.sensor].append(sample)
    return [
        _oriented(
            np.array([s.time_s for s in own], float),
            np.array([s.quat or missing for s in own], float).reshape(-1, 4),
            np.array([s.acc or missing[:3] for s in own], float).reshape(-1, 3),
            np.array([s.gyr or missing[:3] for s in own], float).reshape(-1, 3),
        )
        for own in rows
    ]


def hold_from_recording(recording: Recording) -> Hold:
    """All of a recording, sorted by placement; see `_oriented`."""

    def filled(rows: Array | None, n: int, width: int) -> Array:
        return np.full((n, width), np.nan) if rows is None else rows

    return [
        _oriented(d.time_s, filled(d.quat, n, 4), filled(d.acc, n, 3), filled(d.gyr, n, 3))
        for d in (recording.sensors[name] for name in PLACEMENTS)
        for n in (len(d.time_s),)
    ]


def _oriented(time_s: Array, quat: Array, acc: Array, gyr: Array) -> SensorHold:
    """Rows with an orientation; all if there is none, so that a raw sensor differs from a silent one."""
    measured = ~np.isnan(quat).all(axis=-1)
    rows = measured if measured.any() else slice(None)
    return SensorHold(time_s[rows], quat[rows], acc[rows], gyr[rows])


def cut(hold: Hold, start_s: float, end_s: float) -> Hold:
    """The part of a hold from `start_s` up to but without `end_s`, on the source's clock."""
    return [SensorHold(*(column[(s.time_s >= start_s) & (s.time_s < end_s)] for column in s)) for s in hold]


def stillest_start(hold: Hold, seconds: float) -> float:
    """Start (s, source's clock) of the window in which the sensor that moves most moves least.

    Sitting is as still as standing, and the pose comes first (DIP 4.2), so the earliest window is taken that
    is within half a degree of the best one.

    Raises:
        EdgeposeError: no window of that length has samples of all sensors.
    """
    _check_reported(hold)
    first, last = max(s.time_s.min() for s in hold), min(s.time_s.max() for s in hold)
    # Tenths of a second at which there is something; the clock may have leapt.
    starts = first + 0.1 * np.unique(np.floor((hold[ROOT].time_s - first) / 0.1))
    starts = starts[(starts >= first) & (starts + seconds <= last + 0.1)]
    spread = np.zeros(len(starts))
    for s in hold:
        order = np.argsort(s.time_s, kind="stable")
        time_s, quat = s.time_s[order], _unit_or_zero(s.quat[order])
        sums = np.concatenate([np.zeros((1, 4, 4)), np.cumsum(quat[:, :, None] * quat[:, None, :], axis=0)])
        i, j = np.searchsorted(time_s, starts), np.searchsorted(time_s, starts + seconds)
        count = j - i
        # The largest eigenvalue of the mean of q q^T is the mean of cos^2(angle / 2) about the mean rotation.
        largest = np.linalg.eigvalsh((sums[j] - sums[i]) / np.maximum(count, 1)[:, None, None])[:, -1]
        angle = 2.0 * np.arcsin(np.sqrt(np.clip(1.0 - largest, 0.0, 1.0)))
        enough = max(MIN_SAMPLES, count.max(initial=0) / 2)
        spread = np.maximum(spread, np.where(count < enough, np.inf, angle))
    if not np.isfinite(spread).any():
        raise EdgeposeError(
            f"no {seconds:g} s in which all six sensors reported: "
            f"they overlap for {max(last - first, 0.0):.1f} s from {first:.1f} s"
        )
    return float(starts[np.argmax(spread <= spread.min() + math.radians(0.5))])


def check_hold(hold: Hold, advice: str = "stand still and repeat") -> HoldSummary:
    """Means of a hold in which every sensor reported, was held still, and measured gravity along +Z of I.

    Args:
        hold: six sensors' samples.
        advice: what to do about movement, for the message.

    Raises:
        MovedError: sensors moved; names all of them and how much.
        EdgeposeError: any other fault of the hold; names the sensors and what to do.
    """
    _check_reported(hold)
    few = [f"{name} {len(s.quat)}" for name, s in _named(hold) if len(s.quat) < MIN_SAMPLES]
    if few:
        raise EdgeposeError(
            f"too few samples in the hold ({', '.join(few)}; at least {MIN_SAMPLES}): "
            "check the rate and the link, or hold longer"
        )
    broken = [
        f"{name} ({bad} of {len(s.quat)})" for name, s in _named(hold) if (bad := _not_rotations(s.quat))
    ]
    if broken:
        raise EdgeposeError(
            f"quaternions that are not rotations (not of length 1): {', '.join(broken)}; "
            "check the protocol and the sensor's settings"
        )
    quats = [_unit_or_zero(s.quat) for s in hold]
    shared = [
        (name, apart)
        for name, quat in zip(PLACEMENTS, quats, strict=True)
        if (apart := _two_sensors(quat)) is not None
    ]
    if shared:
        raise EdgeposeError(
            "two sensors report as one placement: "
            + ", ".join(f"{name} ({apart:.0f} deg apart)" for name, apart in shared)
            + "; give every sensor a placement of its own"
        )
    mean = np.stack([rot.mean_rotation(quat) for quat in quats])
    spread = np.array([_rms(_angles(quat, own)) for quat, own in zip(quats, mean, strict=True)])
    moved = [
        text
        for name, s, quat, rms in zip(PLACEMENTS, hold, quats, spread, strict=True)
        if (text := _movement(name, s, quat, rms))
    ]
    if moved:
        raise MovedError(f"moved during the hold: {', '.join(moved)}; {advice}")
    force, warnings = _gravity(hold, quats)
    return HoldSummary([len(s.quat) for s in hold], mean, np.degrees(spread), force, warnings)


def _named(hold: Hold) -> Iterable[tuple[str, SensorHold]]:
    return zip(PLACEMENTS, hold, strict=True)


def _check_reported(hold: Hold) -> None:
    silent = [name for name, s in _named(hold) if not len(s.quat)]
    if silent:
        raise EdgeposeError(f"nothing from {', '.join(silent)}: check power, link and placement of each")
    raw = [name for name, s in _named(hold) if np.isnan(s.quat).all()]
    if raw:
        raise EdgeposeError(f"no orientation from {', '.join(raw)}: set each to send quaternions")


def _unit_or_zero(quat: Array) -> Array:
    norm = np.linalg.norm(quat, axis=-1, keepdims=True)
    return np.divide(quat, norm, out=np.zeros_like(quat), where=np.isfinite(norm) & (norm > 0))


def _not_rotations(quat: Array) -> int:
    # Not (x < limit) rather than x >= limit: NaN has to count.
    return int(np.count_nonzero(~(np.abs(np.linalg.norm(quat, axis=-1) - 1.0) < 0.01)))


def _angles(quat: Array, reference: Array) -> Array:
    """Rotation angle (n,) between unit quaternions (n, 4) and one (4,), radians."""
    return np.linalg.norm(rot.quat_to_rotvec(rot.quat_multiply(rot.quat_conjugate(reference), quat)), axis=-1)


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


def _two_sensors(quat: Array) -> float | None:
    """Angle in degrees between two devices whose samples (n, 4) alternate under one name; None if one."""
    from_first = _angles(quat, quat[0])
    far = from_first > from_first.max() / 2
    # One wearer passes through the angles between, and does not change sides every few samples.
    if np.count_nonzero(far[1:] != far[:-1]) < max(4, len(quat) / 10):
        return None
    near, other = quat[~far], quat[far]
    centre, other_centre = rot.mean_rotation(near), rot.mean_rotation(other)
    spread = math.degrees(max(_rms(_angles(near, centre)), _rms(_angles(other, other_centre))))
    apart = math.degrees(_angles(other_centre[None], centre)[0])
    return apart if spread < SPREAD_LIMIT_DEG and apart > max(2.0 * SPREAD_LIMIT_DEG, 4.0 * spread) else None


def _movement(name: str, s: SensorHold, quat: Array, spread: float) -> str | None:
    """How one sensor moved, for a person; None if it held still."""
    quarter = max(1, len(quat) // 4)
    drift = _angles(rot.mean_rotation(quat[-quarter:])[None], rot.mean_rotation(quat[:quarter]))[0]
    if math.degrees(spread) > SPREAD_LIMIT_DEG or math.degrees(drift) > DRIFT_LIMIT_DEG:
        return f"{name} {math.degrees(max(spread, drift)):.1f} deg"
    gyr = s.gyr[np.isfinite(s.gyr).all(axis=-1)]
    rate = math.degrees(_rms(np.linalg.norm(gyr - gyr.mean(axis=0), axis=-1))) if len(gyr) else 0.0
    return f"{name} {rate:.0f} deg/s" if rate > RATE_LIMIT_DEG_S else None


def _gravity(hold: Hold, quats: list[Array]) -> tuple[Array, list[str]]:
    """Mean specific force of each sensor in I (6, 3), m/s^2, and warnings about its size; up or an error."""
    force, warnings, wrong = np.full((len(PLACEMENTS), 3), np.nan), [], []
    for i, (name, s, quat) in enumerate(zip(PLACEMENTS, hold, quats, strict=True)):
        measured = np.isfinite(s.acc).all(axis=-1)
        if not measured.any():
            warnings.append(f"{name} measures no acceleration: gravity was not checked")
            continue
        acc, quat = s.acc[measured], quat[measured]
        force[i] = rot.quat_rotate(quat, acc).mean(axis=0)
        size = float(np.linalg.norm(force[i]))
        at_rest = _rms(np.linalg.norm(acc, axis=-1))
        if at_rest < 0.5:
            wrong.append(
                f"{name} measures {at_rest:.2f} m/s^2 (gravity is removed already; send specific force)"
            )
        elif _tilt_deg(force[i]) > GRAVITY_TILT_LIMIT_DEG:
            wrong.append(f"{name} {_tilt_deg(force[i]):.0f} deg off ({_why_not_up(quat, acc)})")
        elif abs(size / GRAVITY - 1.0) > GRAVITY_SCALE_LIMIT:
            warnings.append(
                f"{name} measures {size:.2f} m/s^2 at rest, not {GRAVITY:.2f}: check its units and scale"
            )
    if wrong:
        raise EdgeposeError(
            f"at rest the acceleration in the inertial frame must point up along +Z: {', '.join(wrong)}; "
            "the frame or sign convention of the orientation or the acceleration is wrong"
        )
    return force, warnings


def _tilt_deg(v: Array) -> float:
    """Angle between a vector (3,) in I and the vertical, degrees."""
    return math.degrees(math.atan2(math.hypot(v[0], v[1]), v[2]))


def _why_not_up(quat: Array, acc: Array) -> str:
    """A guess at the convention that a device uses instead of ours, from one hold."""
    guesses: list[tuple[str, Array]] = [
        ("looks negated: acceleration instead of specific force, or Z down", -rot.quat_rotate(quat, acc)),
        (
            "looks like an inverse: the quaternion must turn sensor to inertial",
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
    return next(
        (why for why, f in guesses if _tilt_deg(f.mean(axis=0)) < GRAVITY_TILT_LIMIT_DEG),
        "no usual convention fits",
    )


# --- heading reset ------------------------------------------------------------------------------------------


class HeadingReset(NamedTuple):
    """Result of `heading_offsets`.

    Attributes:
        offset: (6,) turn about Z of each sensor's inertial frame to the pelvis sensor's, rad, -pi to pi.
        tilt_deg: (6,) what remains between each sensor and the pelvis sensor after that turn, degrees.
    """

    offset: Array
    tilt_deg: Array


def heading_offsets(still: Hold) -> HeadingReset:
    """Heading reset (DIP 4.5) from all six sensors lying side by side in one orientation.

    Raises:
        EdgeposeError: a sensor moved or does not lie as the pelvis sensor does; names it.
    """
    mean = check_hold(still, "leave the sensors alone and repeat the heading reset").orientation
    between = rot.quat_multiply(mean[ROOT], rot.quat_conjugate(mean))
    offset = np.arctan2(np.sin(yaw := rot.heading(between)), np.cos(yaw))
    tilt = np.degrees(
        2.0 * np.arctan2(np.hypot(between[:, 1], between[:, 2]), np.hypot(between[:, 0], between[:, 3]))
    )
    crooked = [f"{PLACEMENTS[i]} ({tilt[i]:.0f} deg)" for i in np.flatnonzero(tilt > RESET_TILT_LIMIT_DEG)]
    if crooked:
        raise EdgeposeError(
            f"not lying as the {PLACEMENTS[ROOT]} sensor does: {', '.join(crooked)}; "
            "lay all six side by side, same face up, same edge forward, and repeat the heading reset"
        )
    return HeadingReset(offset, tilt)


# --- body frame ---------------------------------------------------------------------------------------------


def check_body_frame(text: str) -> str:
    """`text` if it is `head`, `SENSOR:AXIS` or `heading:DEG`.

    Raises:
        EdgeposeError: it is none of them.
    """
    name, _, value = text.partition(":")
    axis_given = (
        name in PLACEMENTS and len(value.lstrip("+-")) == 1 and value[-1] in "xyz" and len(value) <= 2
    )
    if text != "head" and not axis_given and (name != "heading" or _finite(value) is None):
        raise EdgeposeError(
            f"body frame {text!r} is none of: head, heading:DEG, SENSOR:AXIS "
            f"(such as pelvis:-z; sensors: {', '.join(PLACEMENTS)})"
        )
    return text


def _finite(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def body_from_inertial(orientation: Array, body_frame: str) -> Array:
    """R_TI (3, 3) of a wearer who holds the calibration pose.

    Args:
        orientation: (6, 4) mean quaternions of the hold, sensor to inertial, headings reset.
        body_frame: `head`: the head sensor's axes lie along T (DIP eq. 6). `SENSOR:AXIS`: the horizontal
            direction of that axis of that sensor is forward, gravity gives up. `heading:DEG`: the wearer
            faces this angle from X of I towards Y.

    Raises:
        EdgeposeError: the named sensor is not worn so that this way works.
    """
    name, _, value = check_body_frame(body_frame).partition(":")
    if name == "head":
        return _frame_of_head(rot.quat_to_matrix(orientation[PLACEMENTS.index("head")]))
    if name == "heading":
        angle = math.radians(float(value))
        return _frame_facing(np.array([math.cos(angle), math.sin(angle), 0.0]))
    axis = rot.quat_to_matrix(orientation[PLACEMENTS.index(name)])[:, "xyz".index(value[-1])]
    forward = -axis if value[0] == "-" else axis
    from_vertical = min(_tilt_deg(forward), 180.0 - _tilt_deg(forward))
    if from_vertical < FRAME_TILT_LIMIT_DEG:
        raise EdgeposeError(
            f"body frame {body_frame}: this axis is {from_vertical:.0f} deg from vertical; "
            "name an axis that points to the wearer's front, or with - to the back"
        )
    return _frame_facing(forward)


def _frame_of_head(r_is: Array) -> Array:
    tilt = _tilt_deg(r_is[:, 1])
    if tilt > FRAME_TILT_LIMIT_DEG:
        raise EdgeposeError(
            f"body frame head: the head sensor's Y axis points {tilt:.0f} deg from up; "
            "wear it with X to the left, Y up, Z forward, or choose another --body-frame"
        )
    return r_is.T


def _frame_facing(forward: Array) -> Array:
    """R_TI (3, 3) of a wearer who faces the horizontal part of a direction in I."""
    ahead = np.array([forward[0], forward[1], 0.0]) / math.hypot(forward[0], forward[1])
    return np.stack([np.cross(_UP, ahead), _UP, ahead])  # left, up, forward in I


# --- the calibration ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Calibration:
    """Everything between an oriented frame and bones in the body frame.

    Attributes:
        body_from_inertial: (4,) quaternion of R_TI.
        heading_offset: (6,) turn about Z of each sensor's inertial frame to the reference's, rad.
        bone_from_sensor: (6, 4) quaternions of R_BS, how each sensor is mounted on its bone.
        residual_deg: (6,) RMS angle of each sensor about its mean over the hold, degrees.
        pose: key of POSES that was held.
        body_frame: how R_TI was found: `head`, `SENSOR:AXIS` or `heading:DEG`.
        created: ISO 8601 time.
        metadata: what else is worth knowing (source, window, ...), JSON values.
    """

    body_from_inertial: Array
    heading_offset: Array
    bone_from_sensor: Array
    residual_deg: Array
    pose: str
    body_frame: str
    created: str
    metadata: Mapping[str, Any]

    @cached_property
    def _maps(self) -> tuple[Array, Array, Array]:
        """Products q q^T to R_TB (6, 16, 9), force as a row from I to T (6, 3, 3), gravity in T (3,)."""
        r_ti = rot.quat_to_matrix(self.body_from_inertial)
        left = r_ti @ rot.quat_to_matrix(rot.about_z(self.heading_offset))
        right = rot.transpose(rot.quat_to_matrix(self.bone_from_sensor))
        bones = np.einsum("sab,ijbc,scd->sijad", left, _quadratic_form(), right)
        return bones.reshape(-1, 16, 9), rot.transpose(left), r_ti @ (-GRAVITY * _UP)


def _quadratic_form() -> Array:
    """(4, 4, 3, 3) symmetric coefficients K with R(q) = sum of q_i q_j K_ij for unit q."""
    unit = np.eye(4)
    squares = rot.quat_to_matrix(unit)
    form = rot.quat_to_matrix((unit[:, None] + unit) / math.sqrt(2.0)) - (squares[:, None] + squares) / 2.0
    form[range(4), range(4)] = squares  # the line above is right only for pairs of different axes
    return form


def calibrate(
    summary: HoldSummary,
    *,
    pose: str,
    body_frame: str,
    created: str,
    heading_offset: ArrayLike | None = None,
    metadata: Mapping[str, Any] | None = None,
) -> Calibration:
    """Calibration (DIP 4.2, eq. 6 and 7) from a checked hold of a known pose.

    Args:
        summary: what `check_hold` returned.
        pose: key of POSES that the wearer held.
        body_frame: see `body_from_inertial`.
        created: ISO 8601 time to note.
        heading_offset: (6,) of `heading_offsets`, rad; None where all sensors share a north.
        metadata: JSON values to note.
    """
    if pose not in POSES:
        raise EdgeposeError(f"pose {pose!r} is none of: {', '.join(POSES)}")
    offset = np.zeros(len(PLACEMENTS)) if heading_offset is None else np.asarray(heading_offset, float)
    orientation = rot.quat_multiply(rot.about_z(offset), summary.orientation)
    r_ti = body_from_inertial(orientation, body_frame)
    r_bs = rot.transpose(POSES[pose]) @ (r_ti @ rot.quat_to_matrix(orientation))
    return Calibration(
        rot.matrix_to_quat(r_ti),
        offset,
        rot.matrix_to_quat(r_bs),
        summary.spread_deg,
        pose,
        body_frame,
        created,
        dict(metadata or {}),
    )


def apply(calibration: Calibration, orientation: ArrayLike, force: ArrayLike) -> tuple[Array, Array]:
    """Bones and accelerations in the body frame (DIP 4.2, SIP eq. 13); leading dimensions are free.

    R_TB = R_TI R_IS inv(R_BS). DIP prints eq. 8 as R_BS R_TS, which would not give R_TB0 back at the
    calibration instant. a_T = R_TI (f_I + g_I), zero at rest.

    Args:
        calibration: of this rig.
        orientation: (..., 6, 4) unit quaternions, sensor to inertial, as measured: headings are reset here.
        force: (..., 6, 3) specific force turned to the inertial frame by the same quaternions, m/s^2.

    Returns:
        (..., 6, 3, 3) R_TB and (..., 6, 3) a_T, m/s^2.
    """
    bones, to_body, gravity = calibration._maps
    q, f = np.asarray(orientation, float), np.asarray(force, float)
    # A rotation matrix is quadratic in its quaternion, so all constant turns fold into one product, which
    # takes a fifth of the time of a conversion followed by two products.
    squares = (q[..., :, None] * q[..., None, :]).reshape(*q.shape[:-1], 1, 16)
    r_tb = (squares @ bones).reshape(*q.shape[:-1], 3, 3)
    return r_tb, (f[..., None, :] @ to_body)[..., 0, :] + gravity


def mounting(calibration: Calibration) -> list[str]:
    """How each sensor sat in the held pose, for a person: the body directions nearest to its X and Z axes."""
    words = (("left", "right"), ("up", "down"), ("forward", "back"))
    r_ts = POSES[calibration.pose] @ rot.quat_to_matrix(calibration.bone_from_sensor)

    def nearest(direction: Array) -> str:
        i = int(np.argmax(np.abs(direction)))
        return words[i][int(direction[i] < 0)]

    return [f"x {nearest(r[:, 0])}, z {nearest(r[:, 2])}" for r in r_ts]


# --- on disk ------------------------------------------------------------------------------------------------


def to_json(calibration: Calibration) -> str:
    """The calibration as JSON for `from_json` and for people: sensors by name, degrees, w, x, y, z."""
    sensors = {
        name: {
            "heading_offset_deg": math.degrees(calibration.heading_offset[i]),
            "bone_from_sensor": calibration.bone_from_sensor[i].tolist(),
            "residual_deg": float(calibration.residual_deg[i]),
            "mounting": mounted,
        }
        for i, (name, mounted) in enumerate(zip(PLACEMENTS, mounting(calibration), strict=True))
    }
    document = {
        "format": _FORMAT,
        "version": _VERSION,
        "created": calibration.created,
        "pose": calibration.pose,
        "body_frame": calibration.body_frame,
        "body_from_inertial": calibration.body_from_inertial.tolist(),
        "sensors": sensors,
        "metadata": dict(calibration.metadata),
    }
    text = json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    # Quaternions on one line each; a line break inside of a text is escaped and so never matches.
    return re.sub(r"\[\n[-+.\de,\s]+\]", lambda numbers: " ".join(numbers[0].split()), text)


def from_json(text: str, where: str = "calibration") -> Calibration:
    """The calibration of a JSON text, every value checked; `where` names the text in messages.

    Raises:
        EdgeposeError: not a calibration of this version, or a sensor or value is missing or impossible.
    """

    def fail(what: str) -> EdgeposeError:
        return EdgeposeError(f"{where}: {what}")

    try:
        document = json.loads(text, object_pairs_hook=_no_duplicates, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise fail(
            f"not valid JSON ({str(error).splitlines()[0]}); make it anew with `edgepose calibrate`"
        ) from None
    if not isinstance(document, dict) or document.get("format") != _FORMAT:
        raise fail("not an edgepose calibration; make one with `edgepose calibrate`")
    if document.get("version") != _VERSION or isinstance(document.get("version"), bool):
        raise fail(
            f"format version {document.get('version')!r}; this program reads {_VERSION}, calibrate anew"
        )
    sensors = _member(document, "sensors", dict, fail)
    if missing := [name for name in PLACEMENTS if name not in sensors]:
        raise fail(f"no sensor {', '.join(missing)}; calibrate anew with all six")
    if unknown := [name for name in sensors if name not in PLACEMENTS]:
        raise fail(f"unknown sensor {', '.join(map(repr, unknown))}; the sensors are {', '.join(PLACEMENTS)}")
    if bare := [name for name in PLACEMENTS if not isinstance(sensors[name], dict)]:
        raise fail(f"sensor {', '.join(bare)} is not an object")
    pose = _member(document, "pose", str, fail)
    if pose not in POSES:
        raise fail(f"pose {pose!r} is none of: {', '.join(POSES)}")
    try:
        body_frame = check_body_frame(_member(document, "body_frame", str, fail))
    except EdgeposeError as error:
        raise fail(str(error).removeprefix(f"{where}: ")) from None
    own = {name: _numbers_of(name, sensors[name], fail) for name in PLACEMENTS}
    return Calibration(
        body_from_inertial=_unit_quaternion(document, "body_from_inertial", "", fail),
        heading_offset=np.radians([own[name][0] for name in PLACEMENTS]),
        bone_from_sensor=np.stack([own[name][1] for name in PLACEMENTS]),
        residual_deg=np.array([own[name][2] for name in PLACEMENTS]),
        pose=pose,
        body_frame=body_frame,
        created=_member(document, "created", str, fail),
        metadata=_member(document, "metadata", dict, fail),
    )


def save(calibration: Calibration, path: str | Path) -> None:
    """Writes the calibration as JSON."""
    try:
        Path(path).write_text(to_json(calibration), encoding="utf-8")
    except OSError as error:
        raise EdgeposeError(f"{path}: cannot write the calibration ({error.strerror or error})") from error


def load_calibration(path: str | Path) -> Calibration:
    """The calibration in a JSON file; see `from_json` for errors, which name the file."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise EdgeposeError(f"{path}: cannot read the calibration ({error.strerror or error})") from error
    except UnicodeDecodeError as error:
        raise EdgeposeError(
            f"{path}: not valid JSON (not UTF-8 text); make it anew with `edgepose calibrate`"
        ) from error
    return from_json(text, str(path))


_Fail = Callable[[str], EdgeposeError]


def _no_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"{next(n for n in names if names.count(n) > 1)!r} appears twice")
    return result


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is not a number")


def _member(owner: dict[str, Any], key: str, kind: type, fail: _Fail) -> Any:
    if not isinstance(owner.get(key), kind):
        raise fail(f"{key!r} is missing or not {'text' if kind is str else 'an object'}")
    return owner[key]


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    # An integer with hundreds of digits and 1e999 are valid JSON.
    return float(value) if abs(value) < 1e9 else None


def _unit_quaternion(owner: dict[str, Any], key: str, of: str, fail: _Fail) -> Array:
    values = owner.get(key)
    numbers = [_number(v) for v in values] if isinstance(values, list) else []
    quat = np.array([math.nan if n is None else n for n in numbers])
    if len(quat) != 4 or not abs(np.linalg.norm(quat) - 1.0) < 1e-3:
        raise fail(f"{of}{key!r} is not a unit quaternion w, x, y, z")
    return quat / np.linalg.norm(quat)


def _numbers_of(name: str, sensor: dict[str, Any], fail: _Fail) -> tuple[float, Array, float]:
    """Heading offset (deg), R_BS (4,) and residual (deg) of one sensor's entry."""
    offset, residual = _number(sensor.get("heading_offset_deg")), _number(sensor.get("residual_deg"))
    if offset is None:
        raise fail(f"sensor {name}: 'heading_offset_deg' is not a number")
    if residual is None or residual < 0:
        raise fail(f"sensor {name}: 'residual_deg' is not a number from 0 up")
    return offset, _unit_quaternion(sensor, "bone_from_sensor", f"sensor {name}: ", fail), residual
