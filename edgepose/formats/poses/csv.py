"""Poses from CSV files, in any of the representations of `edgepose run`."""

from __future__ import annotations

import csv
import sys
from array import array
from collections.abc import Callable, Iterator
from functools import partial
from io import BufferedReader
from itertools import islice
from pathlib import Path
from typing import TextIO, cast

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError, FileFormatError
from edgepose.formats.poses.base import LARGEST_TIME, PoseFormat, is_absurd
from edgepose.formats.poses.csv_columns import ROTATION_FORMATS, pose_columns
from edgepose.pose import PoseSequence, parse_status
from edgepose.rotations import euler_to_matrix, nearest_rotation, quat_to_matrix, rotvec_to_matrix
from edgepose.skeleton import JOINTS

Array = NDArray[np.float64]

MAX_LINE = 16_384
"""Longest line, characters; valid rows have fewer than 4000, and an endless line must not fill memory."""

BLOCK = 4096
"""Poses read from a CSV file at a time."""

_HEADER = b"frame,time_s,status,"


def read_csv(path: Path) -> tuple[PoseSequence, str | None]:
    """Read the poses before the first bad one, and the problem with that one; "-" is standard input."""
    blocks: list[PoseSequence] = []
    problem = None
    try:
        blocks.extend(read_blocks(path))  # keeps the blocks before an error
    except EdgeposeError as error:
        if not blocks:
            raise
        problem = str(error)
    return _concatenate(blocks), problem


def read_blocks(path: str | Path) -> Iterator[PoseSequence]:
    """Yield the poses of a CSV file in one or more blocks of up to `BLOCK`; "-" is standard input.

    The header shows which representation the file has.

    Raises:
        FileFormatError: no such file, or not a file of poses; names the row, where the header is row 1. All
            poses before that row have been yielded.
    """
    if str(path) == "-":
        yield from _read_rows(sys.stdin, "standard input")
        return
    try:
        # With "replace", a byte that is not text invalidates only its row.
        with Path(path).open(encoding="utf-8-sig", errors="replace", newline="") as file:
            yield from _read_rows(file, str(path))
    except OSError as error:
        raise FileFormatError(f"cannot read poses from {path}: {error.strerror or error}") from error


class _BadRowError(FileFormatError):
    """A row that is not a pose; `row` is its number, where the header is row 1."""

    def __init__(self, name: str, row: int, problem: str) -> None:
        super().__init__(f"{name}, row {row}: {problem}")
        self.row = row


def _read_rows(file: TextIO, name: str) -> Iterator[PoseSequence]:
    rows = csv.reader(_lines(file))
    first = 2
    last: tuple[int, float] | None = None
    try:
        form, std, moves = _recognise(next(rows, []), name)
        columns = len(pose_columns(form, std, moves))
        while block := list(islice(rows, BLOCK)):
            read = partial(
                _block, first=first, last=last, columns=columns, form=form, has_translation=moves, name=name
            )
            poses, error = _good_rows(block, first, read)
            if poses is not None:
                first, last = first + len(poses.frames), (int(poses.frames[-1]), float(poses.time_s[-1]))
                yield poses
            if error is not None:
                raise error
    except csv.Error as error:
        raise FileFormatError(f"{name}, row {rows.line_num + 1}: {error}") from error
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{name} is not a text file: byte {error.start} is not UTF-8") from error
    if last is None:
        raise FileFormatError(f"{name} has no poses, only a header")


def _good_rows(
    rows: list[list[str]], first: int, read: Callable[[list[list[str]]], PoseSequence]
) -> tuple[PoseSequence | None, EdgeposeError | None]:
    """Return the poses before the first bad row, and its problem; the first row has number `first`."""
    problem = None
    while rows:
        try:
            return read(rows), problem
        except _BadRowError as error:
            problem, rows = error, rows[: error.row - first]
    return None, problem


_TOO_LONG = "the line is too long for a file of poses"


def _lines(file: TextIO) -> Iterator[str]:
    while line := file.readline(MAX_LINE):
        if len(line) == MAX_LINE:
            yield _TOO_LONG  # a bad row; the rows before it stay valid
            return
        yield line


def _recognise(header: list[str], name: str) -> tuple[str, bool, bool]:
    """Return representation, whether there are standard deviations, and whether there is a translation."""
    for form in ROTATION_FORMATS:
        for std in (False, True):
            for moves in (False, True):
                if header == pose_columns(form, std, moves):
                    return form, std, moves
    if any("\ufffd" in column for column in header):
        raise FileFormatError(f"{name} is not a text file")
    raise FileFormatError(
        f"{name} is not a file of poses: its first line must be 'frame,time_s,status,pelvis_...' and name "
        "the 24 joints in SMPL order"
    )


