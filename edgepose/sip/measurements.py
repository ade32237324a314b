"""Bones and accelerations in the body frame at a fixed rate, from a recording of any 3 to 17 sensors.

Unlike in a live run, where the future is unknown, acceleration is averaged symmetrically about each frame: it
is what the second difference of a sensor's positions at frames (SIP eq. 14) measures, without delay.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.calibration import GRAVITY, Calibration
from edgepose.calibration.checks import GAP_LIMIT_S
from edgepose.calibration.sensor_to_segment import held_bone
from edgepose.errors import EdgeposeError
from edgepose.imu import GAP_S, HOLD_PERIODS, Recording, SensorData
from edgepose.placements import SITES

Array = NDArray[np.float64]

FEWEST, MOST = 3, len(SITES)
"""Smallest and largest number of sensors."""

_LEAST_HOLD = 10  # samples


class Measurements(NamedTuple):
    """Measurements of N sensors at T frames.

    Attributes:
        names: of the sensors.
        time_s: (T,) on the recording's clock, seconds.
        rate: frames a second.
        orientation: (T, N, 3, 3) R_TB, interpolated between samples along the shorter arc.
        acceleration: (T, N, 3) in T without gravity, m/s^2.
        valid: (T, N) bool: the acceleration was measured, not interpolated over a gap.
        held: (T, N) bool: no sample is near; the orientation is interpolated over a gap.
    """

    names: tuple[str, ...]
    time_s: Array
    rate: float
    orientation: Array
    acceleration: Array
    valid: NDArray[np.bool_]
    held: NDArray[np.bool_]

    @property
    def bones(self) -> NDArray[np.int_]:
        """SMPL joints (N,) of the sensors' bones."""
        return np.array([SITES[name] for name in self.names])


class SensorMount(NamedTuple):
    """Mapping from one sensor's readings to a bone: R_TB = body_from_inertial R_IS inverse(bone_from_sensor).

    Attributes:
        body_from_inertial: (3, 3) R_TI of this sensor's inertial frame, its heading reset.
        bone_from_sensor: (3, 3) R_BS.
    """

    body_from_inertial: Array
    bone_from_sensor: Array


def mounts(calibration: Calibration) -> dict[str, SensorMount]:
    """Return the mounts of the sensors that a calibration knows, by name."""
    r_ti = rot.quat_to_matrix(calibration.body_from_inertial)
    return {
        name: SensorMount(
            r_ti @ rot.quat_to_matrix(rot.quat_about_z(sensor.heading_offset)),
            rot.quat_to_matrix(sensor.bone_from_sensor),
        )
        for name, sensor in calibration.sensors.items()
    }


def mounts_from_hold(
    recording: Recording, calibration: Calibration, names: Sequence[str], start_s: float, end_s: float
) -> dict[str, SensorMount]:
    """Find the mounts of further sensors, which share the others' north, from another hold of the pose.

    Args:
        recording: in which the wearer holds the calibration's pose.
        calibration: defines the pose and R_TI.
        names: of sensors that the calibration does not know.
        start_s: of the hold on the recording's clock, seconds.
        end_s: of the hold, seconds.

    Raises:
        EdgeposeError: a sensor has too few orientations in that time.
    """
    r_ti = rot.quat_to_matrix(calibration.body_from_inertial)
    found = {}
    for name in names:
        data = recording.sensors[name]
        times, quats = _oriented(name, data)
        held = (times >= start_s) & (times < end_s)
        inside = quats[held]
        longest_gap_s = np.diff(np.concatenate([[start_s], np.sort(times[held]), [end_s]])).max()
        if len(inside) < _LEAST_HOLD or longest_gap_s > GAP_LIMIT_S:
            raise EdgeposeError(
                f"{name}: {len(inside)} orientations from {start_s:g} to {end_s:g} s, at most "
                f"{longest_gap_s:.1f} s apart; say with --hold-from when the wearer holds the calibration's "
                "pose"
            )
        r_is = rot.quat_to_matrix(rot.mean_rotation(inside))
        found[name] = SensorMount(r_ti, rot.transpose(held_bone(calibration.pose, name)) @ r_ti @ r_is)
    return found


