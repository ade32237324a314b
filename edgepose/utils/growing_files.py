"""Outputs that grow by whole rows for hours.

Whenever the power, the disk or the reader goes, what is written ends at a whole row. A file on a disk has
another name until its first row comes, so that what had its name before is not lost for nothing.
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
from edgepose.utils.durable_files import new_file, other_name, put_in_place
from edgepose.utils.output_streams import OutputStream, never
from edgepose.utils.output_targets import Target, find_target, write_error_message

FLUSH_S = 1.0
"""A killed program loses at most what came in this time, seconds."""


class GrowingFile:
    """An output that is written row by row, without a buffer.

    Attributes:
        regular: a file on a disk, not a device, a pipe or a terminal.
        file: what is written to; of a file on a disk, to seek in.
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
    ) -> None:
        """Open it; a file on a disk has another name until it is started.

        Args:
            name: of the output; "-" is standard output.
            what: goes into it, for messages.
            end: how rows end: where the disk is full the file ends with it. Empty if it may end anywhere.
            overwrite: whether it may take the place of a file.
            follow: write to the file at the end of a link; without, in the place of the link.
            stopped: whether the run is to end. Then a reader that takes nothing is not waited for any more.

        Raises:
            EdgeposeError: it cannot be written.
        """
        self._what, self._end, self._overwrite = what, end, overwrite
        self._closed = False
        self._part: Path | None = None
        self._stream: OutputStream | None = None
        self._target = (
            find_target(name, what) if follow else Target(str(name), Path(name), False, os.path.lexists(name))
        )
        if self._target.stream:
            self._stream = OutputStream(self._target, what, stopped)
            self.file: Any = self._stream.file
            self.regular = self._stream.regular
            return
        self._part = other_name(self._target)
        try:
            self.file = os.fdopen(new_file(self._part, self._target), "rb+", 0)
        except OSError as error:
            raise self._explained(error) from error
        self.regular = True

    def _explained(self, error: OSError) -> EdgeposeError:
        return EdgeposeError(write_error_message(error, self._target.name, self._what))

    @property
    def exists(self) -> bool:
        """Whether a file is there, whose place it will take when it is started."""
        return self._part is not None and self._target.exists

    def start(self) -> None:
        """Let it take its place; further calls do nothing.

        Raises:
            EdgeposeError: it cannot, or another file is there now.
        """
        if self._part is None:
            return
        try:
            put_in_place(self._part, self._target.path, self._overwrite)
        except OSError as error:
            raise self._explained(error) from error
        self._part = None

    def write(self, rows: bytes) -> None:
        """Write whole rows; where that fails, a file on a disk ends with the end of one.

        Raises:
            EdgeposeError: not all of them could be written.
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
                _drop_end(self.file, done - (rows.rfind(self._end, 0, done) + len(self._end)))
            raise self._explained(error) from error

    def sync(self) -> None:
        """Have what is written on the disk.

        Raises:
            EdgeposeError: it cannot be.
        """
        if self.regular:
            try:
                os.fsync(self.file.fileno())
            except OSError as error:
                raise self._explained(error) from error

    def discard(self) -> None:
        """Close it and leave nothing behind; what it has taken the place of is gone."""
        self._closed = True
        left = self._part
        if left is None and self._stream is None and self._is_in_place():
            left = self._target.path
        with contextlib.suppress(OSError, EdgeposeError):  # what led here is the one to report
            self._close()
        if left is not None:
            left.unlink(missing_ok=True)
        self._part = None

    def close(self) -> None:
        """Close it; a file that was not started is discarded if one is there already. Standard output stays
        open.

        Raises:
            EdgeposeError: it has gone from its place, or its reader has not read all.
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
        gone = self._stream is None and not self._is_in_place()
        try:
            self._close()
        except OSError as error:  # Network file systems may report a full disk only here.
            raise self._explained(error) from error
        if gone:
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


def _drop_end(file: Any, count: int) -> None:
    """Take the last `count` bytes, the beginning of a row, off the file."""
    with contextlib.suppress(OSError):  # The error that led here is the one to report.
        size = file.seek(0, os.SEEK_CUR) - count
        file.truncate(size)
        file.seek(size)


class DurableAppender:
    """An output that grows by whole pieces.

    A thread of its own writes and syncs them about once a second: a slow card must not keep the reader of a
    port from its work, because the system holds back only a fraction of a second for it.
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
            path: of the file; "-" is standard output.
            what: what goes into it, for messages.
            start: its first piece.
            end: how pieces end; where the disk is full the file ends with it. Empty if it may end anywhere.
            overwrite: whether it may take the place of a file.
            follow: see `GrowingFile`.

        Raises:
            EdgeposeError: it cannot be written.
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
        """Have a piece written.

        Raises:
            EdgeposeError: an earlier one could not be written; what is there is whole.
        """
        if self._error is not None:
            raise self._error
        if self._empty:
            self._file.start()
            self._empty = False
        self._pieces.append(piece)

    def close(self) -> None:
        """Write what is held back and close the file; a second call does nothing. Without any piece there is
        no new file.

        Raises:
            EdgeposeError: something could not be written; what is there is whole.
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
