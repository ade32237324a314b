"""Devices, pipes and standard output: they are no files on a disk, and their readers may be slow or gone."""

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
"""Time that the reader of a pipe has to take anything once the run is to end, seconds."""

_PIECE = 4096  # a pipe that can take anything takes so much at once
_PIECE_TERMINAL = 256
_POLL_MS = 100
_log = logging.getLogger(__name__)


def never() -> bool:
    """Of a run that nobody ends."""
    return False


class OutputStream:
    """A device, a pipe or standard output, written through without a buffer.

    Attributes:
        regular: standard output is a file on a disk.
        left_out: bytes that were not written because the reader takes nothing and the run is to end.
        file: what is written to.
    """

    def __init__(self, target: Target, what: str, stopped: Callable[[], bool] = never) -> None:
        """Open it, waiting for who reads a pipe.

        Args:
            target: what it is.
            what: goes into it, for messages.
            stopped: whether the run is to end. Then a reader that takes nothing is not waited for any more.

        Raises:
            EdgeposeError: it cannot be opened, or nobody has read the pipe until the run was to end.
        """
        self._target, self._what, self._stopped = target, what, stopped
        self.left_out = 0
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
            if (
                sys.stdout is None or getattr(sys.stdout, "name", None) == os.devnull
            ):  # see `cli.terminal.messages`
                raise EdgeposeError(f"cannot write {self._what}: standard output is closed")
            # Below Python's buffers: what they still held would fail at exit without a reader.
            sys.stdout.flush()
            return getattr(sys.stdout.buffer, "raw", sys.stdout.buffer)
        number = descriptor(Path(name))
        # A copy writes where the open file is, which a second opening would not.
        return os.fdopen(self._open_path() if number is None else os.dup(number), "wb", 0)

    def _open_path(self) -> int:
        """A device or pipe, once somebody reads the pipe."""
        path, told = Path(self._target.name), False
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
                raise EdgeposeError(f"nobody reads the {self._what} from {path}")
            if not told:
                told = True
                _log.warning("%s: waiting for a program that reads it", path)
            time.sleep(_POLL_MS / 1e3)

    def write(self, data: bytes) -> int:
        """Write all, unless the reader takes nothing and the run is to end.

        Returns:
            Number of bytes.

        Raises:
            OSError: as the system tells it.
        """
        done = 0
        while done < len(data):
            if not self._ready():
                self.left_out += len(data) - done
                break
            piece = data[done:] if self._poll is None else data[done : done + self._piece]
            done += self.file.write(piece) or 0
        return len(data)

    def _ready(self) -> bool:
        """Whether something can be written now, waiting for that; False where nobody takes it in the end."""
        if self.left_out:
            return False
        if self._poll is None:
            return True
        asked_s: float | None = None
        while not self._poll.poll(_POLL_MS):
            if self._stopped():
                asked_s = asked_s or time.monotonic()
                if time.monotonic() - asked_s >= PATIENCE_S:
                    return False
        return True

    def close(self) -> None:
        """Close it; standard output stays open.

        Raises:
            OSError: as the system tells it.
            EdgeposeError: the reader has not taken all.
        """
        if self._target.name != "-":
            self.file.close()
        if self.left_out:
            name = "standard output" if self._target.name == "-" else self._target.name
            raise EdgeposeError(
                f"the program that reads the {self._what} from {name} takes nothing: {self.left_out} bytes "
                "were left out"
            )


def _poll_of(file: Any) -> Any:
    """What tells whether something can be written without waiting; None where nothing does."""
    try:
        number = file.fileno()
    except OSError:  # not a file of the operating system, such as a captured standard output
        return None
    poll = select.poll()
    poll.register(number, select.POLLOUT)
    return poll


def copy_to_stream(source: Path, name: str, what: str, stopped: Callable[[], bool] = never) -> None:
    """Write a whole file to a device or pipe.

    Raises:
        EdgeposeError: it takes no more.
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
