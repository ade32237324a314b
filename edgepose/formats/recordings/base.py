"""Base of all recording formats: checks of every sample, and conversion of samples to and from arrays.

Files are not trusted: data from `SampleTable` is finite and in time order, and its quaternions are of unit
length.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf, nan
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import FileFormatError
from edgepose.formats.ledger import Ledger
from edgepose.formats.registered import FileFormat
from edgepose.imu import ImuSample, Recording, SensorData
from edgepose.placements import SENSORS
from edgepose.utils.fault_messages import clock_restarted

Array = NDArray[np.float64]

QUANTITIES = {"quat": 4, "acc": 3, "gyr": 3, "mag": 3}
"""Size of each quantity of a sample, in the order of `ImuSample` and of `SensorData`."""

MAX_SAMPLES = 20_000_000
"""Largest number of samples that are read into memory: 9 hours of six sensors at 100 Hz."""

MAX_VALUE = 1e6
"""More than any sensor measures, in any of the units."""

_MAX_TIME_S = 1e11
_CHUNK = 4096
_RESTART_S = 1.0  # rows in the wrong order are nearer


class ReadOptions(NamedTuple):
    """Options for reading a recording; formats ignore those that do not apply.

    Attributes:
        names: sensors that may occur.
        salvage: leave bad rows out and report them in `Recording.damage` instead of raising. CSV and NPZ
            only: files of other programs are always salvaged.
        ids: placements by serial number, for formats that identify sensors by it.
    """

    names: Sequence[str] = SENSORS
    salvage: bool = False
    ids: Mapping[int, str] | None = None


@dataclass(frozen=True)
class RecordingFormat(FileFormat):
    """A format of recordings; the module of each format ends with its `FORMAT`.

    Attributes:
        read: reads a file, or folder, of the format. Raises EdgeposeError or OSError if nothing is usable.
        is_folder: whether a folder is a recording of the format; None if recordings are files.
        is_part: whether a file or folder holds one sensor of a recording that is a folder.
        description: what a recording of the format is called in messages.
    """

    read: Callable[[Path, ReadOptions], Recording]
    is_folder: Callable[[Path], bool] | None = None
    is_part: Callable[[Path], bool] | None = None
    description: str = "a recording"

    def fits(self, path: Path, folder: bool) -> bool:
        """Return whether a file is of the format by its ending, or a folder by its content."""
        if folder:
            return self.is_folder is not None and self.is_folder(path)
        return path.suffix.lower() in self.suffixes


def iter_samples(recording: Recording) -> Iterator[ImuSample]:
    """Iterate over all samples of a recording in time order."""
    streams = [_sensor_samples(SENSORS.index(name), data) for name, data in recording.sensors.items()]
    return heapq.merge(*streams, key=attrgetter("time_s"))


def recording_from_samples(
    rows: Iterable[ImuSample],
    metadata: Mapping[str, str] | None = None,
    *,
    name: str = "samples",
    salvage: bool = False,
) -> Recording:
    """Build a recording from samples, each sensor's in time order.

    Args:
        rows: the samples.
        metadata: of the recording.
        name: of their source, for messages.
        salvage: leave bad samples out and report them in `damage` instead of raising.

    Raises:
        FileFormatError: a sample has values that no sensor measures.
    """
    table = SampleTable(name, salvage)
    for number, sample in enumerate(rows, start=1):
        row = [sample.time_s]
        empty = 0
        for quantity, size in QUANTITIES.items():
            values = getattr(sample, quantity)
            row += (nan,) * size if values is None else values
            empty += size if values is None else 0
        table.add(SENSORS[sample.sensor], number, row, empty)
    return Recording(table.sensors(), dict(metadata or {}), table.damage())


def _sensor_samples(index: int, data: SensorData) -> Iterator[ImuSample]:
    for start in range(0, len(data.time_s), _CHUNK):
        rows = slice(start, start + _CHUNK)
        times = data.time_s[rows].tolist()
        # `v[0] == v[0]` is false for NaN.
        columns = [
            [None] * len(times)
            if q is None
            else [tuple(v) if v[0] == v[0] else None for v in q[rows].tolist()]
            for q in data[1:]
        ]
        for time_s, *quantities in zip(times, *columns, strict=True):
            yield ImuSample(index, time_s, *quantities)


def shorten(text: str) -> str:
    """Quote the beginning of a text from a file, for a message."""
    return repr(text.strip() if len(text) < 80 else text[:77] + "...")


class _RowClock:
    """The times of a sensor's rows, which start again if its clock does."""

    def __init__(self) -> None:
        """Start before the first row."""
        self._reached_s = self._last_s = -inf
        self._restarted = False

    def restarted(self, times: Array) -> NDArray[np.bool_]:
        """Return which of the next rows (n,) cannot be dated, since the clock restarted before them.

        Their times may reach and pass those before the restart, and are wrong all the same. A single row that
        goes back, with a row after it that does not go on from there, is no restart.
        """
        result = np.zeros(len(times), dtype=bool)
        reached = np.maximum.accumulate(np.concatenate([[self._reached_s], times]))
        if self._restarted or (times < reached[:-1] - _RESTART_S).any():
            for i, time_s in enumerate(times.tolist()):
                goes_on = self._restarted and abs(time_s - self._last_s) < _RESTART_S
                self._restarted = goes_on or time_s < self._reached_s - _RESTART_S
                result[i] = self._restarted
                self._reached_s = self._reached_s if self._restarted else max(self._reached_s, time_s)
                self._last_s = time_s
        elif len(times):
            self._reached_s, self._last_s = float(reached[-1]), float(times[-1])
        return result


