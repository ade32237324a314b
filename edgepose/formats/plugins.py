"""File formats of other packages, which announce them by entry points of the group `edgepose.formats`."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points

GROUP = "edgepose.formats"
"""Each entry point of the group names a `RecordingFormat` or a `PoseFormat`."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FileFormat:
    """What every kind of format has.

    Attributes:
        suffixes: endings of its files, in lower case, with the dot.
    """

    suffixes: tuple[str, ...]


@cache
def plugin_formats() -> tuple[FileFormat, ...]:
    """Formats of installed packages; one that cannot be loaded costs a warning and nothing else."""
    found = []
    for point in entry_points(group=GROUP):
        try:
            loaded = point.load()
        except (Exception, SystemExit) as error:  # foreign code raises anything
            _log.warning("cannot load the file format %s (%s): %r", point.name, point.value, error)
            continue
        if isinstance(loaded, FileFormat):
            found.append(loaded)
        else:
            _log.warning(
                "the file format %s (%s) is no RecordingFormat or PoseFormat", point.name, point.value
            )
    return tuple(found)
