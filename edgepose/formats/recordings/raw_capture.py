"""Raw captures of a serial port on disk: its bytes as they came, and a file with their arrival times.

`walk.bin` contains only the bytes. `walk.bin.times` is text: `# key: value` lines, then one line for each
piece that was read from the port, `time_s,end`: Unix time of its arrival, seconds, and the number of bytes in
walk.bin up to its end. A capture without times, from another program, can be read too.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from edgepose.errors import FileFormatError
from edgepose.formats.recordings.csv import metadata_lines

COLUMNS = "time_s,end"
"""Header of the times."""

_CHUNK = 1 << 16
_LONGEST_LINE, _MOST_ENTRIES = 1000, 100  # of the metadata


class Piece(NamedTuple):
    """Bytes that were read from the port together.

    Attributes:
        arrival_s: Unix time, seconds; None if unknown.
        data: the bytes.
    """

    arrival_s: float | None
    data: bytes


def times_path(path: Path) -> Path:
    """Return the path of a capture's arrival times."""
    return path.with_name(path.name + ".times")


def times_header(metadata: Mapping[str, str]) -> str:
    """Return the first lines of the file of arrival times."""
    return metadata_lines(metadata) + COLUMNS + "\n"


def times_row(arrival_s: float, end: int) -> str:
    """Format one line of the arrival times; the time keeps all its digits."""
    return f"{arrival_s!r},{end}\n"


def capture_metadata(path: Path) -> dict[str, str]:
    """Return the metadata of a capture; empty if it has no file of arrival times, or an unreadable one."""
    metadata: dict[str, str] = {}
    with contextlib.suppress(OSError), times_path(path).open(encoding="utf-8", errors="replace") as file:
        while (line := file.readline(_LONGEST_LINE)).startswith("#") and len(metadata) < _MOST_ENTRIES:
            key, _, value = line[1:].partition(":")
            metadata[key.strip()] = value.strip()
    return metadata


def read_capture(path: Path) -> Iterator[Piece]:
    """Yield all pieces of a capture.

    After a power failure the end of either file may be missing: bytes without a time get the last one, times
    without bytes are ignored.

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
    """Yield the arrival and end of each piece; neither ever decreases."""
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
