"""Checks of output files before any work is done, for every command that writes."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from edgepose.errors import EdgeposeError
from edgepose.sinks.registry import SINKS
from edgepose.utils.output_targets import find_target

OTHER_ENDINGS = (
    *(".json", ".html", ".htm", ".png", ".pdf", ".svg", ".pt", ".md", ".toml", ".asf", ".amc", ".py"),
    *(".bin", ".raw", ".times", ".asc", ".blf", ".log", ".mf4", ".trc", ".db", ".gltf"),
)
"""Endings of the files that edgepose reads or writes besides recordings and poses, and of glTF as text."""


def known_endings() -> frozenset[str]:
    """Return the endings of all files that edgepose reads or writes."""
    # Imports every format, which is slow, but needed only for an unusual ending.
    from edgepose.formats.poses.registry import pose_suffixes
    from edgepose.formats.recordings.registry import recording_suffixes

    outputs = [output.suffix for output in SINKS.values() if output.suffix]
    return frozenset((*OTHER_ENDINGS, *outputs, *pose_suffixes(), *recording_suffixes()))


def check_output(name: str | Path, what: str, endings: Collection[str], overwrite: bool) -> None:
    """Check, before any work is done, that writing an output would lose nothing.

    Args:
        name: name of the output; "-", devices and pipes always pass.
        what: the output's content, for messages.
        endings: endings of its kind of files, such as ".csv".
        overwrite: whether an existing file may be replaced.

    Raises:
        EdgeposeError: the file exists, has the ending of another kind of file, or cannot be written.
    """
    target = find_target(name, what)
    if target.stream:
        return
    for path in (Path(name), target.path):
        ending = path.suffix.lower()
        if ending and ending not in endings and ending in known_endings():
            raise EdgeposeError(
                f"{name}: {ending} is the ending of another kind of file; for {what} use "
                f"{' or '.join(endings)}"
            )
    if target.exists and not overwrite:
        raise EdgeposeError(f"{name} already exists; choose another name or give --overwrite")