def _block(
    rows: list[list[str]],
    first: int,
    last: tuple[int, float] | None,
    columns: int,
    form: str,
    has_translation: bool,
    name: str,
) -> PoseSequence:
    """Parse rows, starting with number `first`, that follow the frame number and time `last`."""
    frame_before, time_before = last or (None, -np.inf)
    frames, times, numbers = array("q"), array("d"), array("d")
    held, warming_up = list[frozenset[str]](), list[bool]()
    for number, row in enumerate(rows, start=first):
        if row == [_TOO_LONG]:
            raise _BadRowError(name, number, _TOO_LONG)
        if len(row) != columns:
            raise _BadRowError(name, number, f"{len(row)} columns, the header has {columns}")
        try:
            frame = int(row[0])
            times.append(float(row[1]))
            numbers.extend(map(float, row[3:]))
            frames.append(frame)
        except (ValueError, OverflowError) as error:
            raise _BadRowError(name, number, str(error)) from error
        if frame_before is not None and frame <= frame_before:
            raise _BadRowError(name, number, f"frame {frame} comes after frame {frame_before}")
        if times[-1] <= time_before:
            raise _BadRowError(name, number, f"time {row[1]} s is not after that of the row before")
        if not row[2].isprintable() or "," in row[2] or '"' in row[2]:
            raise _BadRowError(name, number, "the status has a comma, a quote or a line break in it")
        names, warm = parse_status(row[2])
        held.append(names)
        warming_up.append(warm)
        frame_before, time_before = frame, times[-1]
    values = np.frombuffer(numbers).reshape(len(frames), -1)
    seconds = np.frombuffer(times)
    numbered = np.frombuffer(frames, np.int64)
    bad = is_absurd(seconds, LARGEST_TIME) | is_absurd(numbered, LARGEST_TIME) | is_absurd(values).any(axis=1)
    if bad.any():
        problem = "a number is infinite or not a number, or far too large"
        raise _BadRowError(name, int(bad.argmax()) + first, problem)
    width = len(ROTATION_FORMATS[form])
    rotations, off = _rotations(
        form, values[:, : len(JOINTS) * width].reshape(len(frames), len(JOINTS), width)
    )
    if (off > 1e-3).any():
        at, joint = np.argwhere(off > 1e-3)[0].tolist()
        raise _BadRowError(name, at + first, f"the numbers of {JOINTS[joint]} are not a rotation")
    translation = values[:, -3:] if has_translation else None
    return PoseSequence(numbered, seconds, rotations, translation, held, warming_up)


def _rotations(form: str, values: Array) -> tuple[Array, Array]:
    """Convert numbers (T, 24, n) of one representation to matrices (T, 24, 3, 3).

    The second result (T, 24) is the deviation of the numbers from those of a rotation.
    """
    none = np.zeros(values.shape[:2])
    if form == "axis-angle":
        return rotvec_to_matrix(values), none
    if form == "euler":
        return euler_to_matrix(values, "zxy"), none
    if form == "quat":
        norms = np.linalg.norm(values, axis=-1, keepdims=True)
        return quat_to_matrix(values / np.where(norms > 0.0, norms, 1.0)), np.abs(norms[..., 0] - 1.0)
    matrices = values.reshape(*values.shape[:-1], 3, 3)
    # Six digits leave a matrix slightly off a rotation; anything further off is not a rotation.
    nearest = nearest_rotation(matrices)
    return nearest, np.abs(matrices - nearest).max(axis=(-2, -1))


def _concatenate(blocks: list[PoseSequence]) -> PoseSequence:
    translations = [block.translation for block in blocks if block.translation is not None]
    return PoseSequence(
        np.concatenate([block.frames for block in blocks]),
        np.concatenate([block.time_s for block in blocks]),
        np.concatenate([block.rotations for block in blocks]),
        np.concatenate(translations) if translations else None,
        [names for block in blocks for names in block.held],
        [warm for block in blocks for warm in block.warming_up],
    )


def holds_poses(path: Path) -> bool:
    """Return whether a file starts like a CSV file of poses; "-" is standard input, which stays unread."""
    try:
        if str(path) == "-":
            return _starts_as_poses(cast(BufferedReader, sys.stdin.buffer).peek(32))
        with path.open("rb") as file:
            return _starts_as_poses(file.read(32))
    except OSError:
        return False


def _starts_as_poses(start: bytes) -> bool:
    # A pipe may have delivered only a few bytes so far; recordings start with different ones.
    start = start.removeprefix(b"\xef\xbb\xbf").replace(b'"', b"")[: len(_HEADER)]
    return start != b"" and _HEADER.startswith(start)


FORMAT = PoseFormat((".csv",), read_csv, holds_poses)
