"""File formats one after the other: those of edgepose, then those of other packages.

Other packages announce theirs by entry points of the group `edgepose.formats`.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from pkgutil import resolve_name
from typing import TypeVar

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


Format = TypeVar("Format", bound=FileFormat)


def built_in_format(kind: type[Format], place: str) -> Format:
    """The format at a place, "module:constant", whose module is imported now."""
    known = resolve_name(place)
    assert isinstance(known, kind)
    return known


def all_formats(kind: type[Format], places: Iterable[str]) -> Iterator[Format]:
    """The formats of a kind: those at the places, imported one after the other, then those of plug-ins."""
    for place in places:
        yield built_in_format(kind, place)
    yield from (known for known in plugin_formats() if isinstance(known, kind))


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
