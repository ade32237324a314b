"""Raw captures of a serial port on disk: its bytes as they came, and next to them when they came.

`walk.bin` holds nothing but the bytes. `walk.bin.times` is text: `# key: value` lines, then one line for each
piece that was read from the port, `time_s,end`: Unix time of its arrival, seconds, and the number of bytes in
walk.bin up to its end. A capture without times, of another program, is read as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from edgepose.errors import FileFormatError
from edgepose.formats.recordings.csv import metadata_lines

COLUMNS = "time_s,end"
"""Header of the times."""

_CHUNK = 1 << 16


class Piece(NamedTuple):
    """Bytes that came together.

    Attributes:
        arrival_s: Unix time, seconds; None where nobody noted it.
        data: the bytes.
    """

    arrival_s: float | None
    data: bytes


def times_path(path: Path) -> Path:
    """Where the arrival times of a capture are."""
    return path.with_name(path.name + ".times")


def times_header(metadata: Mapping[str, str]) -> str:
    """First lines of the arrival times."""
    return metadata_lines(metadata) + COLUMNS + "\n"


def times_row(arrival_s: float, end: int) -> str:
    """One line of the arrival times; the number is exact."""
    return f"{arrival_s!r},{end}\n"


def read_capture(path: Path) -> Iterator[Piece]:
    """All pieces of a capture.

    What was still on its way to the disk when the power went is missing from either file: bytes without a
    time get the last one, times without bytes are left out.

    Raises:
        FileFormatError: a file cannot be read, or the times are damaged before their last line.
    """
    try:
        with path.open("rb") as file:
            done = 0
            arrival_s: float | None = None
            for arrival_s, end in _read_times(times_path(path)):
                while done < end and (data := file.read(min(end - done, _CHUNK))):
                    done += len(data)
                    yield Piece(arrival_s, data)
            while data := file.read(_CHUNK):
                yield Piece(arrival_s, data)
    except OSError as error:
        raise FileFormatError(f"{error.filename or path}: cannot read it: {error.strerror}") from None


def _read_times(path: Path) -> Iterator[tuple[float, int]]:
    """Arrival and end of each piece, both never decreasing."""
    if not path.exists():
        return
    arrival_s, end = 0.0, 0
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, start=1):
            if line.startswith("#") or line == COLUMNS + "\n":
                continue
            if not line.endswith("\n"):
                return
            try:
                first, second = line.split(",")
                row = float(first), int(second)
            except ValueError:
                row = (-1.0, -1)
            if not (arrival_s <= row[0] < 1e11 and end <= row[1]):
                raise FileFormatError(
                    f"{path}: row {number} is damaged; delete the file to read the capture without its times"
                )
            arrival_s, end = row
            yield row
