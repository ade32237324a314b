"""Common base of outputs to files that are written whole at the end of a run."""

from __future__ import annotations

import os
from abc import abstractmethod
from collections.abc import Iterable
from pathlib import Path

from edgepose.errors import EdgeposeError
from edgepose.formats.poses.csv import read_blocks
from edgepose.pose import PoseFrame, PoseSequence
from edgepose.sinks.base import Sink
from edgepose.sinks.csv import CsvSink
from edgepose.utils.durable_files import replace_file
from edgepose.utils.output_targets import find_target, part_path


class PartFileSink(Sink):
    """Writes poses to a file that appears when the sink closes.

    Until then they are in a CSV file next to it, see `part_path`. So however a run ends, there is a file of
    poses that all commands read, and at most one second of poses is kept in memory.
    """

    def __init__(self, path: str | Path, *, translation: bool, contacts: bool, overwrite: bool) -> None:
        """Open the CSV file.

        Args:
            path: file to write.
            translation: whether the poses have a translation.
            contacts: whether the poses have contacts.
            overwrite: replace an existing file; the CSV file of another run is never replaced.

        Raises:
            EdgeposeError: the file cannot be written, or the CSV file of a run that was cut off exists.
        """
        self._path, self._overwrite = Path(path), overwrite
        kind = self._path.suffix[1:].lower() or "npz"
        target = find_target(path, "poses")
        if target.stream:
            raise EdgeposeError(
                f"cannot write poses to {path}: {kind.upper()} output needs the name of a file"
            )
        self._part = part_path(path)
        if os.path.lexists(self._part):
            raise EdgeposeError(
                f"{self._part} already exists, perhaps from a run that was cut off: save its poses with "
                f"edgepose convert {self._part} --to {kind} --out saved, then delete it"
            )
        self._closed, self._count = False, 0
        self._csv = CsvSink(
            self._part, translation=translation, contacts=contacts, overwrite=False, follow=False
        )
        self._csv.start()

    @abstractmethod
    def _write_file(self, path: Path, blocks: Iterable[PoseSequence], count: int) -> None:
        """Write `count` poses, which come in blocks, to the file.

        Raises:
            OSError: the file cannot be written.
        """

    def write(self, pose: PoseFrame) -> None:
        """Add a pose."""
        self._csv.write(pose)
        self._count += 1

    def close(self) -> None:
        """Write the file and delete the CSV file; a second call does nothing.

        Raises:
            EdgeposeError: something could not be written; the poses written so far are in the CSV file.
        """
        if self._closed:
            return
        if not self._count:
            self.discard()
            return
        self._closed = True
        try:
            self._csv.close()
        finally:  # a full disk may still have room for the file, which is smaller
            self._finish()

    def discard(self) -> None:
        """Finish the file like `close`, unless no pose was written."""
        if self._count:
            self.close()
            return
        self._closed = True
        self._csv.discard()

    def _finish(self) -> None:
        try:
            with self._part.open("rb") as file:
                count = sum(piece.count(b"\n") for piece in iter(lambda: file.read(1 << 20), b"")) - 1
        except OSError as error:
            raise EdgeposeError(
                f"cannot write poses to {self._path}: {self._part}, which holds them, cannot be read: "
                f"{error.strerror or error}"
            ) from error
        if count > 0:
            try:
                replace_file(
                    self._path,
                    lambda path: self._write_file(path, read_blocks(self._part), count),
                    "poses",
                    overwrite=self._overwrite,
                )
            except EdgeposeError as error:
                raise EdgeposeError(f"{error}; all poses are in {self._part}") from error
        self._part.unlink()
