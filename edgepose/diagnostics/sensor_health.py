"""How each sensor of a rig does, measured on its samples while they come; `rules` judges it.

Times at rest tell most: whatever its attitude, a sensor at rest measures nothing but gravity, which its
orientation turns to (0, 0, 9.81) in the inertial frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np

from edgepose import rotations as rot
from edgepose.calibration.checks import GRAVITY, GRAVITY_TILT_LIMIT_DEG, tilt_deg, two_sensors, why_not_up
from edgepose.calibration.fit import POSE_TILT_DEG, fit_pose, from_median
from edgepose.calibration.headings import RESET_TILT_LIMIT_DEG, headings_from_pose, turn_about_z
from edgepose.calibration.sensor_to_segment import Calibration
from edgepose.imu import ImuSample
from edgepose.placements import PLACEMENTS
from edgepose.rotations import Array
from edgepose.sources.clock_sync import DeviceClock

WINDOW_S = 10.0
"""What is called present: the newest samples, seconds."""

REST_S, REST_ACC, REST_GYR_DEG_S, REST_TURN_DEG = 1.5, 0.5, 2.0, 1.0
"""At rest: for so long, two of acceleration (m/s^2), rate and orientation deviate by less."""

_FOLD_S = 2.0  # how often samples become numbers where nobody asks for them
_MOST_PENDING = 5000
_MOST_ROWS = 10_240  # of a window
_FEWEST = 20  # samples that tell a period
_GAP = 1.5  # periods
_SETTLE_S, _LATE_LEAST_S = 2.0, 3.0  # what has waited in the system comes first
_RESTS = 8  # attitudes that are kept
_OTHER_ATTITUDE_DEG = 10.0
_POSE_OFF_DEG = 30.0  # of six sensors together: how well somebody finds the pose again
_FROZEN_S = 1.0
_TURN_S, _TURN_LIMIT, _MOST_TURN = 0.1, math.radians(3.0), 1.0  # step, radians in a step
_TABLE_TURN_DEG, _TABLE_GYR_DEG_S, _TABLE_TILT_DEG = 0.1, 0.5, 5.0  # stiller than any wearer
_FULL_SCALES = {
    "acceleration": np.array([2, 4, 6, 8, 16, 32]) * GRAVITY,
    "gyroscope": np.radians([125, 250, 500, 1000, 2000, 4000]),
}

_TIME, _ARRIVAL, _WIDTH = 0, 14, 15
_QUAT, _ACC, _GYR, _MAG = slice(1, 5), slice(5, 8), slice(8, 11), slice(11, 14)
_NAMES = {"orientation": _QUAT, "acceleration": _ACC, "gyroscope": _GYR}
_NAN3, _NAN4 = (math.nan,) * 3, (math.nan,) * 4


@dataclass
class SensorHealth:
    """What is known of one sensor; NaN and None where it is not.

    Attributes:
        placement: its name.
        samples: that have come.
        age_s: of the newest one.
        rate_hz: samples a second, gaps left out.
        jitter_ms: deviation of the intervals, gaps left out.
        lost: samples missing in the times of the sensor, lost_percent of all.
        late_ms: 95 % of the packets come no later than this after the fastest ones.
        invalid: samples with a NaN or with a quaternion that is no rotation.
        orientation: whether it sends one; acceleration, gyroscope and magnetometer alike.
        incomplete_percent: samples without something that others have.
        rests: attitudes in which it has been at rest.
        norm_m_s2: length of the acceleration at rest; 9.81.
        gravity_error_m_s2: largest length of R f + g at rest; 0.
        tilt_deg: largest angle at rest between the acceleration in the inertial frame and up.
        convention: what would explain that angle.
        acc_noise_m_s2: deviation of the acceleration at rest, gyr_noise_deg_s that of the rate.
        bias_deg_s: mean rate at rest.
        clock_ppm: what the device's clock loses against this machine's, with its standard error.
        clock_restarts: times that it began anew.
        field_ut: median length of the magnetic field, in uT or in the device's own unit.
        field_change_percent: between the 5th and 95th percentile of that length.
        heading_deg: against the median of all sensors, lying side by side or standing in the pose.
        heading_on: "table" or "body".
        pose_tilt_deg: tilt against the calibration's pose in which the wearer stands.
        swapped_with: the placement with which exchanged it would stand in that pose.
        repeated_percent: samples that are the same as the one before, in motion.
        frozen: what stands still while the sensor moves, or "everything" while the others go on.
        saturated: what has been at the end of its range.
        gyro_ratio: rate of the gyroscope over that of the orientation.
        gyro_agreement: correlation of the two; 1.
        gyro_exchanged: the same with the best exchange of axes and signs.
        two_devices_deg: angle between two devices that alternate under this name.
        same_as: a placement that sends the same values.
    """

    placement: str
    samples: int = 0
    age_s: float = math.nan
    rate_hz: float = math.nan
    jitter_ms: float = math.nan
    lost: int = 0
    lost_percent: float = math.nan
    late_ms: float = math.nan
    invalid: int = 0
    orientation: bool = False
    acceleration: bool = False
    gyroscope: bool = False
    magnetometer: bool = False
    incomplete_percent: float = math.nan
    rests: int = 0
    norm_m_s2: float = math.nan
    gravity_error_m_s2: float = math.nan
    tilt_deg: float = math.nan
    convention: str | None = None
    acc_noise_m_s2: float = math.nan
    gyr_noise_deg_s: float = math.nan
    bias_deg_s: float = math.nan
    clock_ppm: float = math.nan
    clock_ppm_error: float = math.nan
    clock_restarts: int = 0
    field_ut: float = math.nan
    field_change_percent: float = math.nan
    heading_deg: float = math.nan
    heading_on: str | None = None
    pose_tilt_deg: float = math.nan
    swapped_with: str | None = None
    repeated_percent: float = math.nan
    frozen: str | None = None
    saturated: str | None = None
    gyro_ratio: float = math.nan
    gyro_agreement: float = math.nan
    gyro_exchanged: float = math.nan
    two_devices_deg: float | None = None
    same_as: str | None = None


class Health:
    """Takes the samples of a rig and says at any time how its sensors do."""

    def __init__(self, calibration: Calibration | None = None) -> None:
        """Start with no sample seen; with a calibration, headings and placements are judged on the body."""
        self._calibration = calibration
        self._sensors = [_Sensor() for _ in PLACEMENTS]
        self._next_fold_s = -math.inf
        self._headings: tuple[str | None, Array] = (None, np.full(len(PLACEMENTS), np.nan))
        self._pose: tuple[Array, list[str | None]] | None = None
        self._pose_off_deg = math.inf

    def add(self, samples: Iterable[ImuSample], arrival_s: float = math.nan) -> None:
        """Take samples in.

        Args:
            samples: of any sensors, each sensor's in time order.
            arrival_s: when they came, on their clock, seconds; NaN if nobody knows.
        """
        sensors = self._sensors
        for index, time_s, quat, acc, gyr, mag in samples:
            pending = sensors[index].pending
            pending.append(
                (time_s, *(quat or _NAN4), *(acc or _NAN3), *(gyr or _NAN3), *(mag or _NAN3), arrival_s)
            )
            if time_s >= self._next_fold_s or len(pending) >= _MOST_PENDING:
                self._fold()
                self._next_fold_s = time_s + _FOLD_S

    def report(self, now_s: float, clocks: Mapping[int, DeviceClock] | None = None) -> list[SensorHealth]:
        """What is known of the sensors, in the order of PLACEMENTS.

        Args:
            now_s: time up to which all samples have been taken in, on their clock, seconds.
            clocks: of the sensors that send a time.
        """
        self._fold()
        result = [sensor.health(name, now_s) for name, sensor in zip(PLACEMENTS, self._sensors, strict=True)]
        for index, clock in (clocks or {}).items():
            result[index].clock_restarts = clock.resets
            result[index].clock_ppm, result[index].clock_ppm_error = clock.drift_ppm()
        heading_on, headings = self._headings
        for i, own in enumerate(result):
            own.heading_deg = float(headings[i])
            own.heading_on = heading_on
            if self._pose is not None:
                own.pose_tilt_deg, own.swapped_with = float(self._pose[0][i]), self._pose[1][i]
        self._compare(result)
        return result

    def _fold(self) -> None:
        for sensor in self._sensors:
            sensor.fold()
        self._compare_headings()

    def _compare(self, result: list[SensorHealth]) -> None:
        """What only shows next to the others: values that are another's, or that stand still alone."""
        values = [sensor.values() for sensor in self._sensors]
        for (i, own), (j, other) in combinations(enumerate(values), 2):
            if _FEWEST < len(own) * 0.8 <= len(own & other):
                result[i].same_as, result[j].same_as = PLACEMENTS[j], PLACEMENTS[i]
        # A simulated rig at rest is constant as a whole, and not quite from the same time on.
        if sum(sensor.is_constant(_FROZEN_S) is False for sensor in self._sensors) >= 2:
            for report, sensor in zip(result, self._sensors, strict=True):
                if sensor.is_constant(2.0 * _FROZEN_S):
                    report.frozen = "everything"

    def _compare_headings(self) -> None:
        """Headings of sensors that are all at rest, if they lie side by side or the wearer stands in the
        pose."""
        rests = [sensor.present_rest() for sensor in self._sensors]
        there = [i for i, rest in enumerate(rests) if rest is not None]
        present = [i for i, sensor in enumerate(self._sensors) if len(sensor.window)]
        if len(there) < 2 or len(there) < len(present):
            return
        own = [rest for rest in rests if rest is not None]
        quats = np.stack([rest.quat for rest in own])
        if _is_table(own):
            reset = turn_about_z(quats, quats[-1])
            if reset.error_deg.max() < RESET_TILT_LIMIT_DEG:
                headings = np.full(len(PLACEMENTS), np.nan)
                headings[there] = from_median(-reset.offset)
                self._headings = "table", headings
        elif self._calibration is not None and len(there) == len(PLACEMENTS):
            self._compare_pose(self._calibration, quats)

    def _compare_pose(self, calibration: Calibration, quats: Array) -> None:
        """The sensors of a wearer who stands in the pose, or should."""
        fit = fit_pose(calibration, quats)
        if fit.off_deg > self._pose_off_deg + _POSE_OFF_DEG:
            return  # they stood nearer to it before
        self._pose_off_deg = min(fit.off_deg, self._pose_off_deg)
        if fit.in_pose:
            self._headings = "body", fit.heading_deg
        swaps: list[str | None] = [None] * len(PLACEMENTS)
        if fit.sits_at is not None:
            swaps = [PLACEMENTS[at] if at != i else None for i, at in enumerate(fit.sits_at)]
        elif fit.in_pose:
            swaps = _swaps(calibration, quats, fit.tilt_deg)
        self._pose = fit.tilt_deg, swaps


