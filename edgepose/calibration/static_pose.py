"""What sensors said while they were held still: collecting it, cutting it, finding it in a recording."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from edgepose.errors import CalibrationError
from edgepose.imu import ImuSample, Recording
from edgepose.placements import PLACEMENTS, ROOT
from edgepose.rotations import Array

MIN_SAMPLES = 10


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


def trim(hold: Hold, start_s: float, end_s: float) -> Hold:
    """The part of a hold from `start_s` up to but without `end_s`, on the source's clock."""
    return [SensorHold(*(column[(s.time_s >= start_s) & (s.time_s < end_s)] for column in s)) for s in hold]


def stillest_start(hold: Hold, seconds: float) -> float:
    """Start (s, source's clock) of the window in which the sensor that moves most moves least.

    Sitting is as still as standing, and the pose comes first (DIP 4.2), so the earliest window is taken that
    is within half a degree of the best one.

    Raises:
        CalibrationError: no window of that length has samples of all sensors.
    """
    check_reported(hold)
    first, last = max(s.time_s.min() for s in hold), min(s.time_s.max() for s in hold)
    # Tenths of a second at which there is something; the clock may have leapt.
    starts = first + 0.1 * np.unique(np.floor((hold[ROOT].time_s - first) / 0.1))
    starts = starts[(starts >= first) & (starts + seconds <= last + 0.1)]
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
        enough = max(MIN_SAMPLES, count.max(initial=0) / 2)
        spread = np.maximum(spread, np.where(count < enough, np.inf, angle))
    if not np.isfinite(spread).any():
        raise CalibrationError(
            f"no {seconds:g} s in which all six sensors reported: "
            f"they overlap for {max(last - first, 0.0):.1f} s from {first:.1f} s"
        )
    return float(starts[np.argmax(spread <= spread.min() + math.radians(0.5))])


def sensor_names(hold: Hold) -> Iterable[tuple[str, SensorHold]]:
    """The sensors with their placements."""
    return zip(PLACEMENTS, hold, strict=True)


def check_reported(hold: Hold) -> None:
    """Raises EdgeposeError unless every sensor sent orientations."""
    silent = [name for name, s in sensor_names(hold) if not len(s.quat)]
    if silent:
        raise CalibrationError(f"nothing from {', '.join(silent)}: check power, link and placement of each")
    raw = [name for name, s in sensor_names(hold) if np.isnan(s.quat).all()]
    if raw:
        raise CalibrationError(
            f"no orientation from {', '.join(raw)}: set each to send quaternions, "
            "or make it here of gyroscope and accelerometer: --filter kalman"
        )


def unit_or_zero(quat: Array) -> Array:
    """Quaternions (n, 4) brought to length 1; zero where that cannot be."""
    norm = np.linalg.norm(quat, axis=-1, keepdims=True)
    return np.divide(quat, norm, out=np.zeros_like(quat), where=np.isfinite(norm) & (norm > 0))
