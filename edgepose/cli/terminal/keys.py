"""Keys pressed on the terminal, read without blocking."""

from __future__ import annotations

import os
import select
import sys
import time
from types import TracebackType
from typing import Any

try:
    import termios
except ImportError:  # Windows
    termios = None  # type: ignore[assignment]


EVERY_S = 0.05
"""Time between two looks at the terminal, seconds: each takes several system calls."""


class Keys:
    """Reads single keys from standard input while it is entered; none if that is not a terminal."""

    def __init__(self) -> None:
        """Create the reader; `__enter__` changes the terminal's mode."""
        self._before: list[Any] | None = None
        self._next_s = 0.0

    def __enter__(self) -> Keys:
        """Deliver keys at once and without echo; Ctrl-C still interrupts."""
        if _usable():
            before = termios.tcgetattr(0)
            now = termios.tcgetattr(0)
            now[3] &= ~(termios.ICANON | termios.ECHO)
            termios.tcsetattr(0, termios.TCSADRAIN, now)
            self._before = before
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Restore the terminal's mode."""
        if self._before is not None and _in_foreground():
            termios.tcsetattr(0, termios.TCSADRAIN, self._before)

    @property
    def listening(self) -> bool:
        """Whether keys are read."""
        return self._before is not None

    def pressed(self) -> str:
        """Return the keys pressed since the last call; none within `EVERY_S` of a look at the terminal."""
        if self._before is None or (now_s := time.monotonic()) < self._next_s:
            return ""
        self._next_s = now_s + EVERY_S
        # The terminal stops a background program that reads from it.
        if not _in_foreground() or not select.select([0], [], [], 0.0)[0]:
            return ""
        try:
            return os.read(0, 256).decode(errors="ignore")
        except OSError:  # the terminal is gone
            return ""


def _usable() -> bool:
    return termios is not None and sys.stdin is not None and os.isatty(0) and _in_foreground()


def _in_foreground() -> bool:
    try:
        return os.tcgetpgrp(0) == os.getpgrp()
    except OSError:  # the terminal is gone
        return False
