"""DIP's pickles: DIP-IMU, and TotalCapture with the SMPL poses that DIP's authors fitted.

DIP-IMU (dip.is.tue.mpg.de): `imu_ori` (T, 17, 3, 3) orientations of the bones and `imu_acc` (T, 17, 3)
accelerations without gravity in SMPL's frame, NaN where a packet was lost, `gt` (T, 72) SMPL poses; 60 Hz.
TotalCapture by DIP: the same for six sensors in `ori`, `acc` and `gt`. No code in a pickle is run.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.errors import FileFormatError
from edgepose.formats.recordings.base import RecordingFormat, iter_samples, recording_from_samples
from edgepose.imu import GRAVITY, Recording, SensorData
from edgepose.placements import PLACEMENTS
from edgepose.utils.safe_pickle import array_of, numbers, read_pickle

Array = NDArray[np.float64]

RATE = 60.0
"""Frames a second."""

_METADATA = {
    "rate": f"{RATE:g}",
    "frame": "Z up; a wearer at heading zero faces -Y",
    "units": "s, m/s^2",
    "source": "DIP-IMU: each sensor's frame is that of its bone",
}
_ADVICE = "which arrays do not need; it was not run. Use the file as downloaded from DIP's site"

_MAX_ACC = 1e4  # m/s^2
_MAX_ANGLE = 100.0  # rad
_MAX_OFF = 0.05  # largest difference of a matrix element from the nearest rotation's

# Keys of orientations and accelerations, number of sensors, and indices of ours in the order of PLACEMENTS.
_LAYOUTS = (
    ("imu_ori", "imu_acc", 17, (7, 8, 11, 12, 0, 2)),
    ("ori", "acc", 6, (2, 3, 0, 1, 4, 5)),
)


class DipTake(NamedTuple):
    """A take of DIP-IMU, or of TotalCapture as published by DIP's authors.

    Attributes:
        orientation: (T, 6, 3, 3) orientations of the bones R_TB.
        acceleration: (T, 6, 3) accelerations in T without gravity, m/s^2.
        measured: (T, 6) whether both were measured; elsewhere they are those of the nearest measured frame.
        pose: (T, 24, 3, 3) true local rotations.
    """

    orientation: Array
    acceleration: Array
    measured: NDArray[np.bool_]
    pose: Array


def read_dip(path: Path) -> DipTake:
    """Read a take from one of DIP's pickles.

    Raises:
        FileFormatError: not such a file.
    """
    content = _content(path)
    ori, acc = _layout(content, path)[:2]
    pose = _true_pose(content, path)
    orientation, acceleration = _sensors(content, path, len(pose))
    measured = np.ones((len(pose), len(PLACEMENTS)), bool)
    for i, name in enumerate(PLACEMENTS):
        for key, values in ((ori, orientation), (acc, acceleration)):
            measured[:, i] &= _fill(values[:, i], f"{path}: {name} in {key!r}")
    nearest = rot.nearest_rotation(orientation)
    worst = np.abs(nearest - orientation).max()
    if not worst < _MAX_OFF:
        raise FileFormatError(f"{path}: {ori!r} has matrices that are not rotations (off by {worst:.2g})")
    return DipTake(nearest, acceleration, measured, pose)


def read_recording(path: Path) -> Recording:
    """Read the sensors of a take, as if each had been strapped on with its axes along those of its bone.

    Lost samples are left out. The file does not need true poses.

    Raises:
        FileFormatError: not one of DIP's pickles.
    """
    orientation, acceleration = _sensors(_content(path), path)
    lost = np.isnan(orientation).any(axis=(-2, -1)) | np.isnan(acceleration).any(axis=-1)
    near = np.all(np.abs(orientation) < 2.0, axis=(-2, -1)) & np.all(np.abs(acceleration) < _MAX_ACC, axis=-1)
    rotations = rot.nearest_rotation(np.where(near[..., None, None], orientation, np.eye(3)))
    good = np.where(near, np.abs(rotations - orientation).max(axis=(-2, -1)) < _MAX_OFF, False)
    quats = rot.matrix_to_quat(rot.Z_UP_TO_T.T @ rotations)
    in_body = np.where(good[..., None], acceleration, 0.0) + np.array([0.0, GRAVITY, 0.0])
    force = (rot.transpose(rotations) @ in_body[..., None])[..., 0]
    times = np.arange(len(rotations)) / RATE
    sensors = {
        name: SensorData(times[rows], quats[rows, i], force[rows, i])
        for i, (name, rows) in enumerate(zip(PLACEMENTS, good.T, strict=True))
    }
    problems = [f"{path}: {name} was not measured" for name, data in sensors.items() if not len(data.time_s)]
    if bad := int((~good & ~lost).sum()):
        problems.append(f"{path}: {bad} samples left out that are not a rotation or not an acceleration")
    recording = recording_from_samples(iter_samples(Recording(sensors, {})), _METADATA, name=str(path))
    return recording._replace(damage="; ".join(problems) or None)


def read_true_pose(path: Path) -> Array:
    """Read the SMPL poses of one of DIP's pickles: local rotations (T, 24, 3, 3), joint 0 in SMPL's frame.

    Raises:
        FileFormatError: not such a file.
    """
    return _true_pose(_content(path), path)


def _true_pose(content: dict[Any, Any], path: Path) -> Array:
    """Convert a pickle's `gt` to local rotations (T, 24, 3, 3)."""
    if "gt" not in content:
        raise FileFormatError(f"{path}: has no 'gt', the true poses")
    pose = numbers(content["gt"], "gt", path)
    if pose.ndim != 2 or pose.shape[1] != 72 or not len(pose):
        raise FileFormatError(f"{path}: 'gt' is {pose.shape}, not (frames, 72) angles")
    angles = pose.astype(float)
    if (absurd := np.abs(angles).max(axis=1) > _MAX_ANGLE).any():
        raise FileFormatError(
            f"{path}: an angle in frame {absurd.argmax()} of 'gt' is more than {_MAX_ANGLE:g} rad; copy the "
            "file again"
        )
    return rot.rotvec_to_matrix(angles.reshape(-1, 24, 3))


