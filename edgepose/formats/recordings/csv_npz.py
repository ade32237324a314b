"""IMU recordings on disk: CSV, one row a sample, and NPZ, one array a quantity.

Files are hostile until checked: what `read_recording` returns is finite, in time order and of unit length
where it must be.
"""

from __future__ import annotations

import csv
import heapq
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from math import inf, nan
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError
from edgepose.imu import ImuSample
from edgepose.placements import PLACEMENTS
from edgepose.utils.safe_npz import BROKEN, open_npz

Array = NDArray[np.float64]

COLUMNS = "time_s,sensor,qw,qx,qy,qz,ax,ay,az,gx,gy,gz,mx,my,mz"
"""Header of the CSV form."""

QUANTITIES = {"quat": 4, "acc": 3, "gyr": 3, "mag": 3}
"""Numbers in each quantity of a sample, in the order of the columns."""

MAX_SAMPLES = 20_000_000
"""Most samples that are read into memory: 9 hours of six sensors at 100 Hz."""

_WIDTH = COLUMNS.count(",") + 1
_MAX_LINE = 4096
_MAX_VALUE = 1e6  # no sensor measures more, in any of the units
_MAX_TIME_S = 1e11
_CHUNK = 4096


class SensorData(NamedTuple):
    """Samples of one sensor.

    Attributes:
        time_s: (N,) times, never decreasing, seconds.
        quat: (N, 4) unit quaternions w, x, y, z, sensor to inertial; None if not measured.
        acc: (N, 3) specific force, sensor frame, m/s^2; None if not measured.
        gyr: (N, 3) angular rate, sensor frame, rad/s; None if not measured.
        mag: (N, 3) magnetic field, sensor frame, uT; None if not measured.

    A row of NaN means not measured at that time (a magnetometer slower than the rest).
    """

    time_s: Array
    quat: Array | None = None
    acc: Array | None = None
    gyr: Array | None = None
    mag: Array | None = None


class Recording(NamedTuple):
    """What six sensors measured.

    Attributes:
        sensors: data by placement name, in the order of PLACEMENTS.
        metadata: rate, frame, units, placements and what else the file says about itself.
        damage: one line for the user if a part of the file is no good (file, row, what to do); the rest is
            here.
    """

    sensors: dict[str, SensorData]
    metadata: dict[str, str]
    damage: str | None = None


def read_recording(path: Path | str) -> Recording:
    """Recording of a .npz file, or of a CSV file of any other name; "-" is CSV on stdin.

    Raises:
        EdgeposeError: the file cannot be read, or holds anything else than a recording of all six sensors.
    """
    recording = _read(Path(path), salvage=False)
    missing = missing_sensors(recording)
    if missing:
        raise EdgeposeError(f"{path}: no samples of {', '.join(missing)}; a recording needs all six sensors")
    return recording


def salvage_recording(path: Path | str) -> Recording:
    """What is good in a recording, of any number of sensors: bad rows are left out, `damage` tells of them.

    Raises:
        EdgeposeError: the file cannot be read, or is no recording at all.
    """
    return _read(Path(path), salvage=True)


def read_sensors(path: Path | str, names: Sequence[str]) -> Recording:
    """Recording of any of the named sensors, as `read_recording` reads those of the six placements.

    Raises:
        EdgeposeError: the file cannot be read, or holds anything else than a recording of such sensors.
    """
    return _read(Path(path), salvage=False, names=names)


def missing_sensors(recording: Recording) -> list[str]:
    """Placements of which there is no sample."""
    return [name for name in PLACEMENTS if name not in recording.sensors]


def _read(path: Path, salvage: bool, names: Sequence[str] = PLACEMENTS) -> Recording:
    try:
        read = _read_npz if path.suffix.lower() == ".npz" else _read_csv
        return read(path, salvage, names)
    except (OSError, UnicodeDecodeError) as error:
        raise EdgeposeError(f"{path}: cannot read it: {getattr(error, 'strerror', None) or error}") from None


def samples(recording: Recording) -> Iterator[ImuSample]:
    """All samples of a recording in time order."""
    streams = [_sensor_samples(PLACEMENTS.index(name), data) for name, data in recording.sensors.items()]
    return heapq.merge(*streams, key=attrgetter("time_s"))


def from_samples(
    rows: Iterable[ImuSample],
    metadata: Mapping[str, str] | None = None,
    *,
    name: str = "samples",
    salvage: bool = False,
) -> Recording:
    """Recording of samples, each sensor's in time order.

    Args:
        rows: the samples.
        metadata: of the recording.
        name: where they are from, for messages.
        salvage: leave bad ones out and say so in `damage` instead of raising.

    Raises:
        EdgeposeError: there is something in them that no sensor measures.
    """
    table = _Table(name, salvage)
    for number, sample in enumerate(rows, start=1):
        row = [sample.time_s]
        empty = 0
        for quantity, size in QUANTITIES.items():
            values = getattr(sample, quantity)
            row += (nan,) * size if values is None else values
            empty += size if values is None else 0
        table.add(PLACEMENTS[sample.sensor], number, row, empty)
    return Recording(table.sensors(), dict(metadata or {}), table.damage())


