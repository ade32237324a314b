"""Poses from CSV files in any representation of `edgepose run`, even if another program rewrote them."""

from __future__ import annotations

import csv
import sys
from array import array
from collections.abc import Iterator, Sequence
from io import BufferedReader
from itertools import islice
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError, FileFormatError
from edgepose.formats.ledger import Ledger
from edgepose.formats.poses.base import LARGEST_TIME, PoseFormat, is_absurd
from edgepose.formats.poses.csv_columns import CONTACT, ROTATION_FORMATS, TRANSLATION, rotation_columns
from edgepose.formats.tables import Row, Table, encoding_of, name_of, open_table
from edgepose.pose import PoseSequence, parse_status
from edgepose.rotations import euler_to_matrix, nearest_rotation, quat_to_matrix, rotvec_to_matrix
from edgepose.skeleton import JOINTS

Array = NDArray[np.float64]

MAX_LINE = 16_384
"""Longest line, characters; valid rows have fewer than 8000, and an endless line must not fill memory."""

BLOCK = 4096
"""Poses read from a CSV file at a time."""

MOST_RADIANS = 2.0 * np.pi + 1e-3
"""Largest angle; larger ones are in degrees."""

_START = "frame,time_s,"
_START_BYTES = 128


def read_csv(path: Path) -> tuple[PoseSequence, str | None]:
    """Read the good poses, and one line on the bad rows; "-" is standard input."""
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

    The names of the columns show which representation the file has. Other columns are ignored.

    Raises:
        FileFormatError: no such file, not a file of poses, or some rows are bad, of which the first is named
            by its line. All good poses have been yielded before.
    """
    path = Path(path)
    name = name_of(path)
    ledger, parser = Ledger(name), None
    try:
        with open_table(
            path, {"frame", "time_s"}.issubset, "frame,time_s,status,pelvis_...", MAX_LINE
        ) as table:
            parser = _Parser(_columns(table), ledger)
            yield from filter(None, map(parser.block, _blocks(table.rows)))
    except FileFormatError as error:
        if parser is None:
            reason = str(error).removeprefix(f"{name}: ")
            raise FileFormatError(f"{name} is not a file of poses: {reason}") from None
        raise FileFormatError("; ".join(filter(None, [ledger.damage(), str(error)]))) from None
    except OSError as error:
        raise FileFormatError(f"cannot read poses from {path}: {error.strerror or error}") from error
    except csv.Error as error:
        raise FileFormatError(f"{name}: not a table: {error}") from error
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{name} is not a text file: byte {error.start} is not UTF-8") from error
    if damage := ledger.damage():
        raise FileFormatError(damage)
    if parser.empty:
        raise FileFormatError(f"{name} has no poses, only a header")


def _blocks(rows: Iterator[Row]) -> Iterator[list[Row]]:
    """Yield rows in lists of up to `BLOCK`; an error comes after the rows before it."""
    more = True
    while more:
        block: list[Row] = []
        try:
            block.extend(islice(rows, BLOCK))  # keeps the rows before an error
            more = len(block) == BLOCK
        finally:
            if block:
                yield block


class _Columns(NamedTuple):
    """Indices of the columns.

    Attributes:
        form: representation of the rotations, a key of `ROTATION_FORMATS`.
        width: number of columns.
        frame: frame number.
        time: time.
        status: status, if there is one.
        rotations: numbers of the 24 joints.
        translation: position of the pelvis, or none.
        contacts: probabilities of contact, or none.
    """

    form: str
    width: int
    frame: int
    time: int
    status: int | None
    rotations: list[int]
    translation: list[int]
    contacts: list[int]

    @property
    def numbers(self) -> list[int]:
        """All columns of numbers but frame and time."""
        return self.rotations + self.translation + self.contacts


def _columns(table: Table) -> _Columns:
    """Find the columns by their names.

    Raises:
        FileFormatError: some are missing.
    """
    at = {column: index for index, column in reversed(list(enumerate(table.names)))}
    for form in sorted(
        ROTATION_FORMATS, key=lambda form: -len(ROTATION_FORMATS[form])
    ):  # w x y z before x y z
        if at.keys() >= set(columns := rotation_columns(form)):
            translation, contacts = (
                [at[column] for column in group] if at.keys() >= set(group) else []
                for group in (TRANSLATION, CONTACT)
            )
            return _Columns(
                form,
                len(table.names),
                at["frame"],
                at["time_s"],
                at.get("status"),
                [at[column] for column in columns],
                translation,
                contacts,
            )
    raise FileFormatError(
        "the names of its columns must be frame, time_s, status, pelvis_..., for all 24 joints"
    )


class _Parser:
    """Parser of the rows of one file.

    Attributes:
        empty: whether no row was good.
    """

    def __init__(self, columns: _Columns, ledger: Ledger) -> None:
        """Start before the first row; bad rows go to the ledger."""
        self.empty = True
        self._columns, self._ledger = columns, ledger
        # Where translation and contacts begin in a row's numbers.
        self._starts = np.cumsum([len(columns.rotations), len(columns.translation)])
        self._frame: int | None = None  # of the row before
        self._time_s = -np.inf

    def block(self, rows: Sequence[Row]) -> PoseSequence | None:
        """Parse the next rows; None if no row is good."""
        numbers, frames, times, values = array("q"), array("q"), array("d"), array("d")
        held, warming_up = list[frozenset[str]](), list[bool]()
        for row in rows:
            try:
                frame, time_s, status, cells = self._parse(row.cells)
            except ValueError as error:
                self._ledger.leave_out(row.number, str(error))
                continue
            numbers.append(row.number)
            frames.append(frame)
            times.append(time_s)
            values.extend(cells)
            held.append(status[0])
            warming_up.append(status[1])
        table = np.frombuffer(values).reshape(len(frames), len(self._columns.numbers))
        good, rotations = self._rotations(np.frombuffer(numbers, np.int64), table)
        if not good.any():
            return None
        self.empty = False
        _, translation, contacts = np.split(table[good], self._starts, axis=1)
        return PoseSequence(
            np.frombuffer(frames, np.int64)[good],
            np.frombuffer(times)[good],
            rotations,
            translation if self._columns.translation else None,
            [names for names, keep in zip(held, good, strict=True) if keep],
            [warm for warm, keep in zip(warming_up, good, strict=True) if keep],
            contacts=contacts.astype(np.float32) if self._columns.contacts else None,
        )

    def _parse(self, cells: list[str]) -> tuple[int, float, tuple[frozenset[str], bool], list[float]]:
        """Parse a row to frame, time, status, and numbers of rotations, translation and contacts.

        Raises:
            ValueError: the problem with the row.
        """
        columns = self._columns
        if len(cells) != columns.width:
            raise ValueError(f"has {len(cells)} columns, the header has {columns.width}")
        time = cells[columns.time]
        try:
            frame, time_s = int(cells[columns.frame]), float(time)
            values = [float(cells[i]) for i in columns.numbers]
        except ValueError:
            raise ValueError("has a cell that is not a number") from None
        if not (abs(frame) <= LARGEST_TIME and abs(time_s) <= LARGEST_TIME):
            raise ValueError(_ABSURD)
        if self._frame is not None and frame <= self._frame:
            raise ValueError(f"has frame {frame} after frame {self._frame}; sort the rows by frame")
        if time_s == self._time_s:
            raise ValueError(f"has time {time} s as the row before; write times with more digits")
        if time_s < self._time_s:
            raise ValueError(f"has time {time} s, which is before that of the row before")
        status = "" if columns.status is None else cells[columns.status]
        if not status.isprintable() or "," in status or '"' in status:
            raise ValueError("has a comma, a quote or a line break in its status")
        self._frame, self._time_s = frame, time_s
        return frame, time_s, parse_status(status), values

    def _rotations(self, rows: NDArray[np.int64], values: Array) -> tuple[NDArray[np.bool_], Array]:
        """Return which rows (T,) are good, and the rotations (n, 24, 3, 3) of these; values (T, columns)."""
        good: NDArray[np.bool_] = ~np.any(is_absurd(values), axis=1)
        self._ledger.leave_out_unless(good, rows, _ABSURD)
        contacts = values[:, self._starts[1] :]
        probable = ~np.any((contacts < 0.0) | (contacts > 1.0), axis=1)
        self._ledger.leave_out_unless(probable | ~good, rows, _NO_CONTACT)
        good &= probable
        form = self._columns.form
        count = len(self._columns.rotations)
        numbers = values[good, :count].reshape(-1, len(JOINTS), len(ROTATION_FORMATS[form]))
        rotations, problems = _to_matrices(form, numbers)
        for row, joints in zip(rows[good].tolist(), problems.tolist(), strict=True):
            if any(joints):
                self._ledger.leave_out(row, _NO_ROTATION[form].format(JOINTS[joints.index(True)]))
        whole = ~problems.any(axis=1)
        good[good] = whole
        return good, rotations[whole]


_ABSURD = "has a number that is infinite, not a number, or far too large"
_NO_CONTACT = "has a contact that is not a probability from 0 to 1"
_NO_ROTATION = dict.fromkeys(ROTATION_FORMATS, "has numbers of {} that are not a rotation") | dict.fromkeys(
    ("axis-angle", "euler"),
    "has an angle of {} beyond a whole turn; angles must be in radians, not in degrees",
)


def _to_matrices(form: str, values: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Convert numbers (T, 24, n) to matrices (T, 24, 3, 3), and tell which (T, 24) are not rotations."""
    if form == "axis-angle":
        return rotvec_to_matrix(values), np.linalg.norm(values, axis=-1) > MOST_RADIANS
    if form == "euler":
        return euler_to_matrix(values, "zxy"), np.abs(values).max(axis=-1) > MOST_RADIANS
    if form == "quat":
        norms = np.linalg.norm(values, axis=-1, keepdims=True)
        return quat_to_matrix(values / np.where(norms > 0.0, norms, 1.0)), np.abs(norms[..., 0] - 1.0) > 1e-3
    matrices = values.reshape(*values.shape[:-1], 3, 3)
    # Six digits leave a matrix slightly off a rotation; anything further off is not a rotation.
    nearest = nearest_rotation(matrices)
    return nearest, np.abs(matrices - nearest).max(axis=(-2, -1)) > 1e-3