class _Rest(NamedTuple):
    """Means over a time at rest."""

    end_s: float
    quat: Array  # (4,), NaN without orientation
    acc: Array  # (3,)
    force: Array  # (3,) in the inertial frame, NaN without orientation
    turn_deg: float  # deviation of the orientation
    acc_noise: float
    gyr_noise: float  # rad/s
    bias: float  # rad/s


class _Sensor:
    """Samples and sums of one sensor."""

    def __init__(self) -> None:
        self.pending: list[tuple[float, ...]] = []
        self.window = np.empty((0, _WIDTH))
        self._first_s = math.nan
        self._fresh = 0  # rows at the end of the window that have not been counted
        self._samples = self._invalid = self._lost = self._counted = 0
        self._moved = self._repeated = self._incomplete = 0
        self._period_s = math.nan
        self._jitter_s = math.nan
        self._has: dict[str, bool] = dict.fromkeys(_NAMES, False)
        self._rests: list[_Rest] = []
        self._frozen: str | None = None
        self._saturated: set[str] = set()
        self._turns = np.zeros((3, 3))  # of orientation (row) and gyroscope, sums over steps
        self._turn_squares = np.zeros(2)
        self._steps = 0

    def fold(self) -> None:
        """Make numbers of the samples that have come since the last time."""
        if self.pending:
            new = np.array(self.pending)
            self.pending = []
            if not self._samples:
                self._first_s = float(new[0, _TIME])
            self._samples += len(new)
            self._fresh += len(new)
            rows = np.concatenate([self.window, new])
            present = int(np.count_nonzero(rows[:, _TIME] > rows[-1, _TIME] - WINDOW_S))
            self.window = rows[-min(max(self._fresh + 1, present), _MOST_ROWS) :]
            self._fresh = min(self._fresh, len(self.window))
        if self._fresh and len(self.window) >= _FEWEST:
            self._count()
            self._fresh = 0

    def _count(self) -> None:
        rows, fresh = self.window, self.window[-self._fresh :]
        self._time(rows[-self._fresh - 1 :, _TIME] if self._fresh < len(rows) else fresh[:, _TIME])
        measured = {name: ~np.isnan(rows[:, columns]).any(axis=1) for name, columns in _NAMES.items()}
        self._has = {name: bool(own.mean() > 0.2) for name, own in measured.items()}
        needed = [measured[name] for name, has in self._has.items() if has]
        complete = np.all(needed, axis=0) if needed else np.zeros(len(rows), bool)
        self._incomplete += int(np.count_nonzero(~complete[-len(fresh) :]))
        self._counted += len(fresh)
        self._invalid += _invalid(fresh)
        if not np.any(complete):
            return
        rows, new = rows[complete], int(np.count_nonzero(complete[-len(fresh) :]))
        still = self._find_rests(rows)
        self._look_for_repeats(rows, still, new)
        for name in ("acceleration", "gyroscope"):
            if new and _saturates(rows[-new:, _NAMES[name]], _FULL_SCALES[name]):
                self._saturated.add(name)
        if self._has["orientation"] and self._has["gyroscope"]:
            self._compare_turns(rows[-new - 1 :])

    def _time(self, fresh_s: Array) -> None:
        """Period, its deviation, and what is missing."""
        intervals = np.diff(self.window[:, _TIME])
        middle = float(np.median(intervals))
        if not middle > 0.0:
            return
        steps = intervals / middle
        # Only where nearly all intervals are multiples of one does a long one mean that something is missing.
        regular = np.mean(np.abs(steps - np.round(steps)) < 0.2) > 0.9
        usual = intervals[steps < _GAP] if regular else intervals
        self._period_s, self._jitter_s = float(usual.mean()), float(usual.std())
        if regular:
            steps = np.diff(fresh_s) / self._period_s
            self._lost += int(np.round(steps[steps > _GAP] - 1.0).sum())

    def _find_rests(self, rows: Array) -> Array:
        """Which rows are at rest; rests of the window become known."""
        n = max(10, round(REST_S / self._period_s)) if self._period_s > 0.0 else len(rows)
        votes, shaking = np.zeros(len(rows)), np.zeros(len(rows))
        for name, limit in (
            ("orientation", math.radians(REST_TURN_DEG) / 2.0),  # a half angle, in a quaternion
            ("acceleration", REST_ACC),
            ("gyroscope", math.radians(REST_GYR_DEG_S)),
        ):
            if self._has[name]:
                values = rows[:, _NAMES[name]]
                if name == "orientation":
                    values = rot.quat_continuous(values)
                deviation = _moving_deviation(values, n) / limit
                votes += deviation < 1.0
                shaking += deviation
        measured = sum(self._has.values())
        ends = votes >= min(2, measured)
        edges = np.flatnonzero(np.diff(ends, prepend=False, append=False))
        still = np.zeros(len(rows), bool)
        for first, end in edges.reshape(-1, 2):
            # One that is of another unit, or broken, has no say; but a wearer trembles for a moment.
            if votes[first:end].max() < measured and end - first < n:
                continue
            start = max(0, first - n + 1)
            still[start:end] = True
            # A rest ends with the beginning of a motion: its stillest part counts.
            best = first + int(np.argmin(shaking[first:end]))
            self._keep(_rest(rows[best - n + 1 : best + 1], float(rows[end - 1, _TIME])))
        return still

    def _keep(self, rest: _Rest) -> None:
        """The newest rest of every attitude."""
        others = [old for old in self._rests if _is_other(old, rest)]
        self._rests = [*others[1 - _RESTS :], rest]

    def _look_for_repeats(self, rows: Array, still: Array, new: int) -> None:
        values = rows[:, _QUAT.start : _GYR.stop]
        first = max(len(rows) - 1 - new, 0)
        moving = np.logical_not(still[1:][first:])
        same = np.all((values[1:] == values[:-1]) | np.isnan(values[1:]), axis=1)[first:]
        self._moved += int(np.count_nonzero(moving))
        self._repeated += int(np.count_nonzero(same & moving))
        if self._period_s > 0.0:
            self._frozen = _frozen(rows[-max(10, round(_FROZEN_S / self._period_s)) :]) or self._frozen

    def _compare_turns(self, rows: Array) -> None:
        """Sums over how far orientation and gyroscope turn in steps of a tenth of a second."""
        step = max(1, round(_TURN_S / self._period_s)) if self._period_s > 0.0 else 1
        quat, gyr, times = rows[:, _QUAT], rows[:, _GYR], rows[:, _TIME]
        between = 0.5 * (gyr[1:] + gyr[:-1]) * np.diff(times)[:, None]
        at = np.arange(0, len(rows), step)
        if len(at) < 2:
            return
        by_gyr = np.diff(np.concatenate([np.zeros((1, 3)), np.cumsum(between, axis=0)])[at], axis=0)
        by_quat = rot.quat_to_rotvec(rot.quat_multiply(rot.quat_conjugate(quat[at[:-1]]), quat[at[1:]]))
        size, other = np.linalg.norm(by_quat, axis=1), np.linalg.norm(by_gyr, axis=1)
        use = (np.diff(times[at]) < 2.0 * step * self._period_s) & (size < _MOST_TURN)
        use &= np.maximum(size, other) > _TURN_LIMIT
        self._turns += by_quat[use].T @ by_gyr[use]
        self._turn_squares += [np.square(size[use]).sum(), np.square(other[use]).sum()]
        self._steps += int(np.count_nonzero(use))

    def present_rest(self) -> _Rest | None:
        """The rest that lasts up to now, of a sensor with orientation."""
        if not self._rests or not self._has["orientation"]:
            return None
        rest = self._rests[-1]
        return rest if rest.end_s >= self.window[-1, _TIME] - 3.0 * self._period_s else None

    def values(self) -> set[bytes]:
        """The newest different samples."""
        return {row.tobytes() for row in self.window[-300:, _QUAT.start : _GYR.stop]}

    def is_constant(self, seconds: float) -> bool | None:
        """Whether all samples of the last seconds are the same; None if there are too few."""
        if not len(self.window):
            return None
        rows = self.window[self.window[:, _TIME] > self.window[-1, _TIME] - seconds]
        values = rows[:, _QUAT.start : _GYR.stop]
        if len(values) < _FEWEST:
            return None
        return bool(np.all((values == values[0]) | np.isnan(values)))

    def health(self, placement: str, now_s: float) -> SensorHealth:
        """What is known of this sensor alone."""
        result = SensorHealth(placement, self._samples, invalid=self._invalid)
        if not self._samples:
            return result
        rows = self.window
        result.age_s = max(0.0, now_s - float(rows[-1, _TIME]))
        result.rate_hz, result.jitter_ms = 1.0 / self._period_s, 1e3 * self._jitter_s
        result.late_ms = 1e3 * self._late_s()
        result.lost = self._lost
        result.lost_percent = 100.0 * self._lost / (self._lost + self._samples)
        for name, has in self._has.items():
            setattr(result, name, has)
        result.incomplete_percent = 100.0 * self._incomplete / max(1, self._counted)
        if self._moved >= _FEWEST:
            result.repeated_percent = 100.0 * self._repeated / self._moved
        result.frozen = self._frozen
        result.saturated = " and ".join(sorted(self._saturated)) or None
        if self._has["orientation"]:
            quats = rows[-200:, _QUAT]
            quats = quats[np.isfinite(quats).all(axis=1)]
            if len(quats) >= _FEWEST:
                result.two_devices_deg = two_sensors(quats)
        self._report_rests(result)
        self._report_turns(result)
        self._report_field(result)
        return result

    def _late_s(self) -> float:
        """How much later than the fastest packets most come, once the device's clock is known."""
        rows = self.window[self.window[:, _TIME] > self._first_s + _SETTLE_S]
        if not len(rows) or rows[-1, _TIME] - rows[0, _TIME] < _LATE_LEAST_S:
            return math.nan
        low, high = np.percentile(rows[:, _ARRIVAL] - rows[:, _TIME], [5, 95])
        return float(high - low)

    def _report_rests(self, result: SensorHealth) -> None:
        result.rests = len(self._rests)
        if not self._rests:
            return
        rest = self._rests[-1]
        result.norm_m_s2 = float(np.linalg.norm(rest.acc))
        result.acc_noise_m_s2 = rest.acc_noise
        result.gyr_noise_deg_s = math.degrees(rest.gyr_noise)
        result.bias_deg_s = math.degrees(rest.bias)
        if not (self._has["orientation"] and self._has["acceleration"]):
            return
        forces = np.stack([own.force for own in self._rests])
        result.gravity_error_m_s2 = float(np.linalg.norm(forces - [0.0, 0.0, GRAVITY], axis=1).max())
        result.tilt_deg = max(map(tilt_deg, forces))
        if result.tilt_deg > GRAVITY_TILT_LIMIT_DEG:
            quats = np.stack([own.quat for own in self._rests])
            result.convention = why_not_up(quats, np.stack([own.acc for own in self._rests]))

    def _report_turns(self, result: SensorHealth) -> None:
        if self._steps < 10 or not self._turn_squares.all():
            return
        size = math.sqrt(self._turn_squares.prod())
        result.gyro_ratio = math.sqrt(self._turn_squares[1] / self._turn_squares[0])
        result.gyro_agreement = float(np.trace(self._turns)) / size
        best = max(np.abs(self._turns)[range(3), order].sum() for order in permutations(range(3)))
        result.gyro_exchanged = float(best) / size

    def _report_field(self, result: SensorHealth) -> None:
        norms = np.linalg.norm(self.window[:, _MAG], axis=1)
        norms = norms[np.isfinite(norms)]
        result.magnetometer = len(norms) > 0
        if len(norms):
            low, middle, high = np.percentile(norms, [5, 50, 95])
            result.field_ut = float(middle)
            result.field_change_percent = 100.0 * float(high - low) / max(float(middle), 1e-9)