def _sensor_samples(index: int, data: SensorData) -> Iterator[ImuSample]:
    for start in range(0, len(data.time_s), _CHUNK):
        rows = slice(start, start + _CHUNK)
        times = data.time_s[rows].tolist()
        # A number that is NaN differs from itself.
        columns = [
            [None] * len(times)
            if q is None
            else [tuple(v) if v[0] == v[0] else None for v in q[rows].tolist()]
            for q in data[1:]
        ]
        for time_s, *quantities in zip(times, *columns, strict=True):
            yield ImuSample(index, time_s, *quantities)


# --- CSV ----------------------------------------------------------------------------------------------------


def comments(metadata: Mapping[str, str]) -> str:
    """Metadata as lines `# key: value`."""
    # A line break would start a row of its own.
    return "".join("# " + " ".join(f"{key}: {value}".splitlines()) + "\n" for key, value in metadata.items())


def csv_header(metadata: Mapping[str, str]) -> str:
    """First lines of a CSV recording, up to its column names; nothing in them sets a terminal."""
    seen = {key: "".join(c if c.isprintable() else "?" for c in value) for key, value in metadata.items()}
    return comments(seen) + COLUMNS + "\n"


def csv_row(sample: ImuSample) -> str:
    """One line of a CSV recording: times to the microsecond, numbers to nine digits."""
    cells = [f"{sample.time_s:.6f}", PLACEMENTS[sample.sensor]]
    for quantity, size in ((sample.quat, 4), (sample.acc, 3), (sample.gyr, 3), (sample.mag, 3)):
        cells += [""] * size if quantity is None else [f"{v:.9g}" for v in quantity]
    return ",".join(cells) + "\n"


def write_csv(path: Path | str, recording: Recording) -> None:
    """Write a recording as CSV, all sensors merged in time order."""
    with Path(path).open("w", encoding="utf-8", newline="") as file:
        file.write(csv_header(recording.metadata))
        file.writelines(map(csv_row, samples(recording)))


def _read_csv(path: Path, salvage: bool, names: Sequence[str]) -> Recording:
    # Bytes that are no UTF-8 become a mark that is no number either.
    opened = (
        nullcontext(sys.stdin)
        if str(path) == "-"
        else path.open(encoding="utf-8-sig", errors="replace", newline="")
    )
    with opened as file:
        lines = _Lines(path, file)
        metadata = _read_metadata(path, lines)
        lines.unlimited = salvage
        table, cut = _read_rows(path, lines, salvage, names)
    sensors = table.sensors()  # checks the last rows
    return Recording(sensors, metadata, table.damage() or cut)


class _Lines:
    """Lines of a text file, counted, none longer than a recording's can be.

    Attributes:
        number: of the present line, from 1.
        line: the present line.
        unlimited: give a line that is too long in pieces instead of raising.
    """

    def __init__(self, path: Path, file: TextIO) -> None:
        self._path, self._file = path, file
        self.number = 0
        self.line = "\n"
        self.unlimited = False

    def __iter__(self) -> _Lines:
        return self

    def __next__(self) -> str:
        line = self._file.readline(_MAX_LINE)
        if not line:
            raise StopIteration
        self.number += not self.cut
        self.line = line
        if len(self.line) == _MAX_LINE and not self.unlimited:
            raise EdgeposeError(
                f"{self._path}: row {self.number} is longer than {_MAX_LINE} characters; is it a CSV file?"
            )
        return self.line

    @property
    def cut(self) -> bool:
        """Whether the present line is the last one and has no end."""
        return not self.line.endswith(("\n", "\r"))


def _read_metadata(path: Path, lines: _Lines) -> dict[str, str]:
    metadata: dict[str, str] = {}
    for line in lines:
        if not line.startswith("#"):
            header = line.strip().replace('"', "").replace(" ", "")
            if header == COLUMNS:
                return metadata
            raise EdgeposeError(
                f"{path}: row {lines.number} has the columns {_short(line)}; a recording has {COLUMNS}"
            )
        key, _, value = line[1:].partition(":")
        metadata[key.strip()] = value.strip()
    raise EdgeposeError(f"{path}: the file is empty; a recording starts with the columns {COLUMNS}")


