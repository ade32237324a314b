"""Reading poses back from the CSV files that `edgepose.sinks.csv_file` writes."""

from __future__ import annotations

import csv
import sys
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError
from edgepose.rotations import euler_to_matrix, nearest_rotation, quat_to_matrix, rotvec_to_matrix
from edgepose.sinks.csv_file import FORMS, pose_columns
from edgepose.skeleton import JOINTS

Array = NDArray[np.float64]

MAX_LINE = 16_384
"""Characters; a true row has less than 4000, and a file without line breaks must not fill the memory."""


def read_poses_csv(path: str | Path) -> tuple[NDArray[np.int64], Array, list[str], Array]:
    """Poses of a CSV file in any of the representations, which is found from its header.

    Args:
        path: file to read; "-" is standard input.

    Returns:
        frames (T,), time_s (T,) on the source's clock, T status texts, (T, 24, 3, 3) local rotations.

    Raises:
        EdgeposeError: no such file, or not a file of poses; names the row, counted from 1 for the header.
    """
    if str(path) == "-":
        return _read(sys.stdin, "standard input")
    try:
        with Path(path).open(encoding="utf-8-sig", newline="") as file:
            return _read(file, str(path))
    except OSError as error:
        raise EdgeposeError(f"cannot read poses from {path}: {error.strerror or error}") from error


def _read(file: TextIO, name: str) -> tuple[NDArray[np.int64], Array, list[str], Array]:
    rows = csv.reader(_lines(file))
    try:
        form, columns = _recognise(next(rows, []), name)
        frames, times, status, numbers = _parse(rows, columns, name)
    except csv.Error as error:
        raise EdgeposeError(f"{name}, row {rows.line_num + 1}: {error}") from error
    except UnicodeDecodeError as error:
        raise EdgeposeError(f"{name} is not a text file: byte {error.start} is not UTF-8") from error
    width = len(FORMS[form])
    values = numbers[:, : len(JOINTS) * width].reshape(len(frames), len(JOINTS), width)
    return frames, times, status, _rotations(form, values, name)


def _lines(file: TextIO) -> Iterator[str]:
    while line := file.readline(MAX_LINE):
        if len(line) == MAX_LINE:
            raise csv.Error("the line is too long for a file of poses")
        yield line


def _recognise(header: list[str], name: str) -> tuple[str, int]:
    """Representation and number of columns that a header announces."""
    for form in FORMS:
        for std in (False, True):
            if header == pose_columns(form, std):
                return form, len(header)
    raise EdgeposeError(
        f"{name} is not a file of poses: its first line must be 'frame,time_s,status,pelvis_...' and name "
        "the 24 joints in SMPL order"
    )


def _parse(
    rows: Iterator[list[str]], columns: int, name: str
) -> tuple[NDArray[np.int64], Array, list[str], Array]:
    """Frames (T,), times (T,), status texts and all numbers after them (T, columns - 3)."""
    frames, times, status, numbers = array("q"), array("d"), list[str](), array("d")
    for number, row in enumerate(rows, start=2):
        if len(row) != columns:
            raise EdgeposeError(f"{name}, row {number}: {len(row)} columns, the header has {columns}")
        try:
            frame = int(row[0])
            times.append(float(row[1]))
            numbers.extend(map(float, row[3:]))
            if frames and frame <= frames[-1]:
                raise EdgeposeError(f"{name}, row {number}: frame {frame} comes after frame {frames[-1]}")
            frames.append(frame)
        except (ValueError, OverflowError) as error:
            raise EdgeposeError(f"{name}, row {number}: {error}") from error
        status.append(sys.intern(row[2]))
    if not frames:
        raise EdgeposeError(f"{name} has no poses, only a header")
    values = np.frombuffer(numbers).reshape(len(frames), -1)
    seconds = np.frombuffer(times)
    bad = ~(np.isfinite(seconds) & np.isfinite(values).all(axis=1))
    if bad.any():
        raise EdgeposeError(f"{name}, row {bad.argmax() + 2}: a number is infinite or not a number")
    return np.frombuffer(frames, np.int64), seconds, status, values


def _rotations(form: str, values: Array, name: str) -> Array:
    """Rotation matrices (T, 24, 3, 3) of the numbers (T, 24, n) of one representation."""
    if form == "axis-angle":
        return rotvec_to_matrix(values)
    if form == "euler":
        return euler_to_matrix(values, "zxy")
    if form == "quat":
        norms = np.linalg.norm(values, axis=-1, keepdims=True)
        _check(np.abs(norms[..., 0] - 1.0), name)
        return quat_to_matrix(values / norms)
    matrices = values.reshape(*values.shape[:-1], 3, 3)
    # Six written digits leave a matrix a little off a rotation; anything further is not one.
    nearest = nearest_rotation(matrices)
    _check(np.abs(matrices - nearest).max(axis=(-2, -1)), name)
    return nearest


def _check(error: Array, name: str) -> None:
    """Raise for the first row and joint whose numbers (T, 24) are far from a rotation's."""
    bad = error > 1e-3
    if bad.any():
        row, joint = np.argwhere(bad)[0]
        raise EdgeposeError(f"{name}, row {row + 2}: the numbers of {JOINTS[joint]} are not a rotation")
