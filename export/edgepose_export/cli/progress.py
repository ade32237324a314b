"""Progress output: a bar on a terminal, otherwise an occasional line."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

from edgepose.cli.terminal.messages import has_terminal, progress_bar, say

T = TypeVar("T")

PLAIN_EVERY_S = 10.0
"""Least time between two lines, seconds."""


def progress(items: Iterable[T], label: str, count: int) -> Iterator[T]:
    """Yield `count` items and report on stderr how many are done."""
    if has_terminal():
        with progress_bar(count, label) as bar:
            for item in items:
                yield item
                bar.update(1)
        return
    last = time.monotonic()
    for i, item in enumerate(items):
        yield item
        if time.monotonic() - last > PLAIN_EVERY_S:
            last = time.monotonic()
            say(f"{label}: {i + 1} of {count}")


def labelled(label: str):  # type: ignore[no-untyped-def]
    """Return `progress` with a fixed label."""

    def show(items: Iterable[T]) -> Iterator[T]:
        known = list(items)
        return progress(known, label, len(known))

    return show
