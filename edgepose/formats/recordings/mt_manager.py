"""Sessions of Xsens' MT Manager: a folder with one text file for each sensor.

A file has lines `// key: value`, one of them the update rate, then named columns, separated by tabs or
commas. Sensors of one session share a packet counter of 16 bits.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from itertools import islice
from math import isfinite
from pathlib import Path

from edgepose.errors import FileFormatError
from edgepose.formats.recordings.base import RecordingFormat, recording_from_samples
from edgepose.formats.recordings.xio_session import by_placement
from edgepose.imu import ImuSample, Recording
from edgepose.placements import PLACEMENTS

_COUNTER = "PacketCounter"
_QUANTITIES = {
    "quat": ("Quat_q0", "Quat_q1", "Quat_q2", "Quat_q3"),
    "acc": ("Acc_X", "Acc_Y", "Acc_Z"),
    "gyr": ("Gyr_X", "Gyr_Y", "Gyr_Z"),
    "mag": ("Mag_X", "Mag_Y", "Mag_Z"),
}
_HEAD_LINES = 30
_MAX_LINE = 4096
_RATE = re.compile(r"Update Rate:\s*([0-9]+(?:\.[0-9]+)?)\s*Hz")

_METADATA = {
    "frame": "Z up",
    "units": "s, m/s^2, rad/s; mag in the device's own units",
    "source": "MT Manager text",
}


def is_session(folder: Path) -> bool:
    """Return whether a folder contains sensor files of MT Manager."""
    return any(_is_sensor(path) for path in folder.glob("*.txt"))


def _is_sensor(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            lines = iter(lambda: file.readline(_MAX_LINE), b"")
            return any(line.startswith(_COUNTER.encode()) for line in islice(lines, _HEAD_LINES))
    except OSError:
        return False


def read_session(folder: Path, ids: Mapping[int, str] | None = None) -> Recording:
    """Read the recording of a session; its time starts with the first packet.

    Args:
        folder: of the session.
        ids: placements by device id, which MT Manager puts at the end of file names. Without them, file names
            contain the placement, such as "left_lower_leg_00B4D7D3.txt".

    Raises:
        FileFormatError: no file has a placement, two have the same one, or a file is of another kind.
    """
    paths = by_placement(folder, sorted(path for path in folder.glob("*.txt") if _is_sensor(path)), ids)
    problems: list[str] = []
    rows: list[ImuSample] = []
    first = None
    for name, path in paths.items():
        rate, samples = _read(path, PLACEMENTS.index(name), problems)
        if samples:
            start = int(samples[0].time_s)
            first = start if first is None else first
            # Counters that are close may be on either side of a wrap.
            shift = (start - first + 0x8000) % 0x10000 - 0x8000 - start
            rows += [sample._replace(time_s=(sample.time_s + shift) / rate) for sample in samples]
    earliest = min((row.time_s for row in rows), default=0.0)
    rows = [row._replace(time_s=row.time_s - earliest) for row in rows]
    recording = recording_from_samples(rows, _METADATA, name=str(folder), salvage=True)
    problems += [recording.damage] if recording.damage else []
    return recording._replace(damage="; ".join(problems) or None)


def _read(path: Path, index: int, problems: list[str]) -> tuple[float, list[ImuSample]]:
    """Read packets a second, and samples whose time is the number of their packet."""
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            lines = iter(lambda: file.readline(_MAX_LINE), "")
            rate, names = _head(path, lines)
            missing = [name for name in _QUANTITIES["acc"] + _QUANTITIES["gyr"] if name not in names]
            if missing:
                raise FileFormatError(f"{path}: has no columns {', '.join(missing)}; export them too")
            samples, bad = _samples(lines, names, index)
    except OSError as error:
        raise FileFormatError(f"{path}: cannot read it: {error.strerror}") from None
    if bad:
        problems.append(f"{path}: {bad} bad rows left out")
    return rate, samples


def _head(path: Path, lines: Iterator[str]) -> tuple[float, list[str]]:
    """Read packets a second, and the names of the columns."""
    rate = None
    for line in islice(lines, _HEAD_LINES):
        found = _RATE.search(line)
        if found:
            rate = float(found[1])
        elif line.startswith(_COUNTER):
            if rate is None or not 0.1 < rate < 10_000.0:
                raise FileFormatError(f"{path}: no valid 'Update Rate: ... Hz' in its first lines")
            return rate, _cells(line)
    raise FileFormatError(f"{path}: no line of column names that starts with {_COUNTER}")


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in re.split(r"[\t,;]", line.strip("\n"))]


def _samples(lines: Iterator[str], names: list[str], index: int) -> tuple[list[ImuSample], int]:
    """Parse samples, and count bad rows; a quantity with an empty cell was not measured."""
    columns = {
        quantity: [names.index(name) for name in wanted]
        for quantity, wanted in _QUANTITIES.items()
        if all(name in names for name in wanted)
    }
    samples: list[ImuSample] = []
    bad = count = 0
    for line in lines:
        cells = _cells(line)
        try:
            if len(cells) != len(names) or not line.endswith("\n"):
                raise ValueError
            step = (int(cells[0]) - count) & 0xFFFF if samples else int(cells[0]) & 0xFFFF
            values = {
                quantity: tuple(float(cells[i]) for i in indices)
                for quantity, indices in columns.items()
                if all(cells[i] for i in indices)
            }
            if (samples and not 0 < step < 0x8000) or not all(
                isfinite(v) for t in values.values() for v in t
            ):
                raise ValueError
        except ValueError:
            bad += 1
            continue
        count = count + step if samples else step
        if values:
            samples.append(ImuSample(index, float(count), *(values.get(name) for name in _QUANTITIES)))  # type: ignore[arg-type]
    return samples, bad


FORMAT = RecordingFormat((), lambda folder, options: read_session(folder, options.ids), is_session)
