"""Suggestions for names that were mistyped."""

from __future__ import annotations

from collections.abc import Iterable


def similar_names(name: str, names: Iterable[str]) -> str:
    """Return the known names that are similar to one, such as "'check' or 'convert'"; or an empty text."""
    from difflib import get_close_matches

    return " or ".join(repr(near) for near in get_close_matches(name, list(names), n=2))


def choices(name: str, names: Iterable[str], listed: str = "known are") -> str:
    """Return the end of a message on an unknown name: similar names to choose from, or else all of them."""
    known = list(names)
    similar = "" if name in known else similar_names(name, known)
    return f"did you mean {similar}?" if similar else f"{listed} {', '.join(known)}"