def measure(recording: Recording, mounted: dict[str, SensorMount], rate: float) -> Measurements:
    """Compute the frames of the mounted sensors, from the time all have started to the end of the last one.

    Args:
        recording: has samples of all these sensors.
        mounted: mounts by name.
        rate: frames a second.

    Raises:
        EdgeposeError: too few sensors, a sensor without orientation, sensors that never ran at the same
            time, or a pause of all sensors.
    """
    names = tuple(name for name in SITES if name in mounted)
    if len(names) < FEWEST:
        raise EdgeposeError(
            f"{len(names)} sensors ({', '.join(names) or 'none'}) are too few for a pose: give {FEWEST} to "
            f"{MOST} of {', '.join(SITES)}"
        )
    tracks = [_track(name, recording.sensors[name], mounted[name]) for name in names]
    start_s = max(track.times[0] for track in tracks)
    end_s = max(track.times[-1] for track in tracks)
    late = [name for name, track in zip(names, tracks, strict=True) if track.times[-1] < start_s]
    if late:
        raise EdgeposeError(
            f"{', '.join(late)}: no sample after all sensors had started, at {start_s:.2f} s; cut the "
            "recording or leave the sensor out"
        )
    _check_pause(np.concatenate([track.times for track in tracks]), start_s)
    ticks = start_s + np.arange(int((end_s - start_s) * rate + 1e-6) + 1) / rate
    columns = [_frames(track, ticks, rate) for track in tracks]
    orientation, acceleration, valid, held = (np.stack(c, axis=1) for c in zip(*columns, strict=True))
    return Measurements(names, ticks, rate, orientation, acceleration, valid, held)


def _check_pause(times: Array, start_s: float) -> None:
    times = np.unique(times[times >= start_s])
    pauses = np.diff(times)
    if len(pauses) and pauses.max() > GAP_S:
        before = int(pauses.argmax())
        raise EdgeposeError(
            f"all sensors are silent from {times[before]:.2f} to {times[before + 1]:.2f} s; cut the "
            "recording there and solve its parts"
        )


class _Track(NamedTuple):
    """One sensor in the body frame: orientations R_TB (n, 4) at times (n,), accelerations (m, 3) at (m,)."""

    times: Array
    quats: Array
    acc_times: Array
    acc: Array


def _oriented(name: str, data: SensorData) -> tuple[Array, Array]:
    """Return times (n,), increasing, and quaternions (n, 4) of a sensor's oriented samples."""
    if data.quat is None:
        raise EdgeposeError(
            f"{name}: the recording has no orientations; set the device to send quaternions, or leave the "
            "sensor out"
        )
    return _distinct(data.time_s, data.quat)


def _distinct(times: Array, values: Array) -> tuple[Array, Array]:
    """Return the measured rows, the first one where several have the same time."""
    rows = np.flatnonzero(~np.isnan(values).any(axis=1))
    unique, first = np.unique(times[rows], return_index=True)
    return unique, values[rows[first]]


def _track(name: str, data: SensorData, mount: SensorMount) -> _Track:
    times, quats = _oriented(name, data)
    acc_times, acc = _distinct(data.time_s, np.empty((0, 3)) if data.acc is None else data.acc)
    inertial = rot.quat_rotate(orientation_at(times, quats, acc_times), acc) - [0.0, 0.0, GRAVITY]
    r_tb = mount.body_from_inertial @ rot.quat_to_matrix(quats) @ rot.transpose(mount.bone_from_sensor)
    return _Track(times, rot.matrix_to_quat(r_tb), acc_times, inertial @ mount.body_from_inertial.T)


