"""Samples of a held pose: collecting them, cutting them, finding them in a recording."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from edgepose.errors import CalibrationError
from edgepose.imu import ImuSample, Recording
from edgepose.placements import PLACEMENTS, ROOT, SENSORS
from edgepose.rotations import Array

MIN_SAMPLES = 10

TENTH_S = 0.1
"""Step of the search for a pose, seconds."""


class SensorHold(NamedTuple):
    """Samples of one sensor while it was held still.

    Attributes:
        time_s: (n,) seconds on the source's clock.
        quat: (n, 4) w, x, y, z, sensor to inertial; rows of NaN where not measured.
        acc: (n, 3) specific force in the sensor frame, m/s^2; rows of NaN where not measured.
        gyr: (n, 3) angular rate in the sensor frame, rad/s; rows of NaN where not measured.
        name: one of SENSORS.
    """

    time_s: Array
    quat: Array
    acc: Array
    gyr: Array
    name: str


Hold = Sequence[SensorHold]
"""One `SensorHold` for each sensor of a rig, in the order of SENSORS."""


def hold_from_samples(samples: Iterable[ImuSample], names: Sequence[str] = PLACEMENTS) -> Hold:
    """Sort samples, in order of arrival, by sensor, for those with these names; see `_oriented`."""
    missing = (math.nan,) * 4
    rows: list[list[ImuSample]] = [[] for _ in SENSORS]
    for sample in samples:
        rows[sample.sensor].append(sample)
    return [
        _oriented(
            name,
            np.array([s.time_s for s in of_sensor], float),
            np.array([s.quat or missing for s in of_sensor], float).reshape(-1, 4),
            np.array([s.acc or missing[:3] for s in of_sensor], float).reshape(-1, 3),
            np.array([s.gyr or missing[:3] for s in of_sensor], float).reshape(-1, 3),
        )
        for name in names
        for of_sensor in (rows[SENSORS.index(name)],)
    ]


def hold_from_recording(recording: Recording, names: Sequence[str] = PLACEMENTS) -> Hold:
    """Return the samples of sensors of a recording; see `_oriented`."""

    def filled(rows: Array | None, n: int, width: int) -> Array:
        return np.full((n, width), np.nan) if rows is None else rows

    return [
        _oriented(name, d.time_s, filled(d.quat, n, 4), filled(d.acc, n, 3), filled(d.gyr, n, 3))
        for name in names
        for d in (recording.sensors[name],)
        for n in (len(d.time_s),)
    ]


def _oriented(name: str, time_s: Array, quat: Array, acc: Array, gyr: Array) -> SensorHold:
    """Keep the rows with an orientation; all if there is none, to tell a raw sensor from a silent one."""
    measured = ~np.isnan(quat).all(axis=-1)
    rows = measured if measured.any() else slice(None)
    return SensorHold(time_s[rows], quat[rows], acc[rows], gyr[rows], name)


def trim(hold: Hold, start_s: float, end_s: float) -> Hold:
    """Return the part of a hold from `start_s` up to but without `end_s`, on the source's clock."""
    return [
        SensorHold(s.time_s[rows], s.quat[rows], s.acc[rows], s.gyr[rows], s.name)
        for s in hold
        for rows in ((s.time_s >= start_s) & (s.time_s < end_s),)
    ]


def stillest_start(hold: Hold, seconds: float) -> float:
    """Return the start (s, source's clock) of the window in which the sensor that moves most moves least.

    Sitting is as still as standing, and the pose comes first (DIP 4.2), so this is the earliest window within
    half a degree of the best one.

    Raises:
        CalibrationError: no window of that length has samples of all sensors.
    """
    check_reported(hold)
    first, last = max(s.time_s.min() for s in hold), min(s.time_s.max() for s in hold)
    starts = tenths_with_samples(hold, first, last)
    starts = starts[starts + seconds <= last + 0.1]
    spread = np.zeros(len(starts))
    for s in hold:
        order = np.argsort(s.time_s, kind="stable")
        time_s, quat = s.time_s[order], unit_or_zero(s.quat[order])
        sums = np.concatenate([np.zeros((1, 4, 4)), np.cumsum(quat[:, :, None] * quat[:, None, :], axis=0)])
        i, j = np.searchsorted(time_s, starts), np.searchsorted(time_s, starts + seconds)
        count = j - i
        # The largest eigenvalue of the mean of q q^T is the mean of cos^2(angle / 2) about the mean rotation.
        largest = np.linalg.eigvalsh((sums[j] - sums[i]) / np.maximum(count, 1)[:, None, None])[:, -1]
        angle = 2.0 * np.arcsin(np.sqrt(np.clip(1.0 - largest, 0.0, 1.0)))
        enough = max(MIN_SAMPLES, 0.8 * count.max(initial=0))
        spread = np.maximum(spread, np.where(count < enough, np.inf, angle))
    if not np.isfinite(spread).any():
        raise CalibrationError(
            f"no {seconds:g} s in which {all_of(sensor_names(hold))} sensors reported: "
            f"they overlap for {max(last - first, 0.0):.1f} s from {first:.1f} s"
        )
    return float(starts[np.argmax(spread <= spread.min() + math.radians(0.5))])


def tenths_with_samples(hold: Hold, first_s: float, last_s: float) -> Array:
    """Return the times (n,) from first to last, a tenth of a second apart, in which the pelvis has samples.

    Others are left out, because the clock may have jumped by years. All are on the source's clock, seconds.
    """
    time_s = hold[root_of(sensor_names(hold))].time_s
    times: Array = first_s + TENTH_S * np.unique(np.floor((time_s - first_s) / TENTH_S))
    return times[(times >= first_s) & (times <= last_s)]


def sensor_names(hold: Hold) -> list[str]:
    """Return the names of the sensors of a hold."""
    return [s.name for s in hold]


def root_of(names: Sequence[str]) -> int:
    """Return the index of the pelvis among the sensors of a rig."""
    return list(names).index(PLACEMENTS[ROOT])


def all_of(names: Sequence[str]) -> str:
    """Return "all six" or "all N" for the sensors of a rig, for a message."""
    return "all six" if len(names) == len(PLACEMENTS) else f"all {len(names)}"


def check_reported(hold: Hold) -> None:
    """Raise CalibrationError unless every sensor sent orientations."""
    silent = [s.name for s in hold if not len(s.quat)]
    if silent:
        raise CalibrationError(f"nothing from {', '.join(silent)}: check power, link and placement of each")
    raw = [s.name for s in hold if np.isnan(s.quat).all()]
    if raw:
        raise CalibrationError(
            f"no orientation from {', '.join(raw)}: set each to send quaternions, "
            "or compute them here from gyroscope and accelerometer with --filter kalman"
        )


def unit_or_zero(quat: Array) -> Array:
    """Normalise quaternions (n, 4); zero where that is impossible."""
    norm = np.linalg.norm(quat, axis=-1, keepdims=True)
    return np.divide(quat, norm, out=np.zeros_like(quat), where=np.isfinite(norm) & (norm > 0))