def _invalid(rows: Array) -> int:
    """Rows with a number that is NaN in part of a quantity, infinite, or a quaternion that is no rotation."""
    bad = np.isinf(rows[:, :_ARRIVAL]).any(axis=1)
    for columns in (*_NAMES.values(), _MAG):
        unknown = np.isnan(rows[:, columns])
        bad |= unknown.any(axis=1) & ~unknown.all(axis=1)
    norm = np.linalg.norm(rows[:, _QUAT], axis=1)
    return int(np.count_nonzero(bad | (np.abs(norm - 1.0) > 0.01)))


def _moving_deviation(values: Array, n: int) -> Array:
    """Standard deviation, over all columns together, of the n rows up to each; infinite where there are
    fewer."""
    result = np.full(len(values), np.inf)
    if len(values) < n:
        return result
    centred = values - values.mean(axis=0)
    sums = np.cumsum(np.pad(centred, ((1, 0), (0, 0))), axis=0)
    squares = np.cumsum(np.pad(np.square(centred), ((1, 0), (0, 0))), axis=0)
    mean, square = (sums[n:] - sums[:-n]) / n, (squares[n:] - squares[:-n]) / n
    result[n - 1 :] = np.sqrt(np.maximum(square - np.square(mean), 0.0).sum(axis=1))
    return result