def _read_rows(path: Path, lines: _Lines, salvage: bool, names: Sequence[str]) -> tuple[_Table, str | None]:
    """All rows, and what to say if the last one is cut off."""
    table = _Table(str(path), salvage, names)
    rows = csv.reader(lines, quoting=csv.QUOTE_NONE)
    while True:
        try:
            cells = next(rows, None)
            if cells is None:
                return table, None
            if cells:
                sensor, numbers = _parse_row(cells, lines.cut, names)
                table.add(sensor, lines.number, numbers, cells.count(""))
        except csv.Error as error:
            table.reject(f"row {lines.number}: {error}")
        except ValueError as error:
            # The pieces of a line that is too long have no end either.
            if not lines.cut or len(lines.line) == _MAX_LINE:
                table.reject(f"row {lines.number} {error}")
                continue
            return table, (
                f"{path}: row {lines.number} is cut off, {table.count} samples before it are good; "
                "delete that row or copy the file again"
            )


def _parse_row(cells: list[str], cut: bool, names: Sequence[str]) -> tuple[str, list[float]]:
    """Sensor and numbers (time first, NaN where empty) of a row; cut says that the row has no line end.

    Raises:
        ValueError: what is wrong with the row.
    """
    if len(cells) != _WIDTH:
        raise ValueError(f"has {len(cells)} columns and not {_WIDTH}")
    time_s, sensor, *rest = cells
    sensor = sensor.strip('"')  # some programs quote text; a quoted line break cannot be meant here
    if sensor not in names:
        raise ValueError(f"names an unknown sensor {_short(sensor)}; the names are {', '.join(names)}")
    if cut and (rest[-1] or rest[-2]):
        # Digits may be missing, which nobody can see.
        raise ValueError("has no line end")
    try:
        return sensor, [float(time_s), *[float(cell) if cell else nan for cell in rest]]
    except ValueError as error:
        raise ValueError(f"holds something that is no number ({_short(str(error))})") from None


def _short(text: str) -> str:
    return repr(text.strip() if len(text) < 80 else text[:77] + "...")


# --- NPZ ----------------------------------------------------------------------------------------------------


def write_npz(path: Path | str, recording: Recording) -> None:
    """Write a recording as NPZ, quantities as float32.

    Times are one array `t` where all sensors share them, else `<placement>_t`. `sparse` names the arrays in
    which a row of NaN means not measured.
    """
    arrays: dict[str, NDArray[Any]] = {}
    times = [data.time_s for data in recording.sensors.values()]
    shared = all(np.array_equal(times[0], other) for other in times[1:])
    if shared:
        arrays["t"] = times[0]
    for placement, data in recording.sensors.items():
        if not shared:
            arrays[f"{placement}_t"] = data.time_s
        for name, values in zip(QUANTITIES, data[1:], strict=True):
            if values is not None:
                arrays[f"{placement}_{name}"] = values.astype(np.float32)
    arrays["sparse"] = np.array([key for key, values in arrays.items() if np.isnan(values).any()], dtype=str)
    arrays["metadata"] = np.array([f"{key}: {value}" for key, value in recording.metadata.items()], dtype=str)
    # A file and not a name, to which numpy might add .npz.
    with Path(path).open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def _read_npz(path: Path, salvage: bool, names: Sequence[str]) -> Recording:
    try:
        arrays = _load_arrays(path, names)
    except BROKEN as error:
        raise EdgeposeError(
            f"{path}: not a whole NPZ file ({error}); what is left of a cut one cannot be read: copy it again"
        ) from None
    sparse = set(_lines_of(path, arrays, "sparse"))
    metadata = {}
    for line in _lines_of(path, arrays, "metadata"):
        key, _, value = line.partition(":")
        metadata[key.strip()] = value.strip()
    table = _Table(str(path), salvage, names)
    for placement in names:
        if any(f"{placement}_{name}" in arrays for name in QUANTITIES):
            _add_arrays(path, table, placement, arrays, sparse)
    return Recording(table.sensors(), metadata, table.damage())


