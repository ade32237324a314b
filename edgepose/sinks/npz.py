"""NPZ output with the keys of AMASS, for SMPL tools. Arrays: docs/reference/outputs.md."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType

from edgepose.formats.poses.npz_amass import write_npz
from edgepose.pose import PoseSequence
from edgepose.sinks.base import Sink, SinkContext
from edgepose.sinks.part_file import PartFileSink
from edgepose.sinks.spooled import open_file_sink
from edgepose.utils.output_targets import FileTarget


class NpzSink(PartFileSink):
    """Writes poses to an NPZ file that appears when the sink closes."""

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
        """Open the CSV file that grows until the end, see `PartFileSink`.

        Args:
            path: file to write.
            rate: frames per second.
            translation: whether the poses have a translation.
            contacts: whether the poses have contacts.
            joints: number of joints to write, a key of `JOINT_COUNTS`.
            about: origin of the poses, see `PoseSequence`.
            overwrite: replace an existing NPZ file.

        Raises:
            EdgeposeError: see `PartFileSink`.
        """
        self._settings = rate, joints, about
        super().__init__(path, translation=translation, contacts=contacts, overwrite=overwrite)

    def _write_file(self, path: Path, blocks: Iterable[PoseSequence], count: int) -> None:
        write_npz(path, blocks, count, *self._settings)


def open_sink(target: FileTarget, context: SinkContext) -> Sink:
    """Open an `NpzSink`; a device or pipe gets the file once it is complete."""
    place = context.translation, context.contacts
    settings = context.rate, *place, int(target.option("joints")), context.about
    return open_file_sink(
        target.path, lambda path, overwrite: NpzSink(path, *settings, overwrite=overwrite), context
    )
