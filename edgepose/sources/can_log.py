"""Logs of CAN buses, through python-can's readers and writers: a damaged line or frame costs only itself."""

from __future__ import annotations

import contextlib
import gzip
import io
import logging
import re
import sqlite3
import struct
import time
from collections.abc import Iterable, Iterator
from datetime import datetime
from itertools import islice, pairwise
from pathlib import Path
from statistics import median
from typing import Any, BinaryIO, NamedTuple, TextIO, cast

import can

from edgepose.errors import FileFormatError
from edgepose.formats.ledger import Ledger
from edgepose.utils.counted_lines import CountedLines
from edgepose.utils.safe_npz import check_size

# python-can warns about every vendor library and every clock that is not installed.
logging.getLogger("can").setLevel(logging.CRITICAL)

_STUCK_S = 30.0
"""Longest time in which a writer may write nothing, seconds."""

_LATEST_S = 1e11  # 5000 years of Unix time
_BLF_OBJECT, _BLF_HEAD = b"LOBJ", struct.Struct("<4sHHII")

_SCREEN = re.compile(
    r"\s*(?P<bus>\w+)(?:\s+[RT]X\s\S\s\S)?\s+(?P<id>[0-9A-Fa-f]{3,8})\s+\[(?P<size>\d+)\]"
    r"(?P<data>(?:\s+[0-9A-Fa-f]{2})*)\s*(?:'.*)?"
)
"""A frame that candump shows on the screen; python-can reads those that candump -l writes to a file."""

_STAMP = re.compile(
    r"\s*\((?:(?P<date>\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)|(?P<seconds>\d{1,12}))(?P<fraction>\.\d+)\)"
)
"""The time of a line of candump, in any of its formats (candump -t)."""

_FIRST_LINES = 200
"""Lines of a log by which its times are judged."""

_FEW = 2  # steps back of a clock that is set, rather than of times since the line before

_ASC_FRAME = re.compile(r"\s*\d+\.\d+\s+(?:CANFD\s+)?\d+\s.*\b[RT]x\b")
_ASC_TIME = re.compile(r"(\s*)(\d+\.\d+)(\s.*)", re.DOTALL)

Frame = tuple[str, float, list[can.Message] | None]


class _BlfReader(can.BLFReader):
    """A BLF reader that stops at an object whose stated size is below its header's: python-can would loop."""

    def _parse_data(self, data: bytes) -> Iterator[can.Message]:
        end = _find_empty_object(data)
        yield from super()._parse_data(data if end is None else data[:end])
        if end is not None:
            raise ValueError("damaged: an object in it has no length")


def _find_empty_object(data: bytes) -> int | None:
    """Return the offset of the first object without a length in a BLF container; None if there is none."""
    at = data.find(_BLF_OBJECT, 0, 8)
    while at >= 0 and at + _BLF_HEAD.size <= len(data):
        size = _BLF_HEAD.unpack_from(data, at)[3]
        if size < _BLF_HEAD.size:
            return at
        at = data.find(_BLF_OBJECT, at + size, at + size + 8)
    return None


def _check_table(path: Path) -> None:
    """Raise ValueError unless the messages of an SQLite log are a table.

    A view can be endless, and SQLite cannot be interrupted by a signal while it computes one.
    """
    with contextlib.closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as log:
        row = log.execute("SELECT type, sql FROM sqlite_master WHERE name = 'messages'").fetchone()
    if row is None or row[0] != "table" or not str(row[1]).upper().lstrip().startswith("CREATE TABLE"):
        raise ValueError("it has no table of messages")


def _check_trace(path: Path) -> None:
    """Raise FileFormatError for markers of motion capture, whose files have the same ending."""
    with path.open("rb") as file:
        if file.read(12) == b"PathFileType":
            raise FileFormatError("it holds the positions of markers, and no frames of a CAN bus")


class _Lines(CountedLines):
    """Lines of a text log; of one that is too long, its last piece."""

    read = write = None  # python-can takes an object with these for an open file

    def __next__(self) -> str:
        line = super().__next__()
        with contextlib.suppress(StopIteration):  # the file may end with the last piece
            while self.too_long and not self.ended:
                line = super().__next__()
        return line

    def close(self) -> None:
        self._file.close()


