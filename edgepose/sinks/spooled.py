"""Files that only appear at the end, or are written to at their start again, to a device or pipe."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from edgepose.pose import PoseFrame
from edgepose.sinks.base import Sink
from edgepose.utils.output_streams import copy_to_stream


class SpooledSink(Sink):
    """Has a file written in a temporary folder, and copies it when it is whole."""

    def __init__(self, path: str | Path, make: Callable[[Path], Sink], stopped: Callable[[], bool]) -> None:
        """Open the file in the temporary folder.

        Args:
            path: of the device or pipe.
            make: opens the sink of the file.
            stopped: whether the run is to end: then a reader that takes nothing is not waited for.

        Raises:
            EdgeposeError: there is no room for it.
        """
        self._path, self._stopped, self._closed = str(path), stopped, False
        self._folder = TemporaryDirectory()
        self._file = Path(self._folder.name) / f"poses{Path(path).suffix}"
        try:
            self._sink = make(self._file)
        except BaseException:
            self._folder.cleanup()
            raise

    def write(self, pose: PoseFrame) -> None:
        """Add a pose."""
        self._sink.write(pose)

    def close(self) -> None:
        """Copy the file; a second call does nothing.

        Raises:
            EdgeposeError: the file could not be written, or not be copied.
        """
        if self._closed:
            return
        self._closed = True
        with self._folder:
            self._sink.close()
            if self._file.exists():  # not without poses
                copy_to_stream(self._file, self._path, "poses", self._stopped)

    def discard(self) -> None:
        """Copy nothing."""
        if not self._closed:
            self._closed = True
            with self._folder:
                self._sink.discard()
