"""Sessions of x-io's software: a folder with one folder of CSV files for each sensor."""

from __future__ import annotations

import heapq
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from edgepose.errors import FileFormatError
from edgepose.formats.recordings.base import RecordingFormat, recording_from_samples
from edgepose.formats.tables import open_table
from edgepose.imu import ImuSample, Recording
from edgepose.placements import SENSORS
from edgepose.utils.similar_names import choices
from firmware_protocols.sample import Sample
from firmware_protocols.ximu3 import Ximu3Decoder

MAIN_FILE = "Inertial.csv"
"""The file by which a sensor's folder is recognised."""

_LETTERS = {"Inertial.csv": "I", "Magnetometer.csv": "M"}
_ORIENTATIONS = {"Quaternion.csv": "Q", "RotationMatrix.csv": "R", "EulerAngles.csv": "A"}
"""The first of these files that is there is read."""

_TIME = "Timestamp (us)"
_SERIAL_NUMBER = re.compile(r"(?<![0-9A-Za-z])[0-9A-Fa-f]{8}(?![0-9A-Za-z])")
_CHUNK = 1000  # lines

_METADATA = {
    "frame": "Z up, NWU",
    "units": "s, m/s^2, rad/s; mag in the device's own units",
    "source": "x-io CSV",
}


def is_sensor(folder: Path) -> bool:
    """Return whether a folder belongs to an x-io sensor."""
    return (folder / MAIN_FILE).exists()


def is_session(folder: Path) -> bool:
    """Return whether a folder contains folders of x-io sensors."""
    return any(folder.glob(f"*/{MAIN_FILE}"))


def read_session(folder: Path, ids: Mapping[int, str] | None = None) -> Recording:
    """Read the recording of a session, in the time of the sensors, whose clocks x-io's software synchronises.

    Args:
        folder: of the session.
        ids: placements by serial number. Without them, folder names contain the placement, such as
            "Left Lower Leg 64F61CB3 (UDP)".

    Raises:
        FileFormatError: no folder has a placement, two have the same one, or a file is of another kind.
    """
    folders = by_placement(folder, sorted(path.parent for path in folder.glob(f"*/{MAIN_FILE}")), ids)
    problems: list[str] = []
    rows = [
        sample
        for name, sensor_folder in folders.items()
        for sample in _samples(SENSORS.index(name), sensor_folder, problems)
    ]
    recording = recording_from_samples(rows, _METADATA, name=str(folder), salvage=True)
    if recording.damage:
        problems.append(recording.damage)
    return recording._replace(damage="; ".join(problems) or None)


def by_placement(folder: Path, sensors: Sequence[Path], ids: Mapping[int, str] | None) -> dict[str, Path]:
    """Sort the files or folders of a session's sensors by placement; leave out those without one.

    Raises:
        FileFormatError: none has a placement, or two have the same one.
    """
    result: dict[str, Path] = {}
    for sensor in sensors:
        placement = placement_of(sensor.name, ids)
        if placement is None:
            continue
        if placement in result:
            raise FileFormatError(
                f"{folder}: {result[placement].name!r} and {sensor.name!r} are both {placement}; rename one, "
                "or give each recording a folder of its own"
            )
        result[placement] = sensor
    if not sensors:
        raise FileFormatError(f"{folder}: no sensor in this folder")
    if not result:
        how = f"in the names of its {'folders' if sensors[0].is_dir() else 'files'}"
        how = how if ids is None else "with a serial number of --sensors"
        names = ", ".join(sensor.name for sensor in sensors)
        hint = choices(_words(sensors[0].name).strip("_"), SENSORS, "placements are")
        raise FileFormatError(f"{folder}: no placement {how} ({names}); {hint}")
    return result


def placement_of(name: str, ids: Mapping[int, str] | None) -> str | None:
    """Return the placement of a sensor by the name of its folder or file; None if it has none."""
    if ids is not None:
        numbers = [int(number, 16) for number in _SERIAL_NUMBER.findall(name)]
        return next((ids[number] for number in numbers if number in ids), None)
    return next((placement for placement in SENSORS if f"_{placement}_" in f"_{_words(name)}_"), None)


def _words(name: str) -> str:
    """Return the words of a name in small letters, joined by underscores."""
    return re.sub(r"[^a-z]+", "_", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower())


def _samples(index: int, folder: Path, problems: list[str]) -> Iterator[ImuSample]:
    """Yield the samples of a sensor; add problems of its files to `problems`.

    A line of a file is a message as the device sends it, but without the letter at its start.
    """
    decoder = Ximu3Decoder()
    orientation = [(name, letter) for name, letter in _ORIENTATIONS.items() if (folder / name).exists()]
    files = [
        _messages(folder / name, letter)
        for name, letter in [*_LETTERS.items(), *orientation[:1]]
        if (folder / name).exists()
    ]
    lines = (line for _, line in heapq.merge(*files))
    for data in _chunks(lines):
        yield from (_sample(index, s) for s in decoder.feed(data))
    yield from (_sample(index, s) for s in decoder.flush())
    if decoder.counters.bad:
        problems.append(f"{folder}: {decoder.counters.bad} bad rows left out")


def _sample(index: int, sample: Sample) -> ImuSample:
    assert sample.time_us is not None  # every message has one
    return ImuSample(index, sample.time_us * 1e-6, sample.quat, sample.acc, sample.gyr, sample.mag)


def _messages(path: Path, letter: str) -> Iterator[tuple[int, bytes]]:
    """Yield the time and message of each row; a row without a time has that of the row before."""
    time_us = 0
    try:
        with open_table(path, lambda names: names[0].startswith(_TIME), _TIME) as table:
            for row in table.rows:
                number = row.cells[0]
                time_us = int(number) if number.isdecimal() and len(number) < 20 else time_us
                # Without a line end digits may be missing; a message without numbers counts as bad.
                cells = row.cells if row.ended else []
                yield time_us, ",".join([letter, *cells]).encode() + b"\n"
    except OSError as error:
        raise FileFormatError(f"{path}: cannot read it: {error.strerror}") from None


def _chunks(lines: Iterable[bytes]) -> Iterator[bytes]:
    chunk: list[bytes] = []
    for line in lines:
        chunk.append(line)
        if len(chunk) == _CHUNK:
            yield b"".join(chunk)
            chunk = []
    yield b"".join(chunk)


FORMAT = RecordingFormat(
    (),
    lambda folder, options: read_session(folder, options.ids),
    is_folder=is_session,
    is_part=is_sensor,
    description="an x-io session",
)
