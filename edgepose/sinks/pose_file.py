"""What outputs of poses to one growing file have in common: when it appears, is written and is finished."""

from __future__ import annotations

import time
from abc import abstractmethod

from edgepose.errors import EdgeposeError
from edgepose.pose import PoseFrame
from edgepose.sinks.base import Sink
from edgepose.utils.growing_files import FLUSH_S, GrowingFile


class PoseFileSink(Sink):
    """Gathers poses and writes them about once a second to a file that appears with the first of them."""

    def __init__(self, output: GrowingFile, head: bytes) -> None:
        """Write what stands before the poses.

        Args:
            output: the open file, closed by this sink.
            head: what it begins with.

        Raises:
            EdgeposeError: it cannot be written; the file is gone.
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
        """Gather a pose; whether it has to be written now."""

    @abstractmethod
    def _write_gathered(self) -> None:
        """Write what is gathered, which may be nothing, and gather anew."""

    def start(self) -> None:
        """Let the file appear; where one is there already, with the first pose.

        Raises:
            EdgeposeError: another file is there now.
        """
        if not self._output.exists:
            self._output.start()

    def write(self, pose: PoseFrame) -> None:
        """Add a pose; a file has it on disk within about a second."""
        if self._empty:
            self._empty = False
            self._output.start()
        if self._add(pose) or time.monotonic() - self._flushed >= FLUSH_S:
            self._flush()

    def close(self) -> None:
        """Write what is still held back and close the file; standard output stays open. A file that is there
        already stays if no pose has come."""
        if self._closed:
            return
        self._closed = True
        try:
            self._flush()
        finally:
            self._output.close()

    def discard(self) -> None:
        """As `close`, but without a pose no file appears."""
        if not self._empty:
            self.close()
            return
        self._closed = True
        self._output.discard()

    def _flush(self) -> None:
        self._flushed = time.monotonic()
        self._write_gathered()
