"""Outputs that grow row by row for hours.

If the power, the disk or the reader fails, the output ends with a complete row. A file on a disk has a
temporary name until its first row comes, so that an existing file is not lost without a replacement.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from edgepose.errors import EdgeposeError
from edgepose.utils.durable_files import new_file, put_in_place, temporary_name
from edgepose.utils.output_streams import OutputStream, never
from edgepose.utils.output_targets import Target, find_target, write_error_message

FLUSH_S = 1.0
"""Interval of writing to the disk, seconds: a killed program loses at most the rows of this time."""


class GrowingFile:
    """An output that is written row by row, without a buffer.

    Attributes:
        regular: the output is a file on a disk, not a device, a pipe or a terminal.
        file: the file object to write to; one on a disk can be seeked.
    """

    def __init__(
        self,
        name: str | Path,
        what: str,
        *,
        end: bytes = b"\n",
        overwrite: bool = True,
        follow: bool = True,
        stopped: Callable[[], bool] = never,
        waits: bool = True,
    ) -> None:
        """Open the output; a file on a disk has a temporary name until it is started.

        Args:
            name: name of the output; "-" is standard output.
            what: the output's content, for messages.
            end: end of a row, with which the file ends if the disk is full. Empty if it may end anywhere.
            overwrite: replace an existing file.
            follow: write to the target of a symbolic link; if false, replace the link.
            stopped: whether the run is to end; a reader that has stopped reading is then not waited for.
            waits: see `OutputStream`.

        Raises:
            EdgeposeError: the output cannot be written to.
        """
        self._what, self._end, self._overwrite = what, end, overwrite
        self._closed = False
        self._part: Path | None = None
        self._stream: OutputStream | None = None
        self._target = (
            find_target(name, what) if follow else Target(str(name), Path(name), False, os.path.lexists(name))
        )
        if self._target.stream:
            self._stream = OutputStream(self._target, what, stopped, waits)
            self.file: Any = self._stream.file
            self.regular = self._stream.regular
            return
        self._part = temporary_name(self._target)
        try:
            self.file = os.fdopen(new_file(self._part, self._target), "rb+", 0)
        except OSError as error:
            raise self._writing_error(error) from error
        self.regular = True

    def _writing_error(self, error: OSError) -> EdgeposeError:
        return EdgeposeError(write_error_message(error, self._target.name, self._what))

    @property
    def exists(self) -> bool:
        """Whether there is a file that this one will replace when it is started."""
        return self._part is not None and self._target.exists

    def start(self) -> None:
        """Give the file its final name; further calls do nothing.

        Raises:
            EdgeposeError: it cannot be renamed, or another file has appeared there.
        """
        if self._part is None:
            return
        try:
            put_in_place(self._part, self._target.path, self._overwrite)
        except OSError as error:
            raise self._writing_error(error) from error
        self._part = None

    def write(self, rows: bytes) -> None:
        """Write complete rows; if that fails, a file on a disk is cut back to the end of a row.

        Raises:
            EdgeposeError: not all rows could be written.
        """
        done = 0
        try:
            if self._stream is not None and not self.regular:
                self._stream.write(rows)
                return
            while done < len(rows):
                done += self.file.write(rows[done:])
        except OSError as error:
            if self.regular:
                _cut_off(self.file, done - (rows.rfind(self._end, 0, done) + len(self._end)))
            raise self._writing_error(error) from error

    def sync(self) -> None:
        """Force the written rows to the disk.

        Raises:
            EdgeposeError: the disk reports an error.
        """
        if self.regular:
            try:
                os.fsync(self.file.fileno())
            except OSError as error:
                raise self._writing_error(error) from error

    def discard(self) -> None:
        """Close and delete the file; a file that it has replaced is not restored."""
        self._closed = True
        file = self._part
        if file is None and self._stream is None and self._is_in_place():
            file = self._target.path
        with contextlib.suppress(OSError, EdgeposeError):  # the error that led here is the one to report
            self._close()
        if file is not None:
            file.unlink(missing_ok=True)
        self._part = None

    def close(self) -> None:
        """Close the output; standard output stays open.

        A file that was not started is deleted if it would replace an existing one.

        Raises:
            EdgeposeError: the file has been moved or deleted, or the reader has not read everything.
        """
        if self._closed:
            return
        if self.exists:
            self.discard()
            return
        try:
            self.start()
        except EdgeposeError:
            self.discard()
            raise
        self._closed = True
        moved = self._stream is None and not self._is_in_place()
        try:
            self._close()
        except OSError as error:  # network file systems may report a full disk only here
            raise self._writing_error(error) from error
        if moved:
            raise EdgeposeError(
                f"{self._target.name} was moved, removed or replaced while {self._what} were written to it"
            )

    def _close(self) -> None:
        (self.file if self._stream is None else self._stream).close()

    def _is_in_place(self) -> bool:
        try:
            return os.path.samestat(self._target.path.stat(), os.fstat(self.file.fileno()))
        except OSError:
            return False


def _cut_off(file: Any, count: int) -> None:
    """Remove the last `count` bytes, an incomplete row, from the file."""
    with contextlib.suppress(OSError):  # the error that led here is the one to report
        size = file.seek(0, os.SEEK_CUR) - count
        file.truncate(size)
        file.seek(size)


class DurableAppender:
    """An output that grows piece by piece, written by a thread.

    The thread writes and syncs about once a second. A slow SD card must not delay the reader of a port, for
    which the system buffers only a fraction of a second of data.
    """

    def __init__(
        self,
        path: str,
        what: str,
        start: bytes,
        end: bytes = b"\n",
        *,
        overwrite: bool = True,
        follow: bool = True,
    ) -> None:
        """Open the output and write its start.

        Args:
            path: name of the file; "-" is standard output.
            what: the output's content, for messages.
            start: the first piece.
            end: end of a piece, with which the file ends if the disk is full. Empty if it may end anywhere.
            overwrite: replace an existing file.
            follow: see `GrowingFile`.

        Raises:
            EdgeposeError: the output cannot be written to.
        """
        self._closing = threading.Event()
        self._file = GrowingFile(
            *(path, what), end=end, overwrite=overwrite, follow=follow, stopped=self._closing.is_set
        )
        self._pieces = deque([start])
        self._error: EdgeposeError | None = None
        self._empty = True
        self._flush()
        if self._error is not None:
            self._file.discard()
            raise self._error
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def add(self, piece: bytes) -> None:
        """Queue a piece for writing.

        Raises:
            EdgeposeError: an earlier piece could not be written; the file ends with a complete piece.
        """
        if self._error is not None:
            raise self._error
        if self._empty:
            self._file.start()
            self._empty = False
        self._pieces.append(piece)

    def close(self) -> None:
        """Write the queued pieces and close the file; a second call does nothing.

        If no piece was added, no new file appears.

        Raises:
            EdgeposeError: something could not be written; the file ends with a complete piece.
        """
        if self._closing.is_set():
            return
        self._closing.set()
        self._thread.join()
        try:
            if self._empty:
                self._file.discard()
            else:
                self._file.close()
        except EdgeposeError as error:
            self._error = self._error or error
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
            self._file.write(data)
            self._file.sync()
        except EdgeposeError as error:
            self._error = error
