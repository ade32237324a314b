"""Output to a device or pipe in formats that cannot be streamed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from edgepose.pose import PoseFrame
from edgepose.sinks.base import Sink, SinkContext
from edgepose.utils.output_streams import copy_to_stream
from edgepose.utils.output_targets import is_stream


class SpooledSink(Sink):
    """Writes a file in a temporary folder, and copies it to the device or pipe once it is complete."""

    def __init__(self, path: str | Path, make: Callable[[Path], Sink], stopped: Callable[[], bool]) -> None:
        """Open the file in the temporary folder.

        Args:
            path: the device or pipe.
            make: opens the sink that writes the file.
            stopped: whether the run is to end; a reader that has stopped reading is then not waited for.

        Raises:
            EdgeposeError: the file cannot be opened.
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
            EdgeposeError: the file could not be written or copied.
        """
        if self._closed:
            return
        self._closed = True
        with self._folder:
            self._sink.close()
            if self._file.exists():  # there is no file if there are no poses
                copy_to_stream(self._file, self._path, "poses", self._stopped)

    def discard(self) -> None:
        """Delete the file without copying it."""
        if not self._closed:
            self._closed = True
            with self._folder:
                self._sink.discard()


def open_file_sink(path: str, make: Callable[[str | Path, bool], Sink], context: SinkContext) -> Sink:
    """Open a sink for a file; a device or pipe gets the file once it is complete.

    Args:
        path: the file, device or pipe.
        make: opens the sink for a file, given whether an existing one may be replaced.
        context: settings of the run.

    Raises:
        EdgeposeError: the file cannot be opened.
    """
    if path != "-" and is_stream(path):
        return SpooledSink(path, lambda part: make(part, True), context.stopped)
    return make(path, context.overwrite)