def orientation_at(times: Array, quats: Array, wanted: Array) -> Array:
    """Interpolate quaternions (T, 4) along the shorter arc; beyond the samples take the nearest."""
    if len(times) == 1:
        return np.repeat(quats, len(wanted), axis=0)
    before = np.clip(np.searchsorted(times, wanted, side="right") - 1, 0, len(times) - 2)
    share = (wanted - times[before]) / (times[before + 1] - times[before])
    return rot.slerp(quats[before], quats[before + 1], np.clip(share, 0.0, 1.0))


def _frames(
    track: _Track, ticks: Array, rate: float
) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return R_TB (T, 3, 3), accelerations (T, 3), their validity (T,), and whether R_TB is held (T,)."""
    r_tb = rot.quat_to_matrix(orientation_at(track.times, track.quats, ticks))
    held = _silence(track.times, ticks, rate) > 0.0
    edges = (ticks[0] - 1.0 / rate, *ticks, ticks[-1] + 1.0 / rate)
    silence = np.diff(_silence_before(track.acc_times, np.array(edges), rate))
    valid = silence[1:] + silence[:-1] < 1e-9
    return r_tb, _mean_acceleration(track.acc_times, track.acc, ticks, rate), valid, held


def _longest_interval(times: Array, rate: float) -> float:
    """Return the interval between samples above which some are missing, s."""
    usual = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    return max(HOLD_PERIODS * usual, 1.0 / rate) + 1e-6


def _silence(times: Array, wanted: Array, rate: float) -> Array:
    """Return the length (T,) of the gap in which each wanted time lies, 0 where there is none, s."""
    index = np.searchsorted(times, wanted, side="right")
    ends = np.concatenate([[-np.inf], times, [np.inf]])
    length = ends[index + 1] - ends[index]
    on_sample = np.isin(wanted, times)
    return np.where((length > _longest_interval(times, rate)) & ~on_sample, length, 0.0)


def _silence_before(times: Array, wanted: Array, rate: float) -> Array:
    """Return the seconds (T,) in gaps between samples, and outside the samples, up to each wanted time."""
    if len(times) < 2:
        return wanted - wanted[0]
    intervals = np.diff(times)
    missing = np.where(intervals > _longest_interval(times, rate), intervals, 0.0)
    inside = np.interp(wanted, times, np.concatenate([[0.0], np.cumsum(missing)]))
    return inside + np.minimum(wanted - times[0], 0.0) + np.maximum(wanted - times[-1], 0.0)


def _mean_acceleration(times: Array, acc: Array, ticks: Array, rate: float) -> Array:
    """Return the mean acceleration (T, 3) over two frames about each tick, weighted with a triangle.

    It is the second difference over frames of the path of accelerations that are linear between samples.
    """
    if len(times) < 2:
        return np.zeros((len(ticks), 3))
    common = acc.mean(axis=0)  # subtracted to keep the path short and its digits significant
    acc = acc - common
    steps = np.diff(times)[:, None]
    slopes = np.diff(acc, axis=0) / steps
    gained = 0.5 * (acc[1:] + acc[:-1]) * steps
    speed = np.concatenate([np.zeros((1, 3)), np.cumsum(gained, axis=0)])
    moved = (speed[:-1] + (acc[:-1] / 2.0 + slopes * steps / 6.0) * steps) * steps
    path = np.concatenate([np.zeros((1, 3)), np.cumsum(moved, axis=0)])

    def at(wanted: Array) -> Array:
        i = np.clip(np.searchsorted(times, wanted, side="right") - 1, 0, len(times) - 2)
        s = (wanted - times[i])[:, None]
        return path[i] + (speed[i] + (acc[i] / 2.0 + slopes[i] * s / 6.0) * s) * s

    dt = 1.0 / rate
    return common + (at(ticks + dt) - 2.0 * at(ticks) + at(ticks - dt)) * rate**2
