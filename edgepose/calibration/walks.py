"""Displacements of sensors during a walk, from their accelerations integrated twice between two stands."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from edgepose import rotations as rot
from edgepose.calibration.heading_reset import WeakMotionError
from edgepose.calibration.static_pose import Hold, SensorHold
from edgepose.errors import CalibrationError
from edgepose.placements import PLACEMENTS
from edgepose.rotations import Array

LONGEST_S, LONGEST_OPEN_S = 10.0, 4.5
"""Longest walk from stand to stand, and longest used part of one without a stop; errors grow with time."""

SHORTEST_M = 0.4
"""Shortest distance that counts, metres."""

ADVICE = "let the arms hang, take two or three calm steps straight ahead, and stand still as before"

STAND_S = 0.8
"""Shortest stand, seconds."""

_EDGE_S = 0.3  # part of a stand that counts as walking, because movement starts slowly
_TURN_S, _STILL_DEG = 0.3, 3.0  # a sensor is still if it turns by less in this time
_HEAD_STILL_DEG = 9.0  # wearers look around
_GRID_S = 0.05
_GAP_S = 0.15  # longest time without a sample
_STRIDE_S = 1.1


class Walk(NamedTuple):
    """A walk that starts from a stand.

    Attributes:
        start_s: its start, on the clock of the samples, seconds.
        end_s: its end.
        stops: whether the wearer stands still after it.
        displacements: (6, 3) displacement of each sensor in its own inertial frame, metres; without a stop,
            its mean over the last stride.
    """

    start_s: float
    end_s: float
    stops: bool
    displacements: Array

    @property
    def lengths_m(self) -> Array:
        """Level distances (6,), metres."""
        return np.linalg.norm(self.displacements[:, :2], axis=1)

    @property
    def length_m(self) -> float:
        """Level distance of most sensors, metres."""
        return float(np.median(self.lengths_m))


def find_walk(moving: Hold, must_stop: bool) -> Walk:
    """Return the longest walk from stand to stand; without one, that of the first seconds after a stand.

    Args:
        moving: samples with orientation of a wearer who stands, walks and stands.
        must_stop: refuse a walk without a stand after it.

    Raises:
        WeakMotionError: there is no stand before the walk, or none after it, or the walk is too short.
        CalibrationError: a sensor measures no acceleration, or lost samples.
    """
    sensors = [_complete(sensor) for sensor in moving]
    if without := [n for n, s in zip(PLACEMENTS, sensors, strict=True) if len(s.time_s) < 2]:
        raise CalibrationError(f"no acceleration from {', '.join(without)}: use another --heading-reset")
    stands = list(_stands(sensors))
    first, last = max(sensor.time_s[0] for sensor in sensors), min(sensor.time_s[-1] for sensor in sensors)
    if not stands or (len(stands) == 1 and stands[0][0] > first + _STRIDE_S):
        raise WeakMotionError("the wearer did not stand still before the steps; first stand for a second")
    starts = [end for _, end in stands]
    ends = [start for start, _ in stands[1:]]
    closed = [(start, end) for start, end in zip(starts, ends, strict=False) if end - start < LONGEST_S]
    walks = [_walk(sensors, start, end, True) for start, end in closed]
    longest = max(walks, key=lambda walk: walk.length_m, default=None)
    if longest is not None and longest.length_m >= SHORTEST_M:
        return longest
    spans = zip(starts, [*ends, last], strict=True)
    opened = [start for start, end in spans if end - start > 2.0 * _STRIDE_S]
    if opened and not must_stop:
        return _walk(sensors, opened[0], min(opened[0] + LONGEST_OPEN_S, last), False)
    if opened and opened[0] not in [start for start, _ in closed]:
        raise WeakMotionError(f"the wearer did not stand still after the steps; {ADVICE}")
    length_m = 0.0 if longest is None else longest.length_m
    raise WeakMotionError(
        f"no heading from these steps: the distance of {length_m:.1f} m is too short; {ADVICE}"
    )


def _complete(sensor: SensorHold) -> SensorHold:
    """Return the samples with an acceleration, in the order of time."""
    order = np.argsort(sensor.time_s, kind="stable")
    order = order[np.isfinite(sensor.acc[order]).all(axis=1)]
    order = order[np.diff(sensor.time_s[order], prepend=-np.inf) > 0.0]
    time_s, quat, acc, gyr, name = sensor
    return SensorHold(time_s[order], quat[order], acc[order], gyr[order], name)


def _stands(sensors: Hold) -> Iterator[tuple[float, float]]:
    """Yield start and end of the times in which no sensor turns, without their edges."""
    first, last = max(s.time_s[0] for s in sensors), min(s.time_s[-1] for s in sensors)
    grid = np.arange(first, last - _TURN_S, _GRID_S)
    still = np.ones(len(grid), bool)
    for name, s in zip(PLACEMENTS, sensors, strict=True):
        # Rounded sums may lie after the last sample.
        rows = [np.searchsorted(s.time_s, t).clip(max=len(s.time_s) - 1) for t in (grid, grid + _TURN_S)]
        one, other = s.quat[rows[0]], s.quat[rows[1]]
        turned = np.degrees(rot.angle_between_quats(one, other))
        still &= turned < (_HEAD_STILL_DEG if name == "head" else _STILL_DEG)
    edges = np.flatnonzero(np.diff(still.astype(int), prepend=0, append=0)).reshape(-1, 2)
    for begin, end in edges:
        # The edges of the samples are no edges of the stand.
        start_s = first if begin == 0 else grid[begin] + _EDGE_S
        end_s = last if end == len(grid) else grid[end - 1] + _TURN_S - _EDGE_S
        if end_s - start_s > STAND_S - 2.0 * _EDGE_S:
            yield float(start_s), float(end_s)


def _walk(sensors: Hold, start_s: float, end_s: float, stops: bool) -> Walk:
    gaps = [_longest_gap(s.time_s, start_s, end_s) for s in sensors]
    if lossy := [f"{n} for {gap:.2f} s" for n, gap in zip(PLACEMENTS, gaps, strict=True) if gap > _GAP_S]:
        raise CalibrationError(
            f"silent during the steps: {', '.join(lossy)}; check power and link, and repeat"
        )
    displacements = [_displacement(sensor, start_s, end_s, stops) for sensor in sensors]
    return Walk(start_s, end_s, stops, np.array(displacements))


def _longest_gap(time_s: Array, start_s: float, end_s: float) -> float:
    """Return the longest time between samples of a walk, the last before and the first after it, seconds."""
    begin = max(int(np.searchsorted(time_s, start_s, side="right")) - 1, 0)
    end = int(np.searchsorted(time_s, end_s)) + 1
    return float(np.diff(time_s[begin:end]).max(initial=0.0))


def _displacement(sensor: SensorHold, start_s: float, end_s: float, stops: bool) -> Array:
    """Return the displacement (3,) of one sensor in its inertial frame, metres."""
    time_s = sensor.time_s
    force = rot.quat_rotate(sensor.quat, sensor.acc)
    rows = (time_s >= start_s) & (time_s <= end_s)
    t = time_s[rows] - start_s
    share = (t / t[-1])[:, None]
    # At rest, everything but gravity is an error, which changes with the orientation.
    before = force[(time_s > start_s - 1.0) & (time_s <= start_s)].mean(axis=0)
    after = force[(time_s >= end_s) & (time_s < end_s + 1.0)].mean(axis=0) if stops else before
    velocity = _integral(force[rows] - before - share * (after - before), t)
    if stops:
        velocity -= share * velocity[-1]
    position = _integral(velocity, t)
    return np.asarray(position[-1] if stops else position[t > t[-1] - _STRIDE_S].mean(axis=0))


def _integral(rows: Array, t: Array) -> Array:
    steps = 0.5 * (rows[1:] + rows[:-1]) * np.diff(t)[:, None]
    return np.concatenate([np.zeros((1, rows.shape[1])), np.cumsum(steps, axis=0)])
