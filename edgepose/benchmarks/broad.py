"""BROAD, the benchmark of orientation filters by Laidig, Caruso, Cereatti and Seel: its trials and metrics.

Data 6(7):72, 2021, https://doi.org/10.3390/data6070072; the data is CC BY 4.0.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.base import MAX_VALUE
from edgepose.utils.safe_npz import BROKEN, open_npz

Array = NDArray[np.float64]

ENDINGS = (".mat", ".npz")
_COLUMNS = {"imu_gyr": 3, "imu_acc": 3, "imu_mag": 3, "opt_quat": 4}
_START_S = 1.0
_TOLERANCE = 0.1  # of the length of a quaternion


class Trial(NamedTuple):
    """One trial of BROAD.

    Attributes:
        name: of its file.
        rate: samples a second, Hz.
        gyr: (N, 3) rates, sensor frame, rad/s.
        acc: (N, 3) specific force, sensor frame, m/s^2.
        mag: (N, 3) magnetic field, sensor frame, uT.
        quat: (N, 4) true orientation from optical capture, sensor to inertial, X east, Y north, Z up; NaN
            where the cameras lost the sensor.
        movement: (N,) bool, the part that is evaluated.
    """

    name: str
    rate: float
    gyr: Array
    acc: Array
    mag: Array
    quat: Array
    movement: NDArray[np.bool_]

    @property
    def time_s(self) -> Array:
        """Times of the samples (N,), s."""
        return np.arange(len(self.gyr)) / self.rate

    @property
    def disturbed(self) -> bool:
        """Whether the trial has disturbances, as its name says."""
        return "_disturbed_" in self.name


class Errors(NamedTuple):
    """Root mean square errors of a trial, deg: of the whole angle, its part about the vertical, the rest."""

    total: float
    heading: float
    inclination: float


def find_trials(folder: Path) -> list[Path]:
    """Find the files of trials in a folder, sorted: BROAD's own `data_mat/*.mat`, or the same arrays as .npz.

    Raises:
        EdgeposeError: there is none.
    """
    files = [path for path in folder.glob("*") if path.suffix in ENDINGS] if folder.is_dir() else []
    if not files:
        raise EdgeposeError(
            f"{folder}: no trials of BROAD; --data is a folder of .mat files (its data_mat) or .npz files"
        )
    return sorted(files)


def read_trial(path: Path) -> Trial:
    """Read a trial.

    Raises:
        EdgeposeError: the file cannot be read, or is not a trial.
    """
    try:
        arrays = _load(path)
    except (OSError, *BROKEN) as error:
        raise EdgeposeError(f"{path}: cannot read it: {error}") from None
    missing = [key for key in (*_COLUMNS, "movement", "sampling_rate") if key not in arrays]
    if missing:
        raise EdgeposeError(f"{path}: not a trial of BROAD: it has no {', '.join(missing)}")
    count = len(np.atleast_1d(arrays["imu_gyr"]))
    numbers = {}
    for key, width in _COLUMNS.items():
        if arrays[key].dtype.kind not in "fiu" or arrays[key].shape != (count, width):
            raise EdgeposeError(
                f"{path}: {key!r} is {arrays[key].dtype} {arrays[key].shape}, not ({count}, {width})"
            )
        # Row after row in memory: some filters read the buffer directly.
        numbers[key] = np.ascontiguousarray(arrays[key], float)
        size = np.linalg.norm(np.clip(numbers[key], -MAX_VALUE, MAX_VALUE), axis=1)
        if key == "opt_quat":
            good = np.isnan(numbers[key]).any(axis=1) | (abs(size - 1.0) < _TOLERANCE)
        else:
            good = size < MAX_VALUE
        if not good.all():
            raise EdgeposeError(f"{path}: {key!r} has impossible values, the first in row {np.argmin(good)}")
    movement = np.asarray(arrays["movement"]).astype(bool)
    rate = float(np.asarray(arrays["sampling_rate"]).reshape(-1)[0])
    if movement.shape != (count,) or not 1.0 < rate < 1e5:
        raise EdgeposeError(f"{path}: 'movement' or 'sampling_rate' does not fit {count} samples")
    if not (movement & ~np.isnan(numbers["opt_quat"][:, 0])).any():
        raise EdgeposeError(f"{path}: has no movement with a known true orientation")
    return Trial(
        path.stem,
        rate,
        numbers["imu_gyr"],
        numbers["imu_acc"],
        numbers["imu_mag"],
        numbers["opt_quat"],
        movement,
    )


def _load(path: Path) -> dict[str, Any]:
    if path.suffix == ".npz":
        with open_npz(path) as archive:
            return dict(archive)
    try:
        from scipy.io import loadmat
    except ImportError:
        raise EdgeposeError(f"{path}: .mat files need scipy: pip install 'edgepose[export]'") from None
    return dict(loadmat(path, squeeze_me=True))


def trials(folder: Path) -> Iterator[Trial]:
    """Read all trials of a folder, one at a time.

    Raises:
        EdgeposeError: there is none, or one cannot be read.
    """
    yield from map(read_trial, find_trials(folder))


def errors(quat: Array, trial: Trial) -> Errors:
    """Compute BROAD's errors of orientations (N, 4): over movement, where the reference is known."""
    total, heading, inclination = (
        np.rad2deg(np.sqrt(np.nanmean(angle[trial.movement] ** 2)))
        for angle in error_angles(quat, trial.quat)
    )
    return Errors(float(total), float(heading), float(inclination))


def error_angles(quat: Array, reference: Array) -> tuple[Array, Array, Array]:
    """Return total, heading and inclination errors (N,) of orientations (N, 4), rad; NaN where unknown."""
    w, x, y, z = np.moveaxis(rot.quat_multiply(quat, rot.quat_conjugate(reference)), -1, 0)
    return (
        2.0 * np.arctan2(np.sqrt(x * x + y * y + z * z), np.abs(w)),
        2.0 * np.arctan2(np.abs(z), np.abs(w)),
        2.0 * np.arctan2(np.hypot(x, y), np.hypot(w, z)),
    )


def same_heading(quat: Array, trial: Trial) -> Array:
    """Align orientations (N, 4) with the reference's heading in the first second of motion.

    Without a magnetometer, the heading has an arbitrary origin.
    """
    moving = np.flatnonzero(trial.movement & ~np.isnan(trial.quat[:, 0]))
    start = moving[moving < moving[0] + _START_S * trial.rate]
    error = rot.yaw_of_quat(rot.quat_multiply(quat[start], rot.quat_conjugate(trial.quat[start])))
    return rot.quat_multiply(rot.quat_about_z(-np.angle(np.exp(1j * error).mean())), quat)
