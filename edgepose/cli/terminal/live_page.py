"""A page that is redrawn in place on a terminal and disappears when it is closed."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Sequence
from types import TracebackType

_ENTER, _LEAVE = "\033[?1049h\033[?25l", "\033[?25h\033[?1049l"  # alternate screen, hidden cursor
_HOME, _LINE_END, _REST = "\033[H", "\033[K\r\n", "\033[J"


class Page:
    """The alternate screen of the terminal on standard output."""

    def __enter__(self) -> Page:
        """Show an empty page."""
        self._write(_ENTER)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Show the previous contents of the terminal again."""
        self._write(_LEAVE)

    def draw(self, lines: Sequence[str]) -> None:
        """Replace the contents of the page; lines below the bottom of the screen are left out."""
        height = shutil.get_terminal_size().lines
        self._write(_HOME + "".join(line + _LINE_END for line in lines[: height - 1]) + _REST)

    def _write(self, text: str) -> None:
        sys.stdout.write(text)
        sys.stdout.flush()


def is_terminal() -> bool:
    """Return whether standard output is a terminal with cursor control."""
    return sys.stdout.isatty() and os.environ.get("TERM") != "dumb"


def is_coloured() -> bool:
    """Return whether to use colours on standard output (see https://no-color.org)."""
    return is_terminal() and not os.environ.get("NO_COLOR")