def _load_arrays(path: Path, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Arrays of an NPZ file that belong to a recording."""
    result = {}
    with open_npz(path) as archive:
        for key in archive.files:
            placement, _, name = key.rpartition("_")
            is_sensor = name in QUANTITIES or (name == "t" and placement)
            if is_sensor and placement not in names:
                raise EdgeposeError(
                    f"{path}: {_short(key)} is of an unknown sensor; the names are {', '.join(names)}"
                )
            if is_sensor or key in ("t", "sparse", "metadata"):
                result[key] = archive[key]
    return result


def _lines_of(path: Path, arrays: Mapping[str, NDArray[Any]], key: str) -> list[str]:
    lines = arrays.get(key, np.array([], dtype=str))
    if lines.ndim != 1 or lines.dtype.kind != "U":
        raise EdgeposeError(f"{path}: {key!r} is not an array of strings")
    return [str(line) for line in lines]


def _add_arrays(
    path: Path, table: _Table, placement: str, arrays: Mapping[str, NDArray[Any]], sparse: set[str]
) -> None:
    key = f"{placement}_t" if f"{placement}_t" in arrays else "t"
    if key not in arrays:
        raise EdgeposeError(
            f"{path}: has no times of {placement}; they are in an array 't' or '{placement}_t'"
        )
    columns = [_numbers(path, arrays, key, (arrays[key].size,))[:, None]]
    n = len(columns[0])
    empty = np.zeros(n, dtype=int)
    for name, size in QUANTITIES.items():
        key = f"{placement}_{name}"
        if key not in arrays:
            columns.append(np.full((n, size), nan))
            empty += size
            continue
        columns.append(_numbers(path, arrays, key, (n, size)))
        if key in sparse:
            empty += np.isnan(columns[-1]).sum(axis=1)
    table.add_block(placement, np.arange(n), np.hstack(columns), empty)


def _numbers(path: Path, arrays: Mapping[str, NDArray[Any]], key: str, shape: tuple[int, ...]) -> Array:
    array = arrays[key]
    if array.dtype.kind not in "fiu" or array.shape != shape:
        raise EdgeposeError(f"{path}: {key!r} is {array.dtype} {array.shape} and not numbers {shape}")
    return array.astype(np.float64)


# --- checks -------------------------------------------------------------------------------------------------


class _Table:
    """Rows of numbers (time, then the quantities) by sensor, checked a block at a time.

    Attributes:
        count: good rows so far, save those of the last, unchecked blocks that turn out bad.
    """

    def __init__(self, name: str, salvage: bool = False, names: Sequence[str] = PLACEMENTS) -> None:
        self._name = name
        self._salvage = salvage
        self._names = names
        self._left_out = 0
        self._problem = ""  # of the first row left out
        self._rows: dict[str, list[list[float]]] = {}
        self._marks: dict[str, list[tuple[int, int]]] = {}  # number and empty cells of each of these rows
        self._blocks: dict[str, list[Array]] = {}
        self._checked = 0
        self.count = 0

    def reject(self, problem: str) -> None:
        """Leave a row out.

        Raises:
            EdgeposeError: nothing is to be left out.
        """
        if not self._salvage:
            raise EdgeposeError(f"{self._name}: {problem}")
        self._problem = self._problem or problem
        self._left_out += 1

    def damage(self) -> str | None:
        """What to say of rows that were left out."""
        if not self._left_out:
            return None
        return f"{self._name}: {self._left_out} bad rows left out, the first: {self._problem}"

    def add(self, sensor: str, number: int, row: list[float], empty: int) -> None:
        """Take one row: its number in the file, 14 numbers, how many of them are empty (NaN)."""
        rows = self._rows.setdefault(sensor, [])
        rows.append(row)
        self._marks.setdefault(sensor, []).append((number, empty))
        self.count += 1
        if len(rows) == _CHUNK:
            self._close(sensor)

    def add_block(self, sensor: str, numbers: NDArray[np.int_], rows: Array, empty: NDArray[np.int_]) -> None:
        """Take rows (n, 14) with their numbers (n,) and counts of empty cells (n,).

        Raises:
            EdgeposeError: there is something in them that no sensor measures.
        """
        if not len(rows):
            return
        blocks = self._blocks.setdefault(sensor, [])
        before = blocks[-1][-1, 0] if blocks else -inf
        good = np.ones(len(rows), dtype=bool)

        def check(bad: Any, problem: str) -> None:
            for row in np.flatnonzero(bad & good):
                self.reject(f"row {numbers[row]}: {sensor} {problem}")
            good[bad] = False

        times, values = rows[:, 0], rows[:, 1:]
        check(~(np.abs(times) < _MAX_TIME_S), "has no time")
        check(
            (np.abs(values) < _MAX_VALUE).sum(axis=1) + empty != values.shape[1],
            "has a number that is NaN or absurd",
        )
        start = 0
        for name, size in QUANTITIES.items():
            there = ~np.isnan(values[:, start : start + size])
            check(there.any(axis=1) & ~there.all(axis=1), f"has only a part of {name}")
            start += size
        norm = np.linalg.norm(values[:, :4], axis=1)
        check(np.abs(norm - 1.0) > 0.1, "has a quaternion that is not of unit length")
        reached = np.maximum.accumulate(np.concatenate([[before], np.where(good, times, -inf)]))[:-1]
        check(good & (times < reached), "goes back in time; sort the rows by time_s")
        if not good.all():
            rows, norm = rows[good], norm[good]
        rows[:, 1:5] /= norm[:, None]
        if len(rows):
            blocks.append(rows)
        self._checked += len(rows)
        if self._checked > MAX_SAMPLES:
            raise EdgeposeError(f"{self._name}: more than {MAX_SAMPLES} samples; split the recording")

    def sensors(self) -> dict[str, SensorData]:
        """All data by sensor, in the order of the names."""
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
