"""Error-state Kalman filter: orientation of one sensor from gyroscope, accelerometer and magnetometer.

Every sample is integrated as it comes. Block by block (0.14 s) the errors of the integration are estimated
and corrected from three measurements: a velocity that has to stay near zero, which separates tilt from
acceleration; the rate at rest; the heading of an undisturbed magnetic field.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from math import atan2, hypot, inf, pi, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edgepose import rotations as rot
from edgepose.orientation import error_model as model
from edgepose.orientation.magnetic_reference import MagneticReference
from edgepose.orientation.rest import RestDetector
from edgepose.orientation.sample_checks import MagnetometerMonitor, SampleChecker
from edgepose.orientation.sample_loop import FilterState, Quat, orient_arrays
from edgepose.orientation.settings import FilterSettings
from edgepose.orientation.types import Event, OrientationResult

Array = NDArray[np.float64]

_UP = np.array([0.0, 0.0, 1.0])
_EYE3 = np.eye(3)
_CONING = 1.0 / 12.0  # for rates that are means over the interval
_ZERO = (0.0, 0.0, 0.0)
_NO_ERROR = np.zeros(model.SIZE)
_NO_ERROR.flags.writeable = False
_ROW = 10  # numbers of a sample in a block: dt, gyr, acc, mag
_LEAST_FORCE = 1.0  # m/s^2; less has no direction
_GAP, _SATURATED, _MAG_LOST, _RESTART = (
    int(e) for e in (Event.GAP, Event.SATURATED, Event.MAG_LOST, Event.RESTART)
)


class Step(NamedTuple):
    """A correction, recorded for smoothing.

    Attributes:
        row: the sample after which it was made, counted from the filter's first.
        matrix: (21, 21) propagation of errors since the step before; None where the filter restarted.
        predicted: (21, 21) covariance before the correction.
        error: (21,) the error that was found and corrected.
        covariance: (21, 21) covariance after the correction.
        bias: (3,) gyroscope bias after the correction, rad/s.
        turned: angle by which the step rotated the inertial frame about Z (at the first field after a time
            without), rad; all errors from here on are in the rotated frame.
    """

    row: int
    matrix: Array | None
    predicted: Array
    error: Array
    covariance: Array
    bias: Array
    turned: float = 0.0


class OrientationFilter:
    """Online, causal filter of one sensor: an orientation depends on its sample and earlier ones only.

    The same samples give the same result however they are chunked. `Event` describes the handling of bad
    samples, gaps and time stamps. A rate counts as the mean since the sample before, which is what sensors
    that integrate or average send; for others the orientation is late by half an interval.

    Attributes:
        state: as of the last correction.
        on_step: called after each correction, if set.
    """

    def __init__(self, settings: FilterSettings | None = None) -> None:
        """Create the filter; the first good sample starts it."""
        # Imported here because most commands never filter.
        from filterpy.kalman import KalmanFilter

        self.on_step: Callable[[Step], None] | None = None
        self._settings = settings or FilterSettings()
        self._kalman = KalmanFilter(dim_x=model.SIZE, dim_z=3)
        self._kalman.x = _NO_ERROR
        self._noise_density = model.noise_density(self._settings)
        self._checker = SampleChecker(self._settings)
        self._rest = RestDetector(self._settings)
        self._magnetometer = MagnetometerMonitor(self._settings)
        self._reference = MagneticReference(self._settings)
        self._row = self._last = 0  # numbers of the next sample and of the last good one
        self._started = False
        self._quat: Quat = (1.0, 0.0, 0.0, 0.0)
        self._rate: Sequence[float] = (0.0, 0.0, 0.0)  # of the last good sample
        self._angle = _ZERO  # by which it turned
        self._known = _NO_ERROR.copy()  # errors estimated so far; that of the orientation is in _quat
        # Sensitivity and bias as floats: the loop over samples has no arrays in it.
        self._correction: tuple[float, ...] = (*_EYE3.ravel().tolist(), 0.0, 0.0, 0.0)
        self._has_heading = False
        self._field_age_s = 0.0  # of the last one that was used or rejected
        self.state = FilterState(np.zeros(3), np.full(3, self._settings.bias_start), False, False)
        self._begin_block()

    def _begin_block(self) -> None:
        self._block = array("d")
        self._quats = array("d", self._quat)
        self._block_s = 0.0
        self._fields = 0  # measured in the block
        self._lost_angle = self._lost_speed = 0.0

    def update(
        self, time_s: ArrayLike, gyr: ArrayLike, acc: ArrayLike, mag: ArrayLike | None = None
    ) -> OrientationResult:
        """Return the orientations of the next samples.

        Args:
            time_s: (N,) times of the measurements, s.
            gyr: (N, 3) rates, sensor frame, rad/s.
            acc: (N, 3) specific force, sensor frame, m/s^2.
            mag: (N, 3) magnetic field, sensor frame, in any unit; rows of NaN where it was not measured.

        Raises:
            ValueError: the shapes do not match.
        """
        return orient_arrays(self, time_s, gyr, acc, mag)

    def take(
        self, time_s: float, gyr: Sequence[float], acc: Sequence[float], mag: Sequence[float]
    ) -> tuple[Quat, int]:
        """Return the orientation of the next sample, and its events as bits of `Event`.

        Args:
            time_s: time of the measurement, s.
            gyr: (3,) rate, rad/s.
            acc: (3,) specific force, m/s^2.
            mag: (3,) magnetic field; NaN where it was not measured.
        """
        events, dt = self._checker.check(time_s, gyr, acc)
        if dt == inf:
            events |= _RESTART if self._started else 0
            self._restart(acc, mag)
        elif dt > 0.0:
            self._integrate(events, dt, gyr, acc, mag)
        if dt > 0.0:
            self._rate, self._last = gyr, self._row
        self._row += 1
        return self._quat, events | _MAG_LOST if self._magnetometer.lost else events

    def _integrate(
        self, events: int, dt: float, gyr: Sequence[float], acc: Sequence[float], mag: Sequence[float]
    ) -> None:
        """Integrate the sample's rate, and correct the errors at the end of a block."""
        rate = gyr
        if events:
            rate = self._uncertain(events, dt, gyr, acc)
        x, y, z = rate
        xx, xy, xz, yx, yy, yz, zx, zy, zz, bx, by, bz = self._correction
        a = (xx * x + xy * y + xz * z - bx) * dt
        b = (yx * x + yy * y + yz * z - by) * dt
        c = (zx * x + zy * y + zz * z - bz) * dt
        # The axis turns between samples, too (coning): to second order by their cross product.
        d, e, f = self._angle
        self._angle = (a, b, c)
        self._quat = quat = rot.integrate_rotvec(
            self._quat,
            a + _CONING * (e * c - f * b),
            b + _CONING * (f * a - d * c),
            c + _CONING * (d * b - e * a),
        )
        self._quats.extend(quat)
        if self._magnetometer.check(dt, mag):
            self._fields += 1
        else:
            mag = _ZERO
        self._block.extend((dt, x, y, z, *acc, *mag))
        self._block_s += dt
        if self._block_s >= self._settings.block_s:
            self._correct(self._row)

    def _uncertain(
        self, events: int, dt: float, gyr: Sequence[float], acc: Sequence[float]
    ) -> Sequence[float]:
        """Add what a sample with events may have missed; return its rate, in a gap the mean rate."""
        s = self._settings
        if events & _SATURATED:
            self._lost_angle = min(self._lost_angle + s.lost_share * hypot(*gyr) * dt, pi)
            self._lost_speed += s.lost_share * hypot(*acc) * dt
        if not events & _GAP:
            return gyr
        self._angle = _ZERO
        self._lost_angle = min(self._lost_angle + s.gap_turn * dt * dt, pi)
        self._lost_speed += s.gap_acc * dt
        return [0.5 * (a + b) for a, b in zip(gyr, self._rate, strict=True)]

    # --- start and restart ----------------------------------------------------------------------------------

    def _restart(self, acc: Sequence[float], mag: Sequence[float]) -> None:
        """Take the tilt from a force, and at the very first sample the heading from the field."""
        s = self._settings
        if self._block:
            self._correct(self._last)
        self._quat = _levelled(self._quat, acc)
        covariance = model.start_covariance(s, 0.0)
        if self._started:
            before = self._kalman.P
            heading = min(before[model.HEADING, model.HEADING] + s.heading_start**2, pi**2)
            for part in (model.BIAS, model.ACC_BIAS, model.SENSITIVITY):
                covariance[part, part] = before[part, part]
            covariance[model.HEADING, model.HEADING] = heading
        self._kalman.P = covariance
        self._known[model.VEL] = 0.0
        self._angle = _ZERO
        self._rest.restart()
        self._started = True
        if self._magnetometer.check(0.0, mag) and not self._has_heading:
            self._find_north(rot.quat_rotate(self._quat, mag), self._row)
        else:
            self._record_step(self._row, None, covariance, _NO_ERROR)
            self._begin_block()
        self._publish()

    def _find_north(self, field: Array, row: int) -> None:
        """Rotate the inertial frame's Y axis to the direction of the first field."""
        angle = atan2(field[0], field[1])
        rotation = rot.quat_about_z(angle)
        self._quat = _as_quat(rot.quat_multiply(rotation, self._quat))
        self._known[model.VEL] = rot.quat_rotate(rotation, self._known[model.VEL])
        frame = model.IDENTITY.copy()
        frame[model.TURN, model.TURN] = frame[model.VEL, model.VEL] = rot.quat_to_matrix(rotation)
        frame[model.HEADING] = 0.0
        covariance = frame @ self._kalman.P @ frame.T
        covariance[model.HEADING, model.HEADING] = self._settings.heading_start**2
        self._kalman.P = covariance
        self._has_heading = True
        self._record_step(row, None, covariance, _NO_ERROR, angle)
        self._begin_block()

    # --- corrections ----------------------------------------------------------------------------------------

    def _correct(self, row: int) -> None:
        """Close the block: estimate the errors at its end and correct them."""
        kalman = self._kalman
        block = np.array(self._block).reshape(-1, _ROW)
        gyr, mag = block[:, 1:4], block[:, 7:10]
        quats = np.array(self._quats).reshape(-1, 4)
        known = self._known
        transition = model.transition(
            block[:, 0], quats[:-1] + quats[1:], gyr, block[:, 4:7] - known[model.ACC_BIAS], mag
        )
        known[model.VEL] += transition.velocity
        self._lost_speed += self._excess_speed()
        noise = model.process_noise(self._noise_density, self._block_s, self._lost_angle, self._lost_speed)
        self._rest.update(self._block_s, block[:, 1:7], known[model.BIAS], float(self.state.bias_sigma.max()))
        kalman.predict(F=transition.matrix, Q=noise)
        mean_field = transition.field / self._fields if self._fields else None
        self._field_age_s += self._block_s
        states, errors, variances = self._measure(mean_field, gyr)
        kalman.dim_z = len(states)  # filterpy 1.4.5 compares it with the measurement
        kalman.update(np.array(errors), R=np.diag(variances), H=model.IDENTITY[states])
        kalman.P = 0.5 * (kalman.P + kalman.P.T)
        self._correct_state(kalman.x)
        self._record_step(row, transition.matrix, kalman.P_prior, kalman.x)
        kalman.x = _NO_ERROR
        self._begin_block()
        if mean_field is not None and not self._has_heading:
            self._find_north(mean_field, row)
        self._publish()

    def _excess_speed(self) -> float:
        """Return the speed if the body can hardly have it, else 0, m/s."""
        speed = hypot(*self._known[model.VEL].tolist())
        if speed < self._settings.vel_limit:
            return 0.0
        sigma = sqrt(self._kalman.P.reshape(-1)[model.DIAGONAL][model.VEL].max())
        return speed if speed > self._settings.vel_limit + 3.0 * sigma else 0.0

    def _measure(self, field: Array | None, gyr: Array) -> tuple[list[int], list[float], list[float]]:
        """Return the indices of the measured errors, their values and their variances.

        Args:
            field: (3,) mean field of the block in the inertial frame, if there was one.
            gyr: (N, 3) measured rates of the block, rad/s.
        """
        s, rest, known = self._settings, self._rest, self._known
        per_block = max(1.0, s.block_s / self._block_s)
        states, errors = [6, 7, 8], (-known[model.VEL]).tolist()
        if rest.rest:
            variances = [s.rest_vel**2 * per_block] * 3
            states += [3, 4, 5]
            gains = _EYE3 - known[model.SENSITIVITY].reshape(3, 3)
            errors += (gains @ rest.rate - known[model.BIAS]).tolist()
            variances += [(s.rest_rate**2 + rest.rate_sigma**2) * per_block] * 3
        else:
            variances = [s.vel**2 * max(1.0, s.vel_time / self._block_s)] * 3
        if field is not None and self._has_heading:
            tilt_var = 0.5 * float(self._kalman.P[0, 0] + self._kalman.P[1, 1])
            # A longer time without readings is a dropout, which tells nothing about the field.
            rates = gyr - known[model.BIAS]
            rate = float(np.sqrt(np.einsum("ni,ni->n", rates, rates)).mean())
            age_s = min(self._field_age_s, s.mag_lost_s)
            heading = self._reference.heading(field.tolist(), age_s, rate, tilt_var)
            self._field_age_s = 0.0
            if heading is not None:
                if self._reference.adopted:
                    # The new field's direction has nothing to do with the old one's.
                    self._kalman.P[model.HEADING, model.HEADING] += heading[0] ** 2
                    self._kalman.P_prior = self._kalman.P.copy()
                states.append(model.HEADING)
                errors.append(heading[0])
                variances.append(heading[1])
        return states, errors, variances

    def _correct_state(self, error: Array) -> None:
        """Add the errors (21,) to the state."""
        # A rotation about inertial axes is, reversed, one of the inverse about its own axes.
        w, x, y, z = self._quat
        turn = (-error[model.TURN]).tolist()
        w, x, y, z = rot.integrate_rotvec((w, -x, -y, -z), *turn)
        size = sqrt(w * w + x * x + y * y + z * z)
        self._quat = (w / size, -x / size, -y / size, -z / size)
        self._known = known = self._known + error
        known[model.TURN] = 0.0
        gains = _EYE3 - known[model.SENSITIVITY].reshape(3, 3)
        self._correction = (*gains.ravel().tolist(), *known[model.BIAS].tolist())

    def _publish(self) -> None:
        """Set the state that the filter shows."""
        sigma = np.sqrt(self._kalman.P.reshape(-1)[model.DIAGONAL][model.BIAS])
        disturbed = self._reference.disturbed and not self._magnetometer.lost
        self.state = FilterState(self._known[model.BIAS], sigma, self._rest.rest, disturbed)

    def _record_step(
        self, row: int, matrix: Array | None, predicted: Array, error: Array, turned: float = 0.0
    ) -> None:
        if self.on_step is not None:
            self.on_step(Step(row, matrix, predicted, error, self._kalman.P, self._known[model.BIAS], turned))


def _levelled(quat: Quat, acc: Sequence[float]) -> Quat:
    """Return an orientation (4,) after the shortest rotation that makes a force point up."""
    force = rot.quat_rotate(quat, acc)
    if np.linalg.norm(force) < _LEAST_FORCE:
        return quat
    try:
        rotation = rot.matrix_to_quat(rot.minimal_rotation(force, _UP))
    except ValueError:  # upside down: every rotation by 180 degrees is a shortest one
        rotation = np.array([0.0, 1.0, 0.0, 0.0])
    return _as_quat(rot.quat_multiply(rotation, quat))


def _as_quat(quat: Array) -> Quat:
    w, x, y, z = quat.tolist()
    return w, x, y, z
