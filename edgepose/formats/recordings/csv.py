"""Recordings as CSV, one row per sample.

Programs that have saved a recording again may have changed its separators, decimal points or encoding.
"""

from __future__ import annotations

import csv
import sys
import unicodedata
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from math import nan
from pathlib import Path
from typing import TextIO

from edgepose.errors import FileFormatError
from edgepose.formats.recordings.base import ReadOptions, RecordingFormat, SampleTable, iter_samples, shorten
from edgepose.formats.tables import COMMENTS, SEPARATORS, encoding_of, tidied
from edgepose.imu import ImuSample, Recording
from edgepose.placements import SENSORS
from edgepose.utils.counted_lines import MAX_LINE, CountedLines
from edgepose.utils.similar_names import choices

COLUMNS = "time_s,sensor,qw,qx,qy,qz,ax,ay,az,gx,gy,gz,mx,my,mz"
"""Header of the file."""

_WIDTH = COLUMNS.count(",") + 1


def metadata_lines(metadata: Mapping[str, str]) -> str:
    """Format metadata as lines `# key: value`; control characters become blanks or "?"."""
    return "".join(f"# {_one_line(f'{key}: {value}')}\n" for key, value in metadata.items())


def _one_line(text: str) -> str:
    """Replace line breaks, which would start a row, and control characters, which could reach a terminal."""
    line = " ".join(text.splitlines()).replace("\t", " ")
    return "".join("?" if unicodedata.category(character) == "Cc" else character for character in line)


def csv_header(metadata: Mapping[str, str]) -> str:
    """Return the first lines of a CSV recording, up to its column names."""
    return metadata_lines(metadata) + COLUMNS + "\n"


def csv_row(sample: ImuSample) -> str:
    """Format one line of a CSV recording: times to the microsecond, numbers to nine digits."""
    cells = [f"{sample.time_s:.6f}", SENSORS[sample.sensor]]
    for quantity, size in ((sample.quat, 4), (sample.acc, 3), (sample.gyr, 3), (sample.mag, 3)):
        cells += [""] * size if quantity is None else [f"{v:.9g}" for v in quantity]
    return ",".join(cells) + "\n"


def write_csv(path: Path | str, recording: Recording) -> None:
    """Write a recording as CSV, all sensors merged in time order."""
    with Path(path).open("w", encoding="utf-8", newline="") as file:
        file.write(csv_header(recording.metadata))
        file.writelines(map(csv_row, iter_samples(recording)))


def read_csv(path: Path, options: ReadOptions) -> Recording:
    """Read a CSV file; "-" is standard input."""
    # "replace" turns bytes that are not UTF-8 into a character that does not parse as a number.
    opened = (
        nullcontext(sys.stdin)
        if str(path) == "-"
        # A pipe can be read once only.
        else path.open(
            encoding=encoding_of(path) if path.is_file() else "utf-8-sig", errors="replace", newline=""
        )
    )
    with opened as file:
        lines = _Lines(path, file)
        metadata, separator = _read_head(path, lines)
        lines.unlimited = options.salvage
        table, cut = _read_rows(path, lines, separator, options)
    sensors = table.sensors()  # checks the last rows
    return Recording(sensors, metadata, table.damage() or cut)


class _Lines(CountedLines):
    """Lines of a recording.

    Attributes:
        unlimited: yield a line that is too long in pieces instead of raising.
    """

    def __init__(self, path: Path, file: TextIO) -> None:
        super().__init__(file)
        self._path = path
        self.unlimited = False

    def __next__(self) -> str:
        line = super().__next__()
        if self.too_long and not self.unlimited:
            raise FileFormatError(
                f"{self._path}: row {self.number} is longer than {MAX_LINE} characters; is it a CSV file?"
            )
        return line


def _read_head(path: Path, lines: _Lines) -> tuple[dict[str, str], str | None]:
    """Read all lines up to the names of the columns.

    Returns:
        Metadata, and the separator of the columns; None if the file is spelled as `write_csv` spells it.
    """
    metadata: dict[str, str] = {}
    for line in lines:
        if line.startswith("#"):
            key, _, value = line[1:].partition(":")
            metadata[key.strip()] = value.strip()
            continue
        if line.strip() == COLUMNS:
            return metadata, None
        for separator in SEPARATORS:
            if _is_header(tidied(line.split(separator), separator, _WIDTH)):
                return metadata, separator
        if line.strip(f' \r\n"{SEPARATORS}') and not line.startswith("sep="):
            raise FileFormatError(
                f"{path}: row {lines.number} has the columns {shorten(line)}; a recording has {COLUMNS}"
            )
    raise FileFormatError(f"{path}: the file is empty; a recording starts with the columns {COLUMNS}")


def _is_header(cells: Sequence[str]) -> bool:
    return [cell.strip(' "') for cell in cells] == COLUMNS.split(",")


def _read_rows(
    path: Path, lines: _Lines, separator: str | None, options: ReadOptions
) -> tuple[SampleTable, str | None]:
    """Read all rows, and a message if the last one is cut off."""
    table = SampleTable(str(path), options.salvage, options.names)
    rows = csv.reader(lines, delimiter=separator or ",", quoting=csv.QUOTE_NONE)
    while True:
        try:
            cells = next(rows, None)
            if cells is None:
                return table, None
            if separator is not None:
                cells = tidied([cell.strip(' "') for cell in cells], separator, _WIDTH)
            if any(cells):
                sensor, numbers = _parse_row(cells, not lines.ended, options.names)
                table.add(sensor, lines.number, numbers, cells.count(""))
        except csv.Error as error:
            table.reject(lines.number, f"is not CSV: {error}")
        except ValueError as error:
            # Recordings that were joined: nothing of the wearer is in these lines.
            if not lines.too_long and cells and (_is_header(cells) or cells[0].startswith(COMMENTS)):
                continue
            # The pieces of a line that is too long have no line end either.
            if lines.ended or lines.too_long:
                table.reject(lines.number, str(error))
                continue
            return table, (
                f"{path}: row {lines.number} is cut off, {table.count} samples before it are good; "
                "delete that row or copy the file again"
            )


def _parse_row(cells: list[str], cut: bool, names: Sequence[str]) -> tuple[str, list[float]]:
    """Parse a row to its sensor and numbers (time first, NaN where empty); `cut`: it has no line end.

    Raises:
        ValueError: the problem with the row.
    """
    if len(cells) != _WIDTH:
        raise ValueError(f"has {len(cells)} columns instead of {_WIDTH}")
    time_s, sensor, *rest = cells
    sensor = sensor.strip('"')  # some programs quote text; quoted line breaks are not supported
    if sensor not in names:
        hint = choices(sensor, names, "the names are")
        raise ValueError(f"names an unknown sensor {shorten(sensor)}; {hint}")
    if cut and (rest[-1] or rest[-2]):
        # The last number may lack digits.
        raise ValueError("has no line end")
    try:
        seconds = float(time_s)
    except ValueError:
        raise ValueError(f"has the time {shorten(time_s)}; times are numbers of seconds") from None
    try:
        return sensor, [seconds, *[float(cell) if cell else nan for cell in rest]]
    except ValueError as error:
        raise ValueError(f"has a value that is not a number ({shorten(str(error))})") from None


FORMAT = RecordingFormat((".csv",), read_csv)
