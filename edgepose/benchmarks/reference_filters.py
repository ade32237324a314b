"""Filters compared by `edgepose bench orientation`: ours, and other packages' where installed."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.benchmarks.broad import Trial
from edgepose.orientation.filter import OrientationFilter
from edgepose.orientation.smoother import smooth
from firmware_protocols.sample import STANDARD_G

Array = NDArray[np.float64]


class ReferenceFilter(NamedTuple):
    """A filter in the comparison.

    Attributes:
        name: for the table.
        offline: it sees the whole recording.
        run: returns orientations (N, 4), X east, Y north, Z up, of a trial, with or without its magnetometer.
    """

    name: str
    offline: bool
    run: Callable[[Trial, bool], Array]


def contenders() -> list[ReferenceFilter]:
    """Return the filters whose packages are installed."""
    result = [
        ReferenceFilter("edgepose", False, _kalman),
        ReferenceFilter("edgepose smoother", True, _smoother),
    ]
    if find_spec("vqf"):
        result += [ReferenceFilter("vqf", False, _vqf), ReferenceFilter("offlineVQF", True, _offline_vqf)]
    if find_spec("imufusion"):
        result.append(ReferenceFilter("imufusion", False, _imufusion))
    if find_spec("ahrs"):
        result += [
            ReferenceFilter("ahrs Madgwick", False, _madgwick),
            ReferenceFilter("ahrs Mahony", False, _mahony),
        ]
    return result


def _kalman(trial: Trial, magnetometer: bool) -> Array:
    return OrientationFilter().update(*_inputs(trial, magnetometer)).quat


def _smoother(trial: Trial, magnetometer: bool) -> Array:
    return smooth(*_inputs(trial, magnetometer)).quat


def _inputs(trial: Trial, magnetometer: bool) -> tuple[Array, Array, Array, Array | None]:
    return trial.time_s, trial.gyr, trial.acc, trial.mag if magnetometer else None


def _vqf(trial: Trial, magnetometer: bool) -> Array:
    """Run VQF with its default parameters."""
    from vqf import VQF

    mag = trial.mag if magnetometer else None
    result: Array = VQF(1.0 / trial.rate).updateBatch(trial.gyr, trial.acc, mag)[_vqf_key(magnetometer)]
    return result


def _offline_vqf(trial: Trial, magnetometer: bool) -> Array:
    """Run the offline version of VQF with its default parameters."""
    from vqf import offlineVQF

    mag = trial.mag if magnetometer else None
    result: Array = offlineVQF(trial.gyr, trial.acc, mag, 1.0 / trial.rate)[_vqf_key(magnetometer)]
    return result


def _vqf_key(magnetometer: bool) -> str:
    return "quat9D" if magnetometer else "quat6D"


def _imufusion(trial: Trial, magnetometer: bool) -> Array:
    """Run imufusion with its bias estimation, and the best of a small grid of gains and rejections."""
    import imufusion

    settings = imufusion.AhrsSettings()
    settings.convention = imufusion.CONVENTION_ENU
    settings.sample_rate = trial.rate
    settings.gain = 0.1
    settings.acceleration_rejection = settings.magnetic_rejection = 90.0  # degrees
    filter = imufusion.Ahrs()
    filter.set_settings(settings)
    bias_settings = imufusion.BiasSettings()
    bias_settings.sample_rate = trial.rate
    bias = imufusion.Bias()
    bias.set_settings(bias_settings)
    rates, forces = np.rad2deg(trial.gyr), trial.acc / STANDARD_G
    result = np.empty((len(rates), 4))
    for i, (rate, force, field) in enumerate(zip(rates, forces, trial.mag, strict=True)):
        rate = bias.update(rate)
        if magnetometer:
            filter.update(rate, force, field)
        else:
            filter.update_no_magnetometer(rate, force)
        result[i] = filter.get_quaternion()
    return result


def _madgwick(trial: Trial, magnetometer: bool) -> Array:
    """Run Madgwick's filter with the gain that BROAD found best over all its trials."""
    from ahrs.filters import Madgwick

    mag = {"mag": trial.mag} if magnetometer else {}
    quat = Madgwick(gyr=trial.gyr, acc=trial.acc, **mag, frequency=trial.rate, gain=0.12).Q
    # Its X axis points north.
    return rot.quat_multiply(rot.quat_about_z(np.pi / 2.0), quat)


def _mahony(trial: Trial, magnetometer: bool) -> Array:
    """Run Mahony's filter with the gains that BROAD found best over all its trials."""
    from ahrs.filters import Mahony

    mag = {"mag": trial.mag} if magnetometer else {}
    result: Array = Mahony(gyr=trial.gyr, acc=trial.acc, **mag, frequency=trial.rate, k_P=0.74, k_I=0.0012).Q
    return result