class _CandumpLines(_Lines):
    """Lines of a candump log with times in seconds; those of candump's screen become lines of its files.

    Of a line with several times, to which a second logger added its first line, the last part is read.
    """

    def __init__(self, file: TextIO, ledger: Ledger) -> None:
        super().__init__(file)
        self._ledger = ledger
        self._deltas = _are_deltas(_first_times(_Lines(file)))
        file.seek(0)
        self._time_s = 0.0

    def __next__(self) -> str:
        line = super().__next__()
        if self.number == 1 and line.startswith("***BUSMASTER"):
            raise FileFormatError("logs of BUSMASTER cannot be read: save it as .asc or .blf")
        torn = line.rfind("(")
        if torn > 0 and line[:torn].strip() and _STAMP.match(line, torn):
            self._ledger.leave_out(self.number, "is not a frame")
            line = line[torn:]
        stamp = _STAMP.match(line)
        shown = _SCREEN.fullmatch(line, stamp.end() if stamp else 0)
        if stamp is None:
            if shown is not None:
                raise FileFormatError(
                    "candump has shown it on the screen, without times: log with candump -l"
                )
            return line
        if shown is None and stamp["date"] is None and not self._deltas:
            return line
        self._time_s = _seconds(stamp) + (self._time_s if self._deltas else 0.0)
        frame = (
            f" {shown['bus']} {shown['id']}#{''.join(shown['data'].split())}\n"
            if shown
            else line[stamp.end() :]
        )
        return f"({self._time_s:.6f}){frame}"


def _first_times(lines: _Lines) -> list[float]:
    stamps = (_STAMP.match(line) for line in islice(lines, _FIRST_LINES))
    return [_seconds(stamp) for stamp in stamps if stamp is not None and stamp["seconds"]]


def _seconds(stamp: re.Match[str]) -> float:
    """Return the time of a line; a date's time zone is unknown, so it is taken for UTC.

    Raises:
        ValueError: no such date.
    """
    if stamp["date"] is None:
        return float(stamp["seconds"] + stamp["fraction"])
    return datetime.fromisoformat(stamp["date"] + "+00:00").timestamp() + float(stamp["fraction"])


def _are_deltas(times: list[float]) -> bool:
    """Return whether times are those since the line before, which go up and down but do not grow."""
    back = sum(after < before for before, after in pairwise(times))
    quarter = len(times) // 4
    return back > _FEW and median(times[-quarter:]) <= max(times[:quarter])


class _AscLines(_Lines):
    """Lines of an ASC log with times from its start, even if the file counts them from line to line."""

    def __init__(self, file: TextIO, ledger: Ledger) -> None:
        super().__init__(file)
        self.has_frame = False  # in the present line, and no message of it has come
        self._ledger = ledger
        self._relative = False
        self._time_s = 0.0

    def __next__(self) -> str:
        if self.has_frame:
            self._ledger.leave_out(self.number, "is not a whole frame")
        self.has_frame = False
        line = super().__next__()
        if line.lower().startswith("base "):
            self._relative = "timestamps relative" in " ".join(line.lower().split())
        self.has_frame = _ASC_FRAME.match(line) is not None
        timed = _ASC_TIME.fullmatch(line) if self._relative else None
        if timed is None:
            return line
        self._time_s += float(timed[2])
        return f"{timed[1]}{self._time_s:.6f}{timed[3]}"


class _AscReader(can.ASCReader):
    """An ASC reader that can go on after a bad line, and then does not look for the header again."""

    _in_header = True

    def _extract_header(self) -> None:
        if self._in_header:
            super()._extract_header()
        self._in_header = False


class _Packed(gzip.GzipFile):
    """A packed log that is read no further than a file of its size may plausibly unpack to."""

    def read1(self, size: int = -1) -> bytes:
        data = super().read1(size)
        check_size(Path(self.name), self.tell())
        return data


class _TextLog(NamedTuple):
    """A text log.

    Attributes:
        reader: python-can's; it can be iterated again after an error, from the next line on.
        lines: what it reads.
    """

    reader: Any
    lines: _Lines


