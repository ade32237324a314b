"""VQF (Laidig and Seel, Information Fusion 91, 2023) as an alternative to the Kalman filter.

The `vqf` package has one fixed sampling time. It is measured over the first samples; after that a sample
counts for as many steps as fit into its interval, with its rate scaled so that the angle is that of the real
interval. If the sample rate changes after the first samples, VQF's time constants are off by the same factor.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from edgepose import rotations as rot
from edgepose.errors import EdgeposeError
from edgepose.orientation.sample_checks import MagnetometerMonitor, SampleChecker
from edgepose.orientation.sample_loop import FilterState, Quat, orient_arrays
from edgepose.orientation.settings import FilterSettings
from edgepose.orientation.types import Event, OrientationResult

_PERIOD_SAMPLES = 20  # over which the sampling time is measured
_FIRST_PERIOD_S = 0.01
_MAG_LOST, _RESTART = int(Event.MAG_LOST), int(Event.RESTART)

_Timed = tuple[float, Sequence[float], Sequence[float], Sequence[float] | None]  # interval, gyr, acc, mag


class VqfFilter:
    """VQF for one sensor, with its default parameters and the interface of `OrientationFilter`."""

    def __init__(self, settings: FilterSettings | None = None) -> None:
        """Create the filter; of the settings, only those of gaps, time stamps and dropouts are used.

        Raises:
            EdgeposeError: the vqf package is not installed.
        """
        try:
            from vqf import VQF
        except ImportError:
            raise EdgeposeError(
                "--filter vqf needs the vqf package: pip install 'edgepose[vqf]', or use --filter kalman"
            ) from None
        self._class: Any = VQF
        settings = settings or FilterSettings()
        self._checker = SampleChecker(settings)
        self._magnetometer = MagnetometerMonitor(settings)
        self._period_s = self._mag_period_s = _FIRST_PERIOD_S
        self._vqf = self._new_vqf()
        self._first_samples: list[_Timed] | None = []
        self._started = False
        self._heading = 0.0  # of VQF's frame without a magnetometer in that of the first sample
        self._quat: Quat = (1.0, 0.0, 0.0, 0.0)

    def update(
        self, time_s: ArrayLike, gyr: ArrayLike, acc: ArrayLike, mag: ArrayLike | None = None
    ) -> OrientationResult:
        """Return the orientations of the next samples; arguments as in `OrientationFilter.update`.

        Raises:
            ValueError: the shapes do not match.
        """
        return orient_arrays(self, time_s, gyr, acc, mag)

    def take(
        self, time_s: float, gyr: Sequence[float], acc: Sequence[float], mag: Sequence[float]
    ) -> tuple[Quat, int]:
        """Return the orientation of the next sample and its events; see `OrientationFilter.take`."""
        events, dt = self._checker.check(time_s, gyr, acc)
        if dt > 0.0:
            is_field = self._magnetometer.check(0.0 if dt == inf else dt, mag)
            if dt == inf:
                events |= _RESTART if self._started else 0
                self._restart()
                dt = self._period_s
            sample = (dt, gyr, acc, mag if is_field else None)
            self._feed(sample)
            self._measure_period(sample)
            if self._magnetometer.seen:
                quat = self._vqf.getQuat9D()
            else:
                quat = rot.quat_multiply(rot.quat_about_z(self._heading), self._vqf.getQuat6D())
            w, x, y, z = quat.tolist()
            self._quat = (w, x, y, z)
        return self._quat, events | _MAG_LOST if self._magnetometer.lost else events

    @property
    def state(self) -> FilterState:
        """The state after the last sample."""
        bias, sigma = self._vqf.getBiasEstimate()
        has_field = self._magnetometer.seen and not self._magnetometer.lost
        return FilterState(
            bias,
            np.full(3, sigma),
            self._vqf.getRestDetected(),
            has_field and self._vqf.getMagDistDetected(),
        )

    def _restart(self) -> None:
        """Start a new VQF, which takes the tilt from the next force but keeps the bias and the heading."""
        if self._started:
            bias = self._vqf.getBiasEstimate()
            self._vqf = self._new_vqf()
            self._vqf.setBiasEstimate(*bias)
            self._heading = float(rot.yaw_of_quat(self._quat))
            if self._first_samples is not None:
                self._first_samples = []  # the heading includes the earlier samples already
        self._started = True

    def _new_vqf(self) -> Any:
        return self._class(self._period_s, magTs=self._mag_period_s)

    def _feed(self, sample: _Timed) -> None:
        dt, gyr, acc, mag = sample
        steps = max(1, round(dt / self._period_s))
        rate = np.array(gyr) * (dt / (steps * self._period_s))
        force = np.array(acc)
        for _ in range(steps):
            self._vqf.update(rate, force)
        if mag is not None:
            self._vqf.updateMag(np.array(mag))

    def _measure_period(self, sample: _Timed) -> None:
        """Measure the sampling time over the first samples, then run these again with it."""
        if self._first_samples is None:
            return
        self._first_samples.append(sample)
        if len(self._first_samples) > _PERIOD_SAMPLES:
            first, *others = self._first_samples
            self._first_samples = None
            self._period_s = float(np.median([dt for dt, *_ in others]))
            fields = sum(mag is not None for *_, mag in others)
            self._mag_period_s = self._period_s * len(others) / max(fields, 1)
            self._vqf = self._new_vqf()
            for repeated in ((self._period_s, *first[1:]), *others):
                self._feed(repeated)
