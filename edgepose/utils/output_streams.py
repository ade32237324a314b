"""Output to devices, pipes and standard output, whose readers may be slow or missing."""

from __future__ import annotations

import errno
import logging
import os
import select
import shutil
import stat
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from edgepose.errors import EdgeposeError
from edgepose.utils.output_targets import Target, descriptor, find_target, write_error_message

PATIENCE_S = 1.0
"""Longest wait for the reader of a pipe once the run is to end, seconds."""

BACKLOG = 1 << 24
"""Bytes that wait for a slow reader where nothing else may be delayed: minutes of poses."""

_PIECE = 4096  # a pipe that is writable accepts this many bytes at once
_PIECE_TERMINAL = 256
_POLL_MS = 100
_log = logging.getLogger(__name__)


def never() -> bool:
    """The default for `stopped`: a run that is not stopped."""
    return False


class OutputStream:
    """A device, a pipe or standard output, written to without a buffer.

    Attributes:
        regular: standard output is a file on a disk.
        unwritten: number of bytes not written because the reader has stopped reading and the run is to end.
        file: the file object to write to.
    """

    def __init__(
        self, target: Target, what: str, stopped: Callable[[], bool] = never, waits: bool = True
    ) -> None:
        """Open the output, waiting for a reader if it is a pipe.

        Args:
            target: the output.
            what: the output's content, for messages.
            stopped: whether the run is to end; a reader that has stopped reading is then not waited for.
            waits: `write` waits for a slow reader; otherwise what it does not read is kept in memory.

        Raises:
            EdgeposeError: the output cannot be opened, or the pipe had no reader until the end of the run.
        """
        self._target, self._what, self._stopped = target, what, stopped
        self.unwritten = 0
        self._waits, self._backlog = waits, bytearray()
        try:
            self.file = self._open()
        except OSError as error:
            raise EdgeposeError(write_error_message(error, target.name, what)) from error
        self._poll = _poll_of(self.file)
        self.regular = self._poll is not None and stat.S_ISREG(os.fstat(self.file.fileno()).st_mode)
        if self.regular:
            self._poll = None
        self._piece = _PIECE_TERMINAL if self._poll and os.isatty(self.file.fileno()) else _PIECE

    def _open(self) -> Any:
        name = self._target.name
        if name == "-":
            # A closed standard output is replaced by the null device, see `cli.terminal.messages`.
            if sys.stdout is None or getattr(sys.stdout, "name", None) == os.devnull:
                raise EdgeposeError(f"cannot write {self._what}: standard output is closed")
            # Bypass Python's buffers: without a reader, flushing them would fail at exit.
            sys.stdout.flush()
            return getattr(sys.stdout.buffer, "raw", sys.stdout.buffer)
        number = descriptor(Path(name))
        # A duplicate shares the position in the open file, which reopening would not.
        return os.fdopen(self._open_path() if number is None else os.dup(number), "wb", 0)

    def _open_path(self) -> int:
        """Open a device or pipe, waiting for the pipe's reader; return its descriptor."""
        path, warned = Path(self._target.name), False
        while True:
            try:
                number = os.open(path, os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
            except OSError as error:
                if error.errno != errno.ENXIO or not path.is_fifo():
                    raise
            else:
                os.set_blocking(number, True)
                return number
            if self._stopped():
                raise EdgeposeError(f"no program reads the {self._what} from {path}")
            if not warned:
                warned = True
                _log.warning("%s: waiting for a program that reads it", path)
            time.sleep(_POLL_MS / 1e3)

    def write(self, data: bytes) -> int:
        """Write all data, unless the reader has stopped reading and the run is to end.

        Returns:
            Number of bytes in the data.

        Raises:
            OSError: writing failed.
            EdgeposeError: more than `BACKLOG` bytes wait for the reader.
        """
        if self._waits or self._poll is None:
            self._write(data)
            return len(data)
        self._backlog += data
        while self._backlog and self._poll.poll(0):
            del self._backlog[: self.file.write(self._backlog[: self._piece]) or 0]
        if len(self._backlog) > BACKLOG:
            self.unwritten = len(self._backlog)
            raise self._not_read()
        return len(data)

    def _write(self, data: bytes) -> None:
        done = 0
        while done < len(data):
            if not self._wait_until_writable():
                self.unwritten += len(data) - done
                break
            piece = data[done:] if self._poll is None else data[done : done + self._piece]
            done += self.file.write(piece) or 0

    def _wait_until_writable(self) -> bool:
        """Wait until the output is writable; return False if it is not by the end of the run."""
        if self.unwritten:
            return False
        if self._poll is None:
            return True
        stopped_s: float | None = None
        while not self._poll.poll(_POLL_MS):
            if self._stopped():
                stopped_s = stopped_s or time.monotonic()
                if time.monotonic() - stopped_s >= PATIENCE_S:
                    return False
        return True

    def close(self) -> None:
        """Close the output; standard output stays open.

        Raises:
            OSError: closing failed.
            EdgeposeError: the reader has not read everything.
        """
        rest, self._backlog = bytes(self._backlog), bytearray()
        try:
            if not self.unwritten:
                self._write(rest)
        finally:
            if self._target.name != "-":
                self.file.close()
        if self.unwritten:
            raise self._not_read()

    def _not_read(self) -> EdgeposeError:
        name = "standard output" if self._target.name == "-" else self._target.name
        return EdgeposeError(
            f"the program that reads the {self._what} from {name} has stopped reading: {self.unwritten} "
            "bytes were not written"
        )


def _poll_of(file: Any) -> Any:
    """Return a poll object for writability; None for files without a descriptor."""
    try:
        number = file.fileno()
    except OSError:  # not a file of the operating system, such as a captured standard output
        return None
    poll = select.poll()
    poll.register(number, select.POLLOUT)
    return poll


def copy_to_stream(source: Path, name: str, what: str, stopped: Callable[[], bool] = never) -> None:
    """Copy a complete file to a device or pipe.

    Raises:
        EdgeposeError: the device or pipe cannot be written to, or its reader has stopped reading.
    """
    stream = OutputStream(find_target(name, what), what, stopped)
    try:
        try:
            with source.open("rb") as file:
                shutil.copyfileobj(file, stream, 1 << 16)
        finally:
            stream.close()
    except OSError as error:
        raise EdgeposeError(write_error_message(error, name, what)) from error
