"""A page on a terminal that is drawn again and again in place, and goes away when it ends."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Sequence
from types import TracebackType

_ENTER, _LEAVE = "\033[?1049h\033[?25l", "\033[?25h\033[?1049l"  # another screen, and no cursor
_HOME, _LINE_END, _REST = "\033[H", "\033[K\r\n", "\033[J"


class Page:
    """The second screen of the terminal on standard output, so that what was there before comes back."""

    def __enter__(self) -> Page:
        """Show the page, empty."""
        self._write(_ENTER)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Show again what was there before."""
        self._write(_LEAVE)

    def draw(self, lines: Sequence[str]) -> None:
        """Replace what is shown; lines that do not fit on the screen are left out."""
        height = shutil.get_terminal_size().lines
        self._write(_HOME + "".join(line + _LINE_END for line in lines[: height - 1]) + _REST)

    def _write(self, text: str) -> None:
        sys.stdout.write(text)
        sys.stdout.flush()


def is_terminal() -> bool:
    """Whether standard output is a screen that can be drawn on."""
    return sys.stdout.isatty() and os.environ.get("TERM") != "dumb"


def is_coloured() -> bool:
    """Whether standard output shows colours and nobody minds (https://no-color.org)."""
    return is_terminal() and not os.environ.get("NO_COLOR")
