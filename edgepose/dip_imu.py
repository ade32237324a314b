"""DIP's pickles: DIP-IMU, and TotalCapture with the SMPL poses that DIP's authors fitted.

DIP-IMU (dip.is.tue.mpg.de): `imu_ori` (T, 17, 3, 3) orientations of the bones and `imu_acc` (T, 17, 3)
accelerations without gravity in SMPL's frame, NaN where a packet was lost, `gt` (T, 72) SMPL poses; 60 Hz.
TotalCapture by DIP: the same of six sensors in `ori`, `acc` and `gt`. No code in a pickle is run.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.calibration import GRAVITY
from edgepose.errors import EdgeposeError
from edgepose.pickles import array_of, numbers, read_pickle
from edgepose.placements import PLACEMENTS
from edgepose.recording import Recording, SensorData, from_samples, samples

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

# Key of orientations, key of accelerations, sensors in all, and among them ours in the order of PLACEMENTS.
_LAYOUTS = (
    ("imu_ori", "imu_acc", 17, (7, 8, 11, 12, 0, 2)),
    ("ori", "acc", 6, (2, 3, 0, 1, 4, 5)),
)


class DipTake(NamedTuple):
    """A take of DIP-IMU, or of TotalCapture as DIP's authors publish it.

    Attributes:
        orientation: (T, 6, 3, 3) orientations of the bones R_TB.
        acceleration: (T, 6, 3) accelerations in T without gravity, m/s^2.
        measured: (T, 6) where they were; elsewhere both are those of the nearest frame that was.
        pose: (T, 24, 3, 3) true local rotations.
    """

    orientation: Array
    acceleration: Array
    measured: NDArray[np.bool_]
    pose: Array


def read_dip(path: Path) -> DipTake:
    """The take in a pickle of DIP's.

    Raises:
        EdgeposeError: not such a file.
    """
    content = _content(path)
    layout = next((known for known in _LAYOUTS if known[0] in content and known[1] in content), None)
    if layout is None:
        raise EdgeposeError(
            f"{path}: neither DIP-IMU (imu_ori, imu_acc, gt) nor DIP's TotalCapture (ori, acc, gt): it has "
            f"{', '.join(sorted(map(str, content))) or 'nothing'}"
        )
    ori, acc, count, ours = layout
    pose = _true_pose(content, path)
    orientation = _sensors(content[ori], ori, (len(pose), count, 3, 3), path)[:, list(ours)]
    acceleration = _sensors(content[acc], acc, (len(pose), count, 3), path)[:, list(ours)]
    measured = np.ones((len(pose), len(PLACEMENTS)), bool)
    for i, name in enumerate(PLACEMENTS):
        for key, values in ((ori, orientation), (acc, acceleration)):
            measured[:, i] &= _fill(values[:, i], f"{path}: {name} in {key!r}")
    nearest = rot.nearest_rotation(orientation)
    worst = np.abs(nearest - orientation).max()
    if not worst < 0.05:
        raise EdgeposeError(f"{path}: {ori!r} holds matrices that are no rotations (off by {worst:.2g})")
    return DipTake(nearest, acceleration, measured, pose)


def read_recording(path: Path) -> Recording:
    """The sensors of a take, as if each had been strapped on with its axes along those of its bone.

    Samples that were lost are not there.

    Raises:
        EdgeposeError: not a pickle of DIP's.
    """
    take = read_dip(path)
    quats = rot.matrix_to_quat(rot.Z_UP_TO_T.T @ take.orientation)
    in_body = take.acceleration + np.array([0.0, GRAVITY, 0.0])
    force = (rot.transpose(take.orientation) @ in_body[..., None])[..., 0]
    times = np.arange(len(take.pose)) / RATE
    sensors = {
        name: SensorData(times[there], quats[there, i], force[there, i])
        for i, (name, there) in enumerate(zip(PLACEMENTS, take.measured.T, strict=True))
    }
    return from_samples(samples(Recording(sensors, {})), _METADATA, name=str(path), salvage=True)


def read_true_pose(path: Path) -> Array:
    """The SMPL pose in a pickle of DIP's: local rotations (T, 24, 3, 3), joint 0 in SMPL's frame.

    Raises:
        EdgeposeError: not such a file.
    """
    return _true_pose(_content(path), path)


def _true_pose(content: dict[Any, Any], path: Path) -> Array:
    """Local rotations (T, 24, 3, 3) of what a pickle has under `gt`."""
    if "gt" not in content:
        raise EdgeposeError(f"{path}: has no 'gt', the true poses")
    pose = numbers(content["gt"], "gt", path)
    if pose.ndim != 2 or pose.shape[1] != 72 or not len(pose) or np.abs(pose).max() > 100.0:
        raise EdgeposeError(f"{path}: 'gt' is {pose.shape} and not (frames, 72) angles")
    return rot.rotvec_to_matrix(pose.astype(float).reshape(-1, 24, 3))


def _content(path: Path) -> dict[Any, Any]:
    try:
        return read_pickle(path, "pickle of DIP-IMU", _ADVICE)
    except OSError as error:
        raise EdgeposeError(f"{path}: cannot be read: {error.strerror or error}") from error


def _sensors(value: Any, key: str, shape: tuple[int, ...], path: Path) -> Array:
    array = array_of(value, key, path).astype(float)
    # Some versions have each matrix as a row of nine.
    if array.shape[:2] != shape[:2] or array.size != np.prod(shape):
        raise EdgeposeError(f"{path}: {key!r} is {array.shape} and not {shape}, as 'gt' says")
    return array.reshape(shape)


def _fill(values: Array, what: str) -> NDArray[np.bool_]:
    """Put the nearest good row in place of rows (T, ...) that are not finite; which were (T,)."""
    finite = np.all(np.isfinite(values.reshape(len(values), -1)), axis=1)
    good = np.flatnonzero(finite)
    if not len(good):
        raise EdgeposeError(f"{what}: no frame was measured")
    rows = np.arange(len(values))
    after = np.clip(np.searchsorted(good, rows), 0, len(good) - 1)
    before = np.clip(after - 1, 0, None)
    nearer = np.where(np.abs(good[after] - rows) < np.abs(rows - good[before]), good[after], good[before])
    values[:] = values[nearer]
    return finite
