"""Detection of rests, in which a sensor should measure gravity and nothing else."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.calibration.checks import fitting_conventions, tilt_deg
from edgepose.diagnostics.sensor_health.columns import ACC, GYR, QUANTITIES, QUAT, TIME, deviation
from edgepose.imu import GRAVITY
from edgepose.rotations import Array

REST_S, REST_ACC, REST_GYR_DEG_S, REST_TURN_DEG = 1.5, 0.5, 2.0, 1.0
"""At rest: for `REST_S`, two of acceleration (m/s^2), rate and orientation deviate by less than this."""

_RESTS = 8  # attitudes that are kept
_OTHER_ATTITUDE_DEG = 10.0
_TABLE_TURN_DEG, _TABLE_GYR_DEG_S, _TABLE_TILT_DEG = 0.1, 0.5, 5.0  # stiller than any wearer


class Rest(NamedTuple):
    """Means over a time at rest.

    Attributes:
        end_s: its end, seconds.
        quat: (4,) orientation; NaN where it is not measured.
        acc: (3,) specific force in the sensor's frame, m/s^2.
        force: (3,) the same in the inertial frame; NaN without orientation.
        turn_deg: deviation of the orientation, degrees.
        acc_noise: deviation of the acceleration, m/s^2.
        gyr_noise: deviation of the rate, rad/s.
        bias: length of the mean rate, rad/s.
    """

    end_s: float
    quat: Array
    acc: Array
    force: Array
    turn_deg: float
    acc_noise: float
    gyr_noise: float
    bias: float


class RestResult(NamedTuple):
    """Fields of `SensorHealth`."""

    rests: int = 0
    norm_m_s2: float = math.nan
    acc_noise_m_s2: float = math.nan
    gyr_noise_deg_s: float = math.nan
    bias_deg_s: float = math.nan
    gravity_error_m_s2: float = math.nan
    tilt_deg: float = math.nan


class Rests:
    """The newest rest in each attitude of a sensor."""

    def __init__(self) -> None:
        """Start with no rest."""
        self._rests: list[Rest] = []

    def update(self, rows: Array, has: Mapping[str, bool], period_s: float) -> NDArray[np.bool_]:
        """Find the rests in the newest rows, and return which of the rows are at rest.

        Args:
            rows: (n, 15) newest complete rows.
            has: which quantities the sensor sends.
            period_s: mean interval between them, seconds.
        """
        n = max(10, round(REST_S / period_s)) if period_s > 0.0 else len(rows)
        votes, shaking = np.zeros(len(rows)), np.zeros(len(rows))
        for name, limit in (
            ("orientation", math.radians(REST_TURN_DEG) / 2.0),  # a half angle, in a quaternion
            ("acceleration", REST_ACC),
            ("gyroscope", math.radians(REST_GYR_DEG_S)),
        ):
            if has[name]:
                values = rows[:, QUANTITIES[name]]
                if name == "orientation":
                    values = rot.quat_continuous(values)
                deviation = _moving_deviation(values, n) / limit
                votes += deviation < 1.0
                shaking += deviation
        measured = sum(has.values())
        ends = votes >= min(2, measured)
        edges = np.flatnonzero(np.diff(ends, prepend=False, append=False))
        still = np.zeros(len(rows), bool)
        for first, end in edges.reshape(-1, 2):
            # A quantity in a wrong unit, or broken, is outvoted, but only in a long rest: a wearer's tremor
            # is short.
            if votes[first:end].max() < measured and end - first < n:
                continue
            start = max(0, first - n + 1)
            still[start:end] = True
            # The end of a rest includes the start of a motion, so use its stillest part.
            best = first + int(np.argmin(shaking[first:end]))
            self._keep(_rest(rows[best - n + 1 : best + 1], float(rows[end - 1, TIME])))
        return still

    def _keep(self, rest: Rest) -> None:
        """Store a rest as the newest of its attitude."""
        others = [old for old in self._rests if _is_other(old, rest)]
        self._rests = [*others[1 - _RESTS :], rest]

    def lasting(self, since_s: float) -> Rest | None:
        """Return the newest rest, if it has not ended before `since_s`."""
        return self._rests[-1] if self._rests and self._rests[-1].end_s >= since_s else None

    def result(self, has: Mapping[str, bool]) -> RestResult:
        """Return the result so far; `has` says which quantities the sensor sends."""
        if not self._rests:
            return RestResult()
        rest = self._rests[-1]
        result = RestResult(
            len(self._rests),
            float(np.linalg.norm(rest.acc)),
            rest.acc_noise,
            math.degrees(rest.gyr_noise),
            math.degrees(rest.bias),
        )
        if not (has["orientation"] and has["acceleration"]):
            return result
        forces = np.stack([kept.force for kept in self._rests])
        tilt = max(map(tilt_deg, forces))
        error = float(np.linalg.norm(forces - [0.0, 0.0, GRAVITY], axis=1).max())
        return result._replace(gravity_error_m_s2=error, tilt_deg=tilt)

    def fitting_conventions(self) -> list[str]:
        """Return the conventions in which gravity would point upwards in all rests."""
        quats, acc = (np.stack([getattr(rest, name) for rest in self._rests]) for name in ("quat", "acc"))
        return fitting_conventions(quats, acc)


def is_table(rests: Sequence[Rest]) -> bool:
    """Return whether sensors lie side by side in one attitude, stiller than on any wearer."""
    up = np.stack([rest.acc / max(float(np.linalg.norm(rest.acc)), 1e-9) for rest in rests])
    tilt = np.degrees(np.arccos(np.clip(up @ up.T, -1.0, 1.0)))
    noise = [math.degrees(rest.gyr_noise) for rest in rests if math.isfinite(rest.gyr_noise)]
    return (
        bool(tilt.max() < _TABLE_TILT_DEG)
        and max(rest.turn_deg for rest in rests) < _TABLE_TURN_DEG
        and max(noise, default=0.0) < _TABLE_GYR_DEG_S
    )


def _moving_deviation(values: Array, n: int) -> Array:
    """Return the standard deviation, over all columns together, of the n rows up to each; inf if fewer."""
    result = np.full(len(values), np.inf)
    if len(values) < n:
        return result
    centred = np.ascontiguousarray(values.T)  # a sum along memory takes a third of the time
    centred -= centred.mean(axis=1, keepdims=True)
    variance = np.zeros(len(values) - n + 1)
    for column in centred:
        mean, square = _moving_sum(column, n) / n, _moving_sum(column * column, n) / n
        variance += np.maximum(square - mean * mean, 0.0)
    result[n - 1 :] = np.sqrt(variance)
    return result


def _moving_sum(values: Array, n: int) -> Array:
    """Return the sums of n successive values (T,), T - n + 1 of them."""
    sums = np.cumsum(values)
    sums[n:] -= sums[:-n].copy()
    return sums[n - 1 :]


def _rest(rows: Array, end_s: float) -> Rest:
    quat, acc, gyr = rows[:, QUAT], rows[:, ACC], rows[:, GYR]
    oriented = bool(np.isfinite(quat).all())
    return Rest(
        end_s,
        rot.mean_rotation(quat) if oriented else np.full(4, np.nan),
        acc.mean(axis=0),
        rot.quat_rotate(quat, acc).mean(axis=0),
        2.0 * math.degrees(deviation(rot.quat_continuous(quat))),
        deviation(acc),
        deviation(gyr),
        float(np.linalg.norm(gyr.mean(axis=0))),
    )


def _is_other(old: Rest, new: Rest) -> bool:
    """Return whether two rests are in different attitudes relative to gravity."""
    size = float(np.linalg.norm(old.acc) * np.linalg.norm(new.acc))
    if not size > 0.0:
        return False
    return float(old.acc @ new.acc) / size < math.cos(math.radians(_OTHER_ATTITUDE_DEG))
