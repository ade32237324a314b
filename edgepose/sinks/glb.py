"""Binary glTF output: a figure that moves, for Blender, browsers and game engines."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType

from edgepose.formats.gltf import write_glb
from edgepose.pose import PoseSequence
from edgepose.sinks.base import Sink, SinkContext
from edgepose.sinks.part_file import PartFileSink
from edgepose.sinks.spooled import open_file_sink
from edgepose.skeleton import Body, default_body
from edgepose.utils.output_targets import FileTarget


class GlbSink(PartFileSink):
    """Writes poses to a GLB file that appears when the sink closes."""

    def __init__(
        self,
        path: str | Path,
        rate: float = 60.0,
        body: Body | None = None,
        names: str = "smpl",
        translation: bool = False,
        about: Mapping[str, str] = MappingProxyType({}),
        *,
        overwrite: bool = True,
    ) -> None:
        """Open the CSV file that grows until the end, see `PartFileSink`.

        Args:
            path: file to write.
            rate: frames per second.
            body: body whose bones are shown; None for the default body.
            names: names of the joints, a key of `BVH_NAMES`.
            translation: whether the poses have a translation.
            about: origin of the poses, see `PoseSequence`.
            overwrite: replace an existing GLB file.

        Raises:
            EdgeposeError: see `PartFileSink`.
        """
        self._settings = rate, (body or default_body()).offsets, names, about
        super().__init__(path, translation=translation, contacts=False, overwrite=overwrite)

    def _write_file(self, path: Path, blocks: Iterable[PoseSequence], count: int) -> None:
        write_glb(path, blocks, count, *self._settings)


def open_sink(target: FileTarget, context: SinkContext) -> Sink:
    """Open a `GlbSink`; a device or pipe gets the file once it is complete."""
    settings = context.rate, context.body, target.option("names"), context.translation, context.about
    return open_file_sink(
        target.path, lambda path, overwrite: GlbSink(path, *settings, overwrite=overwrite), context
    )
