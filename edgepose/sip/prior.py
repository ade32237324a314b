"""Pose prior: mean, covariance and limits of the exponential coordinates of human poses (SIP 4.3)."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError
from edgepose.sip.kinematics import JOINT_COUNT
from edgepose.utils.durable_files import replace_file
from edgepose.utils.safe_npz import BROKEN, open_npz

Array = NDArray[np.float64]

SIZE = 3 * (JOINT_COUNT - 1)
"""Coordinates in the prior: all joints but the pelvis, whose rotation is the wearer's heading and tilt."""

LIMIT_PERCENTILES = (0.1, 99.9)
"""Percentiles of the coordinates that set the limits: motion capture has faults in single frames."""

_SPREAD = np.deg2rad(4.0)  # people move joints that motion capture leaves at rest, rad
_SLACK = np.deg2rad(5.0)  # beyond the percentiles, rad
_LARGEST = 100.0  # rad and rad^2


class Prior(NamedTuple):
    """Distribution of human poses without the pelvis; SMPL's joints 1 to 23, three coordinates each.

    Attributes:
        mean: (69,) rad.
        covariance: (69, 69) rad^2, positive definite.
        lower: (69,) lower limits of the coordinates, rad.
        upper: (69,) upper limits, rad.
        about: the data it was learned from, and their licence.
    """

    mean: Array
    covariance: Array
    lower: Array
    upper: Array
    about: str


def learn_prior(poses: Array, about: str) -> Prior:
    """Learn a prior from poses (N, 72), exponential coordinates in SMPL order.

    Raises:
        EdgeposeError: too few poses.
    """
    coordinates = np.asarray(poses, float)[:, 3:]
    if len(coordinates) < 10 * SIZE:
        raise EdgeposeError(f"{len(coordinates)} poses are too few for a prior: give at least {10 * SIZE}")
    covariance = np.cov(coordinates, rowvar=False) + _SPREAD**2 * np.eye(SIZE)
    lower, upper = np.percentile(coordinates, LIMIT_PERCENTILES, axis=0)
    return Prior(coordinates.mean(axis=0), covariance, lower - _SLACK, upper + _SLACK, about)


def save_prior(path: str | Path, prior: Prior, overwrite: bool = True) -> None:
    """Write a prior as npz in single precision.

    Raises:
        EdgeposeError: the file cannot be written.
    """
    numbers = {name: getattr(prior, name).astype(np.float32) for name in Prior._fields[:-1]}

    def write(part: Path) -> None:
        with part.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, about=np.array(prior.about), **numbers)

    replace_file(path, write, "the prior", overwrite=overwrite)


def load_prior(path: str | Path | None = None) -> Prior:
    """Load a prior that `save_prior` wrote; None means the shipped one.

    Raises:
        EdgeposeError: not such a file, or its numbers are not a prior.
    """
    source = resources.files("edgepose.sip").joinpath("prior.npz") if path is None else Path(path)
    try:
        with resources.as_file(source) as file, open_npz(file) as data:
            mean, covariance, lower, upper = (
                np.asarray(data[name], float) for name in ("mean", "covariance", "lower", "upper")
            )
            prior = Prior(mean, covariance, lower, upper, str(data["about"]))
    except (OSError, *BROKEN) as error:
        raise EdgeposeError(
            f"{path}: not a prior of poses ({error}); make one with edgepose learn-prior"
        ) from error
    for name, shape in zip(Prior._fields, ((SIZE,), (SIZE, SIZE), (SIZE,), (SIZE,)), strict=False):
        values = getattr(prior, name)
        if values.shape != shape or not (np.abs(values) < _LARGEST).all():
            raise EdgeposeError(f"{path}: {name!r} is not {shape} finite angles; make the prior again")
    if (prior.lower > prior.upper).any() or not np.allclose(prior.covariance, prior.covariance.T):
        raise EdgeposeError(f"{path}: limits or covariance contradict themselves; make the prior again")
    if np.linalg.eigvalsh(prior.covariance)[0] <= 0.0:
        raise EdgeposeError(f"{path}: the covariance is not positive definite; make the prior again")
    return prior