class SampleTable:
    """Rows of numbers (time, then the quantities) by sensor, checked a block at a time.

    Attributes:
        count: number of good rows so far; rows of the last, unchecked blocks count as good.
    """

    def __init__(self, name: str, salvage: bool = False, names: Sequence[str] = SENSORS) -> None:
        """Create an empty table.

        Args:
            name: of the file, for messages.
            salvage: leave bad rows out instead of raising.
            names: sensors that may occur, in the order of the result.
        """
        self._name = name
        self._salvage = salvage
        self._names = names
        self._ledger = Ledger(name)
        self._rows: dict[str, list[list[float]]] = {}
        self._marks: dict[str, list[tuple[int, int]]] = {}  # row number and number of empty cells
        self._blocks: dict[str, list[Array]] = {}
        self._clocks: dict[str, _RowClock] = {}
        self._checked = 0
        self.count = 0

    def reject(self, number: int, problem: str) -> None:
        """Leave the row of this number out, which has a problem such as "has no time".

        Raises:
            FileFormatError: the table does not salvage.
        """
        if not self._salvage:
            raise FileFormatError(f"{self._name}: row {number} {problem}")
        self._ledger.leave_out(number, problem)

    def damage(self) -> str | None:
        """Return a message on rows that were left out; None if there are none."""
        return self._ledger.damage()

    def add(self, sensor: str, number: int, row: list[float], empty: int) -> None:
        """Add a row: its number in the file, 14 numbers, and how many of them are empty (NaN)."""
        rows = self._rows.setdefault(sensor, [])
        rows.append(row)
        self._marks.setdefault(sensor, []).append((number, empty))
        self.count += 1
        if len(rows) == _CHUNK:
            self._close(sensor)

    def add_block(self, sensor: str, numbers: NDArray[np.int_], rows: Array, empty: NDArray[np.int_]) -> None:
        """Add rows (n, 14) with their numbers in the file (n,) and counts of empty cells (n,).

        Raises:
            FileFormatError: a row has values that no sensor measures.
        """
        if not len(rows):
            return
        blocks = self._blocks.setdefault(sensor, [])
        before = blocks[-1][-1, 0] if blocks else -inf
        good = np.ones(len(rows), dtype=bool)

        def check(bad: Any, problem: str) -> None:
            for row in np.flatnonzero(bad & good):
                self.reject(int(numbers[row]), f"({sensor}) {problem}")
            good[bad] = False

        times, values = rows[:, 0], rows[:, 1:]
        check(np.isnan(times), "has no time")
        check(~(np.abs(times) < _MAX_TIME_S), "has a time too large for seconds; is it in milliseconds?")
        check(
            (np.abs(values) < MAX_VALUE).sum(axis=1) + empty != values.shape[1],
            "has a number that is NaN or absurd",
        )
        start = 0
        for name, size in QUANTITIES.items():
            measured = ~np.isnan(values[:, start : start + size])
            check(measured.any(axis=1) & ~measured.all(axis=1), f"has only a part of {name}")
            start += size
        norm = np.linalg.norm(values[:, :4], axis=1)
        check(np.abs(norm - 1.0) > 0.1, "has a quaternion that is not of unit length")
        back = np.zeros(len(rows), dtype=bool)
        back[good] = self._clocks.setdefault(sensor, _RowClock()).restarted(times[good])
        advice = f"{clock_restarted()}: split the recording there, or sort the rows by time_s"
        check(back, f"goes back in time by more than a second: {advice}")
        reached = np.maximum.accumulate(np.concatenate([[before], np.where(good, times, -inf)]))[:-1]
        check(good & (times < reached), "goes back in time; sort the rows by time_s")
        if not good.all():
            rows, norm = rows[good], norm[good]
        rows[:, 1:5] /= norm[:, None]
        if len(rows):
            blocks.append(rows)
        self._checked += len(rows)
        if self._checked > MAX_SAMPLES:
            raise FileFormatError(f"{self._name}: more than {MAX_SAMPLES} samples; split the recording")

    def sensors(self) -> dict[str, SensorData]:
        """Return all data by sensor, in the order of the names."""
        for sensor in self._rows:
            self._close(sensor)
        result = {}
        for sensor in self._names:
            blocks = self._blocks.get(sensor)
            if not blocks:
                continue
            rows = np.concatenate(blocks)
            quantities: list[Array | None] = []
            start = 1
            for size in QUANTITIES.values():
                part = rows[:, start : start + size]
                quantities.append(None if np.isnan(part).all() else part)
                start += size
            result[sensor] = SensorData(rows[:, 0], *quantities)
        return result

    def _close(self, sensor: str) -> None:
        rows, marks = self._rows[sensor], np.array(self._marks[sensor]).reshape(-1, 2)
        if rows:
            self.add_block(sensor, marks[:, 0], np.array(rows), marks[:, 1])
        self._rows[sensor], self._marks[sensor] = [], []