def _open_text(path: Path, ledger: Ledger) -> _TextLog | None:
    """Open a log of lines each of which is a frame; None if it is of another kind."""
    endings = [ending.lower() for ending in path.suffixes if ending.lower() != ".gz"]
    if endings[-1:] not in ([".log"], [".asc"]):
        return None
    raw = cast(BinaryIO, _Packed(path) if path.suffix.lower() == ".gz" else path.open("rb"))
    file = io.TextIOWrapper(raw, encoding="utf-8", errors="replace")
    if endings[-1] == ".log":
        lines: _Lines = _CandumpLines(file, ledger)
        return _TextLog(can.CanutilsLogReader(cast(TextIO, lines)), lines)
    lines = _AscLines(file, ledger)
    return _TextLog(_AscReader(cast(TextIO, lines)), lines)


def _messages(path: Path, ledger: Ledger) -> Iterator[can.Message]:
    """Yield the messages of a log; count the lines that are left out."""
    log = _open_text(path, ledger)
    if log is None:
        if path.suffix.lower() == ".db":
            _check_table(path)
        if path.suffix.lower() == ".trc":
            _check_trace(path)
        with _BlfReader(path) if path.suffix.lower() == ".blf" else can.LogReader(path) as reader:
            yield from reader
        return
    with contextlib.closing(log.lines):
        while True:
            before = log.lines.number
            try:
                for message in log.reader:
                    if isinstance(log.lines, _AscLines):
                        log.lines.has_frame = False
                    yield message
                return
            except (ValueError, IndexError, KeyError, AttributeError):  # of a line that is not a frame
                if log.lines.number == before:
                    raise
                ledger.leave_out(log.lines.number, "is not a frame")
                if isinstance(log.lines, _AscLines):
                    log.lines.has_frame = False


def _is_good(message: can.Message) -> bool:
    """Whether a frame's time and id are possible; logs are untrusted files, and python-can does not check."""
    return (
        isinstance(message.timestamp, int | float)
        and abs(message.timestamp) < _LATEST_S
        and isinstance(message.arbitration_id, int)
        and 0 <= message.arbitration_id < 1 << 29
    )


def read_log(path: Path, ledger: Ledger) -> Iterator[Frame]:
    """Yield channel, time in seconds and message of each frame of a log, in the file's order.

    The message is None if its time or id is impossible.

    Args:
        path: the log.
        ledger: counts the lines of a text log that are left out.

    Raises:
        FileFormatError: the log cannot be read, from its start or to its end.
    """
    try:
        for message in _messages(path, ledger):
            if message.is_error_frame or message.is_remote_frame:
                continue
            channel = "" if message.channel is None else str(message.channel)
            if _is_good(message):
                yield channel, message.timestamp, [message]
            else:
                yield channel, 0.0, None
    except FileFormatError as error:
        raise FileFormatError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None
    except OSError as error:
        raise FileFormatError(f"{path}: cannot read it: {error.strerror or error}") from None
    # python-can's readers raise arbitrary exceptions for damaged files.
    except Exception as error:
        text = (str(error).splitlines() or [""])[0] or type(error).__name__
        raise FileFormatError(f"{path}: cannot read it as a log of a CAN bus: {text}") from None


def write_log(path: Path, messages: Iterable[can.Message]) -> None:
    """Write a log of a CAN bus in the format of its ending.

    Raises:
        ValueError: not all messages could be written.
        OSError, or any other exception of python-can's writers.
    """
    count = 0
    with can.Logger(path) as log:
        for message in messages:
            log.on_message_received(message)
            count += 1
        if isinstance(log, can.SqliteWriter):
            _wait_until_written(log, count)


def _wait_until_written(log: can.SqliteWriter, count: int) -> None:
    """Wait for the writer's thread, which drops all that it has not written when it is stopped."""
    seen, since_s = -1, 0.0
    while log.num_frames < count:
        if log.num_frames > seen:
            seen, since_s = log.num_frames, time.monotonic()
        elif time.monotonic() > since_s + _STUCK_S:
            raise ValueError(f"only {seen} of {count} frames could be written")
        time.sleep(0.01)
