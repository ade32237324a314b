"""The split of takes into training, validation and held-out parts, by the rules in `splits.toml`."""

from __future__ import annotations

import re
import sys
from pathlib import Path

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

SPLITS = Path(__file__).parent / "splits.toml"
"""The rules of the split."""

_RULES = tomllib.loads(SPLITS.read_text(encoding="utf-8"))

HELD_OUT = tuple(_RULES["held-out"])
"""Parts of the split that are never used in training."""

_PATTERNS = [(part, re.compile(pattern)) for part, pattern in _RULES["held-out"].items()]
_PATTERNS += [("validation", re.compile(pattern)) for pattern in _RULES["validation"].values()]


def part_of(name: str) -> str:
    """Return the part that a take belongs to, by its name: one of `HELD_OUT`, "validation" or "train"."""
    return next((part for part, pattern in _PATTERNS if pattern.search(name)), "train")
