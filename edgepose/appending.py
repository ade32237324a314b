"""Writing files that grow for hours and must be whole whenever the power, the disk or the reader goes."""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import select
import stat
import sys
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from edgepose.errors import EdgeposeError

FLUSH_S = 1.0
"""A killed program loses at most what came in this time, seconds."""


def open_output(path: str, what: str) -> Any:
    """A new file without a buffer, in the place of one that is there already; "-" is standard output.

    Args:
        path: of the file.
        what: what goes into it, for the message.

    Raises:
        EdgeposeError: it cannot be written.
    """
    if path == "-":
        # Below Python's buffers: what they still held would fail at exit without a reader.
        sys.stdout.flush()
        return getattr(sys.stdout.buffer, "raw", sys.stdout.buffer)
    try:
        return Path(path).open("wb", buffering=0)
    except OSError as error:
        raise EdgeposeError(explain(error, path, what)) from error


def is_regular(file: Any) -> bool:
    """Whether it is a file on a disk and not a pipe, a terminal or a device."""
    try:
        return stat.S_ISREG(os.fstat(file.fileno()).st_mode)
    except OSError:  # Not a file of the operating system, such as a captured standard output.
        return False


def write_rows(file: Any, rows: bytes, end: bytes = b"\n") -> None:
    """Write whole rows; where that fails, a file on a disk ends with the `end` of one.

    Raises:
        OSError: as the system tells it.
    """
    done = 0
    try:
        while done < len(rows):
            count = file.write(rows[done:])
            if count is None:  # A pipe that another program has made non-blocking, and it is full.
                select.select([], [file], [])
            done += count or 0
    except OSError:
        if is_regular(file):
            _drop_end(file, done - (rows.rfind(end, 0, done) + len(end)))
        raise


def explain(error: OSError, name: str, what: str) -> str:
    """The line for the user where writing has failed."""
    name = "standard output" if name == "-" else name
    if isinstance(error, BrokenPipeError):
        return f"the program that read the {what} from {name} has ended"
    if error.errno == errno.ENOENT:
        return f"cannot write {what} to {name}: its folder does not exist, create it first"
    if error.errno == errno.ENOSPC:
        return f"cannot write {what} to {name}: the disk is full; rows written before are complete"
    return f"cannot write {what} to {name}: {error.strerror or error}"


def _drop_end(file: Any, count: int) -> None:
    """Take the last `count` bytes, the beginning of a row, off the file."""
    with contextlib.suppress(OSError):  # The error that led here is the one to report.
        size = file.seek(0, os.SEEK_CUR) - count
        file.truncate(size)
        file.seek(size)


class Appender:
    """A file that grows by whole pieces.

    A thread of its own writes and syncs them about once a second: a slow card must not keep the reader of a
    port from its work, because the system holds back only a fraction of a second for it.
    """

    def __init__(self, path: str, what: str, start: bytes, end: bytes = b"\n") -> None:
        """Open the file and write its start.

        Args:
            path: of the file; "-" is standard output.
            what: what goes into it, for messages.
            start: its first piece.
            end: how pieces end; where the disk is full the file ends with it. Empty if it may end anywhere.

        Raises:
            EdgeposeError: it cannot be written.
        """
        self._path, self._what, self._end = path, what, end
        self._file = open_output(path, what)
        self._regular = is_regular(self._file)
        self._pieces = deque([start])
        self._error: EdgeposeError | None = None
        self._closing = threading.Event()
        self._flush()
        if self._error is not None:
            self._close_file()
            raise self._error
        if self._regular:
            _sync_folder(Path(path).parent)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def add(self, piece: bytes) -> None:
        """Have a piece written.

        Raises:
            EdgeposeError: an earlier one could not be written; what is there is whole.
        """
        if self._error is not None:
            raise self._error
        self._pieces.append(piece)

    def close(self) -> None:
        """Write what is held back and close the file; a second call does nothing.

        Raises:
            EdgeposeError: something could not be written; what is there is whole.
        """
        if self._closing.is_set():
            return
        self._closing.set()
        self._thread.join()
        self._close_file()
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        closing = False
        while not closing and self._error is None:
            closing = self._closing.wait(FLUSH_S)
            self._flush()

    def _flush(self) -> None:
        data = b"".join(self._pieces.popleft() for _ in range(len(self._pieces)))
        if not data:
            return
        try:
            write_rows(self._file, data, self._end)
            if self._regular:
                os.fsync(self._file.fileno())
        except OSError as error:
            self._error = EdgeposeError(explain(error, self._path, self._what))

    def _close_file(self) -> None:
        if self._path == "-":
            return
        try:
            self._file.close()
        except OSError as error:  # Network file systems may report a full disk only here.
            self._error = self._error or EdgeposeError(explain(error, self._path, self._what))


def _sync_folder(folder: Path) -> None:
    """Make the names in a folder last; a file that has no name after a power cut is lost."""
    with contextlib.suppress(OSError):  # Windows cannot, and need not.
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


def replace_file(path: Path, write: Callable[[Path], None], what: str) -> None:
    """Have a file written under another name and put in its place at once: it is whole or as it was before.

    Raises:
        EdgeposeError: it cannot be written.
    """
    # A name that nobody else has; the ending stays, because writers look at it.
    part = path.with_name(f".{secrets.token_hex(8)}{path.suffix}")
    try:
        part.touch(exist_ok=False)
        try:
            write(part)
            with part.open("rb+") as file:
                os.fsync(file.fileno())
            part.replace(path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise EdgeposeError(explain(error, str(path), what)) from error
    except EdgeposeError as error:  # of a sink, which knows the file by its other name
        raise EdgeposeError(str(error).replace(str(part), str(path))) from error
    _sync_folder(path.parent)
