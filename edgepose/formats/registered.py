"""Registered file formats: those of edgepose, then those of plug-in packages.

Plug-ins register their formats as entry points of the group `edgepose.formats`.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from pkgutil import resolve_name
from typing import NamedTuple, TypeVar

GROUP = "edgepose.formats"
"""Each entry point of the group names a `RecordingFormat` or a `PoseFormat`."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FileFormat:
    """Base of all kinds of formats.

    Attributes:
        suffixes: endings of its files, in lower case, with the dot.
    """

    suffixes: tuple[str, ...]


class Reader(NamedTuple):
    """One line of a table of formats.

    Attributes:
        location: "module:constant" of the format; imported when a file may be of it.
        files: its files, for help texts, such as ".pkl of DIP-IMU".
    """

    location: str
    files: str


Format = TypeVar("Format", bound=FileFormat)


def built_in_format(kind: type[Format], reader: Reader) -> Format:
    """Import the format of a reader."""
    format = resolve_name(reader.location)
    assert isinstance(format, kind)
    return format


def all_formats(kind: type[Format], readers: Iterable[Reader]) -> Iterator[Format]:
    """Yield the formats of a kind: those of readers, imported one after the other, then those of plug-ins."""
    for reader in readers:
        yield built_in_format(kind, reader)
    yield from (format for format in plugin_formats() if isinstance(format, kind))


@cache
def plugin_formats() -> tuple[FileFormat, ...]:
    """Load the formats of installed packages; warn of those that cannot be loaded."""
    found = []
    for point in entry_points(group=GROUP):
        try:
            loaded = point.load()
        except (Exception, SystemExit) as error:  # plug-ins can raise anything
            _log.warning("cannot load the file format %s (%s): %r", point.name, point.value, error)
            continue
        if isinstance(loaded, FileFormat):
            found.append(loaded)
        else:
            _log.warning(
                "the file format %s (%s) is not a RecordingFormat or PoseFormat", point.name, point.value
            )
    return tuple(found)
