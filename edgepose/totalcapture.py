"""TotalCapture's files of Xsens sensors (cvssp.org/data/totalcapture).

`NAME_Xsens_AuxFields.sensors`: the number of sensors and of frames, then for each frame its number from 1 and
a line a sensor: name, quaternion w x y z to the inertial frame, acceleration with gravity in the sensor's
frame, and more; 60 Hz.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.calibration.checks import tilt_deg
from edgepose.errors import EdgeposeError
from edgepose.placements import PLACEMENTS
from edgepose.recording import Recording, SensorData

Array = NDArray[np.float64]

NAMES = ("L_LowArm", "R_LowArm", "L_LowLeg", "R_LowLeg", "Head", "Pelvis")
"""TotalCapture's names of the six placements, in their order."""

RATE = 60.0
"""Frames a second."""

MAX_FRAMES = 1_000_000
_NUMBERS = 7  # of each line: quaternion and acceleration; AuxFields has more behind them
_LONGEST_LINE = 4096
_TILT_DEG = 30.0  # of what a sensor measures on average over a take
_METADATA = {
    "rate": f"{RATE:g}",
    "frame": "Z up",
    "units": "s, m/s^2",
    "source": "TotalCapture",
}


def read_recording(path: Path) -> Recording:
    """The six sensors of a file, as they were strapped on.

    Raises:
        EdgeposeError: not such a file, or its inertial frame has not Z up.
    """
    orientation, force = read_sensors(path)
    for name, mean in zip(NAMES, (orientation @ force[..., None]).mean(axis=0)[..., 0], strict=True):
        if not tilt_deg(mean) < _TILT_DEG:
            raise EdgeposeError(
                f"{path}: {name} measures gravity along {np.round(mean, 1).tolist()} and not along Z; "
                "the file is not laid out as TotalCapture's"
            )
    quats = rot.matrix_to_quat(orientation)
    times = np.arange(len(quats)) / RATE
    sensors = {name: SensorData(times, quats[:, i], force[:, i]) for i, name in enumerate(PLACEMENTS)}
    return Recording(sensors, _METADATA)


def read_sensors(path: Path) -> tuple[Array, Array]:
    """R_IS (T, 6, 3, 3) and specific force (T, 6, 3) in the sensors' frames of a .sensors file.

    Raises:
        EdgeposeError: not such a file; names the line.
    """
    try:
        with path.open(encoding="ascii", errors="replace") as file:
            lines = enumerate(iter(partial(file.readline, _LONGEST_LINE), ""), start=1)
            sensors, frames = _counts(path, next(lines, (1, ""))[1])
            values = np.empty((frames, len(NAMES), _NUMBERS))
            for frame in range(frames):
                number, line = next(lines, (0, ""))
                if line.strip() != str(frame + 1):
                    raise EdgeposeError(
                        f"{path}, line {number or 'at the end'}: expected frame {frame + 1} of {frames}, "
                        f"found {line.strip()[:40]!r}"
                    )
                found = {}
                for _ in range(sensors):
                    number, line = next(lines, (0, ""))
                    name, *cells = line.split()[: 1 + _NUMBERS] or [""]
                    if name in NAMES:
                        found[name] = _row(path, number, cells)
                if missing := [name for name in NAMES if name not in found]:
                    raise EdgeposeError(f"{path}: frame {frame + 1} has no {', '.join(missing)}")
                values[frame] = [found[name] for name in NAMES]
    except OSError as error:
        raise EdgeposeError(f"{path}: cannot be read: {error.strerror or error}") from error
    quats = values[..., :4]
    return rot.quat_to_matrix(quats / np.linalg.norm(quats, axis=-1, keepdims=True)), values[..., 4:]


def _counts(path: Path, line: str) -> tuple[int, int]:
    """Numbers of sensors and of frames in a file's first line."""
    cells = line.split()
    if len(cells) == 2 and all(cell.isdecimal() and len(cell) < 9 for cell in cells):
        sensors, frames = map(int, cells)
        if len(NAMES) <= sensors <= 100 and 0 < frames <= MAX_FRAMES:
            return sensors, frames
    raise EdgeposeError(
        f"{path}, line 1: expected the numbers of sensors and frames, found {line.strip()[:40]!r}"
    )


def _row(path: Path, number: int, cells: list[str]) -> list[float]:
    """Quaternion and acceleration of a line."""
    try:
        row = [float(cell) for cell in cells]
    except ValueError:
        row = []
    if len(row) != _NUMBERS or not np.abs(row).max() < 1e4 or not abs(np.linalg.norm(row[:4]) - 1.0) < 0.1:
        raise EdgeposeError(f"{path}, line {number}: expected a unit quaternion and an acceleration")
    return row