def _deviation(values: Array) -> float:
    return float(np.sqrt(values.var(axis=0).sum()))


def _rest(rows: Array, end_s: float) -> _Rest:
    quat, acc, gyr = rows[:, _QUAT], rows[:, _ACC], rows[:, _GYR]
    oriented = bool(np.isfinite(quat).all())
    return _Rest(
        end_s,
        rot.mean_rotation(quat) if oriented else np.full(4, np.nan),
        acc.mean(axis=0),
        rot.quat_rotate(quat, acc).mean(axis=0),
        2.0 * math.degrees(_deviation(rot.quat_continuous(quat))),
        _deviation(acc),
        _deviation(gyr),
        float(np.linalg.norm(gyr.mean(axis=0))),
    )


def _is_other(old: _Rest, new: _Rest) -> bool:
    """Whether two rests are of different attitudes against gravity."""
    size = float(np.linalg.norm(old.acc) * np.linalg.norm(new.acc))
    if not size > 0.0:
        return False
    return float(old.acc @ new.acc) / size < math.cos(math.radians(_OTHER_ATTITUDE_DEG))


def _frozen(rows: Array) -> str | None:
    """A quantity that does not change in rows in which others say that the sensor moves."""
    moving = {
        "orientation": 2.0 * math.degrees(_deviation(rot.quat_continuous(rows[:, _QUAT]))) > 5.0,
        "acceleration": _deviation(rows[:, _ACC]) > 1.0,
        "gyroscope": math.degrees(_deviation(rows[:, _GYR])) > 10.0,
    }
    if np.isfinite(rows[:, _QUAT]).all():
        del moving["gyroscope"]  # in a wrong unit, its noise looks like movement
    for name, columns in _NAMES.items():
        values = rows[:, columns]
        others = any(is_moving for other, is_moving in moving.items() if other != name)
        if others and bool(np.all(values == values[0])):
            return name
    return None


