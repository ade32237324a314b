"""Xsens recordings of TotalCapture (cvssp.org/data/totalcapture).

`NAME_Xsens_AuxFields.sensors`: the numbers of sensors and of frames, then for each frame its number from 1
and one line per sensor: name, quaternion w x y z to the inertial frame, acceleration with gravity in the
sensor's frame, and more; 60 Hz.
"""

from __future__ import annotations

from array import array
from functools import partial
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.errors import FileFormatError
from edgepose.formats.recordings.base import RecordingFormat
from edgepose.imu import GRAVITY, Recording, SensorData
from edgepose.placements import PLACEMENTS
from edgepose.rotations import tilt_deg

Array = NDArray[np.float64]

NAMES = ("L_LowArm", "R_LowArm", "L_LowLeg", "R_LowLeg", "Head", "Pelvis")
"""TotalCapture's names of the six placements, in their order."""

RATE = 60.0
"""Frames a second."""

MAX_FRAMES = 1_000_000
_NUMBERS = 7  # of each line: quaternion and acceleration; further numbers are ignored
_AT_REST = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, GRAVITY)
_LONGEST_LINE = 4096
_TILT_DEG = 30.0  # of a sensor's mean specific force over a take
_METADATA = {
    "rate": f"{RATE:g}",
    "frame": "Z up",
    "units": "s, m/s^2",
    "source": "TotalCapture",
}


def read_recording(path: Path) -> Recording:
    """Read the sensors of a file, as they were strapped on, without bad rows.

    Raises:
        FileFormatError: not such a file, or its inertial frame does not have Z up.
    """
    readings = read_sensors(path)
    orientation, force, measured = readings.orientation, readings.force, readings.measured
    quats = rot.matrix_to_quat(orientation)
    times = np.arange(len(quats)) / RATE
    sensors = {}
    for i, (name, placement) in enumerate(zip(NAMES, PLACEMENTS, strict=True)):
        rows = measured[:, i]
        if not rows.any():
            continue
        mean = (orientation[rows, i] @ force[rows, i, :, None]).mean(axis=0)[:, 0]
        if not tilt_deg(mean) < _TILT_DEG:
            raise FileFormatError(
                f"{path}: {name} measures gravity along {np.round(mean, 1).tolist()} instead of Z; "
                "the file does not have TotalCapture's layout"
            )
        sensors[placement] = SensorData(times[rows], quats[rows, i], force[rows, i])
    return Recording(sensors, _METADATA, readings.damage)


class Readings(NamedTuple):
    """Content of a file.

    Attributes:
        orientation: (T, 6, 3, 3) R_IS.
        force: (T, 6, 3) specific force in the sensors' frames, m/s^2.
        measured: (T, 6) whether both are good; elsewhere they are those of a sensor at rest.
        damage: one line on bad data; None if there is none.
    """

    orientation: Array
    force: Array
    measured: NDArray[np.bool_]
    damage: str | None


def read_sensors(path: Path) -> Readings:
    """Read the good data of a .sensors file.

    Raises:
        FileFormatError: not such a file.
    """
    rows, problems = array("d"), list[str]()
    try:
        with path.open(encoding="ascii", errors="replace") as file:
            lines = enumerate(iter(partial(file.readline, _LONGEST_LINE), ""), start=1)
            sensors, frames = _counts(path, next(lines, (1, ""))[1])
            for frame in range(1, frames + 1):
                number, line = next(lines, (0, ""))
                if line.strip() != str(frame):
                    problems.append(
                        f"line {number or 'at the end'}: expected frame {frame} of {frames}, "
                        f"found {line.strip()[:40]!r}"
                    )
                    break
                block = list(islice(lines, sensors))
                # The last line of a truncated file may lack digits.
                if (len(block) < sensors or frame < frames) and block and not block[-1][1].endswith("\n"):
                    block.pop()
                rows.extend(_frame(block, frame, problems).ravel())
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read: {error.strerror or error}") from error
    damage = None
    if problems:
        damage = f"{path}, {problems[0]}; {len(problems)} problems in all, the rest is good"
    values = np.frombuffer(rows).reshape(-1, len(NAMES), _NUMBERS)
    measured = ~np.isnan(values[..., 0])
    if not measured.any():
        raise FileFormatError(f"{path}, {problems[0]}")
    values = np.where(measured[..., None], values, _AT_REST)
    quats = values[..., :4] / np.linalg.norm(values[..., :4], axis=-1, keepdims=True)
    return Readings(rot.quat_to_matrix(quats), values[..., 4:], measured, damage)


def _frame(lines: list[tuple[int, str]], frame: int, problems: list[str]) -> Array:
    """Parse the rows (6, 7) of a frame's lines, NaN where missing; add problems to `problems`."""
    rows = np.full((len(NAMES), _NUMBERS), np.nan)
    missing = set(NAMES)
    for number, line in lines:
        name, *cells = line.split()[: 1 + _NUMBERS] or [""]
        if name not in NAMES:
            continue
        missing.discard(name)
        try:
            rows[NAMES.index(name)] = _row(cells)
        except ValueError:
            problems.append(f"line {number}: expected a unit quaternion and an acceleration of {name}")
    if missing:
        problems.append(f"frame {frame} has no {', '.join(name for name in NAMES if name in missing)}")
    return rows


def _counts(path: Path, line: str) -> tuple[int, int]:
    """Parse the numbers of sensors and of frames in a file's first line."""
    cells = line.split()
    if len(cells) == 2 and all(cell.isdecimal() and len(cell) < 9 for cell in cells):
        sensors, frames = map(int, cells)
        if len(NAMES) <= sensors <= 100 and 0 < frames <= MAX_FRAMES:
            return sensors, frames
    raise FileFormatError(
        f"{path}, line 1: expected the numbers of sensors and frames, found {line.strip()[:40]!r}"
    )


def _row(cells: list[str]) -> list[float]:
    """Parse the quaternion and acceleration of a line.

    Raises:
        ValueError: they are invalid.
    """
    row = [float(cell) for cell in cells]
    if len(row) != _NUMBERS or not np.abs(row).max() < 1e4 or not abs(np.linalg.norm(row[:4]) - 1.0) < 0.1:
        raise ValueError
    return row


FORMAT = RecordingFormat((".sensors",), lambda path, options: read_recording(path))