def _content(path: Path) -> dict[Any, Any]:
    try:
        return read_pickle(path, "pickle of DIP-IMU", _ADVICE)
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read: {error.strerror or error}") from error


def _layout(content: dict[Any, Any], path: Path) -> tuple[str, str, int, tuple[int, ...]]:
    """Return the one of `_LAYOUTS` that a file has."""
    for layout in _LAYOUTS:
        if layout[0] in content and layout[1] in content:
            return layout
    raise FileFormatError(
        f"{path}: neither DIP-IMU (imu_ori, imu_acc, gt) nor DIP's TotalCapture (ori, acc, gt): it has "
        f"{', '.join(sorted(map(str, content))) or 'nothing'}"
    )


def _sensors(content: dict[Any, Any], path: Path, frames: int | None = None) -> tuple[Array, Array]:
    """Return orientations (T, 6, 3, 3) and accelerations (T, 6, 3) of a file, checked against `frames`."""
    ori, acc, count, ours = _layout(content, path)
    if frames is None:
        frames = len(np.atleast_1d(array_of(content[ori], ori, path)))
    found = []
    for key, size in ((ori, (3, 3)), (acc, (3,))):
        array, shape = array_of(content[key], key, path).astype(float), (frames, count, *size)
        # Some versions have each matrix as a row of nine.
        if array.shape[:2] != shape[:2] or array.size != np.prod(shape):
            raise FileFormatError(f"{path}: {key!r} is {array.shape}, but the rest of the file needs {shape}")
        found.append(array.reshape(shape)[:, list(ours)])
    return found[0], found[1]


def _fill(values: Array, name: str) -> NDArray[np.bool_]:
    """Replace rows (T, ...) that are not finite by the nearest good one; return which were finite (T,)."""
    finite = np.all(np.isfinite(values.reshape(len(values), -1)), axis=1)
    good = np.flatnonzero(finite)
    if not len(good):
        raise FileFormatError(f"{name}: no frame was measured")
    rows = np.arange(len(values))
    after = np.clip(np.searchsorted(good, rows), 0, len(good) - 1)
    before = np.clip(after - 1, 0, None)
    nearer = np.where(np.abs(good[after] - rows) < np.abs(rows - good[before]), good[after], good[before])
    values[:] = values[nearer]
    return finite


FORMAT = RecordingFormat((".pkl",), lambda path, options: read_recording(path))
