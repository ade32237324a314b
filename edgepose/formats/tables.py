"""Tables of numbers in text files, however a program or a spreadsheet has written them.

Columns are separated by tabs, semicolons, commas or bars. Numbers have a decimal point or comma. The text is
UTF-8 or UTF-16. There may be a byte order mark, a `sep=` line, quotes, and empty cells and rows at the ends.
Where tables have been joined, the names of the columns and comments come again between the rows.
"""

from __future__ import annotations

import codecs
import csv
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from math import isfinite, nan
from pathlib import Path
from typing import NamedTuple, TextIO

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import FileFormatError
from edgepose.formats.ledger import Ledger
from edgepose.utils.counted_lines import MAX_LINE, CountedLines

HEAD_LINES = 50
"""Lines in which the names of the columns have to come."""

SEPARATORS = "\t;,|"

COMMENTS = ("#", "//")
"""Beginnings of lines that are no rows."""

_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")
_PACKED = "PK\x03\x04"  # at the start of .zip, .xlsx and .ods
_BOMS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}


class Row(NamedTuple):
    """One row of a table.

    Attributes:
        number: of its line in the file, from 1.
        cells: one for each column; numbers have a decimal point.
        ended: whether the line has an end: without one, digits may be missing.
    """

    number: int
    cells: list[str]
    ended: bool


class Table(NamedTuple):
    """A table whose rows are still to be read.

    Attributes:
        head: the lines before the names of the columns.
        names: of the columns.
        rows: all rows that are not empty, of any number of cells.
    """

    head: list[str]
    names: list[str]
    rows: Iterator[Row]


def encoding_of(path: Path) -> str:
    """Encoding of a text file by its byte order mark; UTF-8 without one."""
    with path.open("rb") as file:
        start = file.read(4)
    return next((name for mark, name in _BOMS.items() if start.startswith(mark)), "utf-8")


@contextmanager
def open_table(
    path: Path, fits: Callable[[Sequence[str]], bool], wanted: str, longest: int = MAX_LINE
) -> Iterator[Table]:
    """Open a table of which the columns are known by name.

    Args:
        path: the file; "-" is standard input.
        fits: whether cells are the names of the columns.
        wanted: the first of these columns, for the message.
        longest: limit of a line, characters.

    Raises:
        FileFormatError: no line has these columns, or a line is longer than the limit.
        OSError: the file cannot be read.
        UnicodeDecodeError: standard input is not text.
    """
    name = name_of(path)
    with _open(path) as file:
        lines = _Lines(name, file, longest)
        head: list[str] = []
        for line in lines:
            if lines.number == 1:
                line = line.removeprefix("\ufeff")  # of standard input
            split = {mark: _trimmed(next(csv.reader([line], delimiter=mark))) for mark in SEPARATORS}
            separator = max(SEPARATORS, key=lambda mark: len(split[mark]))
            if split[separator] and fits(split[separator]):
                names = split[separator]
                yield Table(head, names, _rows(name, lines, separator, names))
                return
            head.append(line.strip())
            if len(head) == HEAD_LINES:
                break
        first = next((line for line in head if line), None)
        if first is None:
            raise FileFormatError(f"{name}: the file is empty")
        if first.startswith(_PACKED):
            raise FileFormatError(f"{name}: a workbook or another packed file; save the sheet as .csv")
        raise FileFormatError(f"{name}: starts with {first[:40]!r}, not with {wanted!r}")


def name_of(path: Path) -> str:
    """Return the name of a table for messages."""
    return "standard input" if str(path) == "-" else str(path)


def _open(path: Path) -> AbstractContextManager[TextIO]:
    if str(path) == "-":
        return nullcontext(sys.stdin)
    # With "replace", a byte that is not text costs only its row.
    return path.open(encoding=encoding_of(path), errors="replace", newline="")


class _Lines(CountedLines):
    """Lines of a table; the csv module joins those of a quoted line break."""

    def __init__(self, name: str, file: TextIO, longest: int) -> None:
        super().__init__(file, longest)
        self._name = name

    def __next__(self) -> str:
        line = super().__next__()
        if self.too_long:
            raise FileFormatError(
                f"{self._name}: row {self.number} is longer than {self.limit} characters; is it a table?"
            )
        return line


def _rows(name: str, lines: _Lines, separator: str, names: list[str]) -> Iterator[Row]:
    columns = len(names)
    for cells in csv.reader(lines, delimiter=separator, skipinitialspace=True):
        cells = tidied(cells, separator, columns)
        if not any(cells) or cells == names or cells[0].startswith(COMMENTS):
            continue
        if separator == "," and len(cells) > columns and len(cells) >= 2 * columns - 2:
            raise FileFormatError(
                f"{name}: row {lines.number} has {len(cells)} cells for {columns} columns: its numbers have "
                "decimal commas, and commas separate the columns, too; export it with decimal points"
            )
        yield Row(lines.number, cells, lines.ended)


def tidied(cells: list[str], separator: str, columns: int) -> list[str]:
    """Return the cells of a row without blanks, without empty ones after the columns, with decimal points."""
    cells = _trimmed(cells, columns)
    if separator == ",":  # then none is in a number
        return cells
    return [cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell) else cell for cell in cells]


def read_numbers(table: Table, ledger: Ledger) -> tuple[NDArray[np.int_], dict[str, NDArray[np.float64]]]:
    """Read the rest of a table of numbers alone.

    Args:
        table: whose columns all hold numbers, or nothing, in a good row.
        ledger: counts the rows that are left out.

    Returns:
        Numbers (n,) of the rows, and the values (n,) of each column; NaN where a cell is empty.
    """
    rows: list[int] = []
    values: list[list[float]] = []
    for row in table.rows:
        try:
            if len(row.cells) != len(table.names):
                raise ValueError(f"has {len(row.cells)} columns and not {len(table.names)}")
            if not row.ended:
                raise ValueError("has no line end; digits may be missing")
            values.append([_number(cell) if cell else nan for cell in row.cells])
            rows.append(row.number)
        except ValueError as error:
            ledger.leave_out(row.number, str(error))
    numbers = np.array(values, dtype=float).reshape(-1, len(table.names))
    return np.array(rows, dtype=int), dict(zip(table.names, numbers.T, strict=True))


def _number(cell: str) -> float:
    with suppress(ValueError):
        if isfinite(number := float(cell)):
            return number
    raise ValueError(f"holds something that is no number ({cell[:40]!r})")


def _trimmed(cells: list[str], least: int = 0) -> list[str]:
    """Cells without blanks around them and without empty ones at the end."""
    cells = [cell.strip() for cell in cells]
    while len(cells) > least and not cells[-1]:
        cells.pop()
    return cells