def _concatenate(blocks: list[PoseSequence]) -> PoseSequence:
    translations = [block.translation for block in blocks if block.translation is not None]
    contacts = [block.contacts for block in blocks if block.contacts is not None]
    return PoseSequence(
        np.concatenate([block.frames for block in blocks]),
        np.concatenate([block.time_s for block in blocks]),
        np.concatenate([block.rotations for block in blocks]),
        np.concatenate(translations) if translations else None,
        [names for block in blocks for names in block.held],
        [warm for block in blocks for warm in block.warming_up],
        contacts=np.concatenate(contacts) if contacts else None,
    )


def holds_poses(path: Path) -> bool:
    """Return whether a file starts like a CSV file of poses; "-" is standard input, which stays unread."""
    try:
        if str(path) == "-":
            start = cast(BufferedReader, sys.stdin.buffer).peek(_START_BYTES)[:_START_BYTES]
            return _starts_as_poses(start.decode(errors="replace"))
        with path.open(encoding=encoding_of(path), errors="replace") as file:
            return _starts_as_poses(file.read(_START_BYTES))
    except OSError:
        return False


def _starts_as_poses(start: str) -> bool:
    # A pipe may have delivered only a few bytes so far; recordings start with different ones.
    start = start.removeprefix("\ufeff").replace('"', "").replace(" ", "")
    if start[:4].lower() == "sep=":
        start = start.partition("\n")[2]
    for mark in "\t;|":
        start = start.replace(mark, ",")
    start = start.removeprefix(",")[: len(_START)]  # some programs number the rows
    return start != "" and _START.startswith(start)


FORMAT = PoseFormat((".csv",), read_csv, holds_poses)
