"""Sources, licences, actors and parts of takes, by the rules in `sources.toml`."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable
from pathlib import Path, PurePath
from typing import NamedTuple

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

RULES = Path(__file__).parent / "sources.toml"
"""The rules."""

OWN = "own"
"""Source of takes that no rule knows."""

UNKNOWN = "unknown"
"""Licence of takes that no rule knows, unless the user states one."""


class Source(NamedTuple):
    """Where motion comes from.

    Attributes:
        name: name, as in `[shares]` of a config and in recipes.
        license: text of the licence, with attribution.
        free: whether weights trained on the motion may be used by anybody for anything.
    """

    name: str
    license: str
    free: bool


class TakeInfo(NamedTuple):
    """What the path of a take says about it.

    Attributes:
        source: where its motion comes from.
        actor: key of the body and zero pose, shared by takes of one actor.
        part: part of the split: one of `HELD_OUT` or `VALIDATION`, "train" or "unused".
    """

    source: Source
    actor: str
    part: str


_TABLE = tomllib.loads(RULES.read_text(encoding="utf-8"))


def _pattern(takes: str) -> re.Pattern[str]:
    """Return a pattern that finds takes at the end of a path, up to the first dot of the file name."""
    return re.compile(rf"(?:^|/)(?:{takes})(?:\.[^/]*)?$")


SOURCES = {
    name: Source(name, _TABLE["licenses"][rule["license"]], rule["free"])
    for name, rule in _TABLE["source"].items()
}
"""The sources by name, without the user's own motion."""

_SOURCE_PATTERNS = [
    (_pattern(rule["takes"]), SOURCES[name], rule["actor"]) for name, rule in _TABLE["source"].items()
]

HELD_OUT = tuple(_TABLE["test"])
"""Parts that are never used in training, nor for any choice."""

VALIDATION = tuple(_TABLE["validation"])
"""Parts for early stopping and other choices."""

_PART_PATTERNS = [
    (_pattern(rule["takes"]), "unused" if kind == "unused" else part)
    for kind in ("unused", "test", "validation")
    for part, rule in _TABLE[kind].items()
]

GROUPS = {name: tuple(parts) for name, parts in _TABLE["groups"].items()} | {"validation": VALIDATION}
"""Names for several parts together."""

ABOUT = {part: rule["about"] for kind in ("test", "validation") for part, rule in _TABLE[kind].items()}
"""What the takes of each part are, for cards and documentation."""


def single_parts(parts: Iterable[str]) -> list[str]:
    """Return parts without the groups of them, unless there are only groups."""
    given = list(parts)
    return [part for part in given if part not in GROUPS] or given


def _text(path: PurePath | str) -> str:
    return PurePath(path).as_posix()


def part_of(path: PurePath | str) -> str:
    """Return the part that a take belongs to, see `TakeInfo.part`, by its path without suffix."""
    text = _text(path)
    return next((part for pattern, part in _PART_PATTERNS if pattern.search(text)), "train")


def take_info(path: PurePath | str) -> TakeInfo:
    """Return what is known about a take by its path without suffix, relative to the folder of the motion.

    Of the user's own motion, each folder is an actor.
    """
    text, part = _text(path), part_of(path)
    for pattern, source, actor in _SOURCE_PATTERNS:
        match = pattern.search(text)
        if match:
            return TakeInfo(source, actor.format(**match.groupdict(default="")).strip(), part)
    return TakeInfo(Source(OWN, UNKNOWN, False), f"{OWN} {PurePath(path).parent.as_posix()}", part)
