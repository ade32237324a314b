"""Keys pressed on the terminal, read without waiting; the terminal is as before afterwards."""

from __future__ import annotations

import os
import select
import sys
from types import TracebackType
from typing import Any

try:
    import termios
except ImportError:  # Windows
    termios = None  # type: ignore[assignment]


class Keys:
    """Single keys from standard input while it is entered; none where that is no terminal."""

    def __init__(self) -> None:
        """The terminal is as it was until this is entered."""
        self._before: list[Any] | None = None

    def __enter__(self) -> Keys:
        """Keys come at once and unseen from now on; Ctrl-C stays what it is."""
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
        """The terminal is as before."""
        if self._before is not None and _in_foreground():
            termios.tcsetattr(0, termios.TCSADRAIN, self._before)

    @property
    def listening(self) -> bool:
        """Whether keys are read."""
        return self._before is not None

    def pressed(self) -> str:
        """The keys pressed since the last call."""
        # A program in the background that reads from the terminal is stopped by it.
        if self._before is None or not _in_foreground() or not select.select([0], [], [], 0.0)[0]:
            return ""
        try:
            return os.read(0, 256).decode(errors="ignore")
        except OSError:  # the terminal has gone
            return ""


def _usable() -> bool:
    return termios is not None and sys.stdin is not None and os.isatty(0) and _in_foreground()


def _in_foreground() -> bool:
    try:
        return os.tcgetpgrp(0) == os.getpgrp()
    except OSError:  # the terminal has gone
        return False
