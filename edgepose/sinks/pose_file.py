"""Common base of outputs to one growing file: when it appears, is written and is finished."""

from __future__ import annotations

import time
from abc import abstractmethod

from edgepose.errors import EdgeposeError
from edgepose.pose import PoseFrame
from edgepose.sinks.base import Sink
from edgepose.utils.growing_files import FLUSH_S, GrowingFile


class PoseFileSink(Sink):
    """Collects poses and writes them about once a second to a file that appears with the first pose."""

    def __init__(self, output: GrowingFile, head: bytes) -> None:
        """Write the start of the file.

        Args:
            output: the open file, closed by this sink.
            head: content before the poses.

        Raises:
            EdgeposeError: the start cannot be written; the file is deleted.
        """
        self._output = output
        self._closed, self._empty = False, True
        self._flushed = time.monotonic()
        try:
            output.write(head)
        except EdgeposeError:
            self.discard()
            raise

    @abstractmethod
    def _add(self, pose: PoseFrame) -> bool:
        """Collect a pose; return whether it has to be written at once."""

    @abstractmethod
    def _write_collected(self) -> None:
        """Write and forget the collected poses, of which there may be none."""

    def start(self) -> None:
        """Let the file appear; if it replaces an existing one, it appears with the first pose instead.

        Raises:
            EdgeposeError: another file has appeared there in the meantime.
        """
        if not self._output.exists:
            self._output.start()

    def write(self, pose: PoseFrame) -> None:
        """Add a pose; it is on disk within about a second, the first at once."""
        if self._add(pose) or self._empty or time.monotonic() - self._flushed >= FLUSH_S:
            self._flush()
        if self._empty:  # only now may an existing file be replaced: there is room for poses
            self._empty = False
            self._output.start()

    def close(self) -> None:
        """Write the collected poses and close the file; standard output stays open.

        An existing file is kept if no pose was written.
        """
        if self._closed:
            return
        self._closed = True
        try:
            self._flush()
        finally:
            self._output.close()

    def discard(self) -> None:
        """Finish the file like `close`, but no file appears if no pose was written."""
        if not self._empty:
            self.close()
            return
        self._closed = True
        self._output.discard()

    def _flush(self) -> None:
        self._flushed = time.monotonic()
        self._write_collected()
