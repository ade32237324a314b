"""NPZ output with the keys of AMASS, for SMPL tools. Arrays: docs/reference/outputs.md."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from edgepose.errors import EdgeposeError
from edgepose.formats.poses.csv import read_blocks
from edgepose.formats.poses.npz_amass import write_npz
from edgepose.pose import PoseFrame
from edgepose.sinks.base import Sink, SinkContext
from edgepose.sinks.csv import CsvSink
from edgepose.sinks.spooled import SpooledSink
from edgepose.utils.durable_files import replace_file
from edgepose.utils.output_targets import FileTarget, find_target, is_stream, part_path


class NpzSink(Sink):
    """Writes poses to an NPZ file that appears when the sink closes.

    Until then they are in a CSV file next to it, `walk.part.csv` for `walk.npz`. So however a run ends, there
    is a file of poses that all commands read, and at most one second of poses is kept in memory.
    """

    def __init__(
        self,
        path: str | Path,
        rate: float = 60.0,
        translation: bool = False,
        contacts: bool = False,
        joints: int = 24,
        about: Mapping[str, str] = MappingProxyType({}),
        *,
        overwrite: bool = True,
    ) -> None:
        """Open the CSV file.

        Args:
            path: file to write.
            rate: frames per second.
            translation: whether the poses have a translation.
            contacts: whether the poses have contacts.
            joints: number of joints to write, a key of `JOINT_COUNTS`.
            about: origin of the poses, see `PoseSequence`.
            overwrite: replace an existing NPZ file; the CSV file of another run is never replaced.

        Raises:
            EdgeposeError: the file cannot be written, or the CSV file of a run that was cut off exists.
        """
        self._path, self._overwrite = Path(path), overwrite
        target = find_target(path, "poses")
        if target.stream:
            raise EdgeposeError(f"cannot write poses to {path}: NPZ output needs the name of a file")
        self._part = part_path(path)
        if os.path.lexists(self._part):
            raise EdgeposeError(
                f"{self._part} already exists, perhaps from a run that was cut off: save its poses with "
                f"edgepose convert {self._part} --to npz --out saved, then delete it"
            )
        self._settings = rate, joints, about
        self._closed, self._count = False, 0
        self._csv = CsvSink(
            self._part, translation=translation, contacts=contacts, overwrite=False, follow=False
        )
        self._csv.start()

    def write(self, pose: PoseFrame) -> None:
        """Add a pose."""
        self._csv.write(pose)
        self._count += 1

    def close(self) -> None:
        """Write the NPZ file and delete the CSV file; a second call does nothing.

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
        finally:  # a full disk may still have room for the NPZ file, which is smaller
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
                    lambda path: write_npz(path, read_blocks(self._part), count, *self._settings),
                    "poses",
                    overwrite=self._overwrite,
                )
            except EdgeposeError as error:
                raise EdgeposeError(f"{error}; all poses are in {self._part}") from error
        self._part.unlink()


def open_sink(target: FileTarget, context: SinkContext) -> Sink:
    """Open an `NpzSink`; a device or pipe gets the file once it is complete."""
    place = context.translation, context.contacts
    settings = context.rate, *place, int(target.option), context.about
    if target.path != "-" and is_stream(target.path):
        return SpooledSink(target.path, lambda part: NpzSink(part, *settings), context.stopped)
    return NpzSink(target.path, *settings, overwrite=context.overwrite)