def _saturates(values: Array, full_scales: Array) -> bool:
    """Whether a number stays the same for three rows, near the end of a usual range."""
    size = np.abs(values)
    same = (size[2:] == size[1:-1]) & (size[1:-1] == size[:-2])
    stuck = size[2:][same]
    return bool(np.any(np.abs(stuck[:, None] / full_scales - 1.0) < 0.05))


def _is_table(rests: list[_Rest]) -> bool:
    """Whether sensors lie side by side in one attitude, stiller than anybody stands."""
    up = np.stack([rest.acc / max(float(np.linalg.norm(rest.acc)), 1e-9) for rest in rests])
    tilt = np.degrees(np.arccos(np.clip(up @ up.T, -1.0, 1.0)))
    noise = [math.degrees(rest.gyr_noise) for rest in rests if math.isfinite(rest.gyr_noise)]
    return (
        bool(tilt.max() < _TABLE_TILT_DEG)
        and max(rest.turn_deg for rest in rests) < _TABLE_TURN_DEG
        and max(noise, default=0.0) < _TABLE_GYR_DEG_S
    )


def _swaps(calibration: Calibration, quats: Array, tilt: Array) -> list[str | None]:
    """For each sensor, the one with which exchanged both would stand in the pose."""
    result: list[str | None] = [None] * len(PLACEMENTS)
    for i, j in combinations(np.flatnonzero(tilt > POSE_TILT_DEG), 2):
        exchanged = quats.copy()
        exchanged[[i, j]] = quats[[j, i]]
        if headings_from_pose(calibration, exchanged).error_deg[[i, j]].max() < POSE_TILT_DEG:
            result[i], result[j] = PLACEMENTS[j], PLACEMENTS[i]
    return result
