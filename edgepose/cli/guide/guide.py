"""The guide: shows stages and messages to the wearer wherever they look."""

from __future__ import annotations

import select
import shutil
import sys
import time
from contextlib import ExitStack
from types import TracebackType

from edgepose.cli.guide.phone_page import PhonePage
from edgepose.cli.guide.stage import DONE, WAIT, Stage
from edgepose.cli.guide.terminal_page import page_lines
from edgepose.cli.terminal import messages as terminal
from edgepose.cli.terminal.live_page import Page, is_terminal

_REDRAW_S = 0.1
_BELL = "\a"


class Guide:
    """Shows what a wearer is to do: on a terminal as a page, elsewhere in lines, and on a phone if asked.

    Attributes:
        phone: the page for a phone; None if there is none.
    """

    def __init__(self, err: bool = False, phone: PhonePage | None = None) -> None:
        """Create the guide.

        Args:
            err: write lines to stderr, because stdout carries the result; there is no page on the terminal.
            phone: the page for a phone.
        """
        self.phone = phone
        self._err = err
        self._page: Page | None = None
        self._notes: list[str] = []
        self._unsaid: list[str] = []  # on the page, but not on the normal screen
        self._shown: tuple[Stage, int] | None = None
        self._drawn_s = 0.0
        self._open = ExitStack()  # the page, while there is one

    def __enter__(self) -> Guide:
        """Return the guide."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the page on the terminal."""
        self.close_page()

    def __call__(self, text: str) -> None:
        """Show a message."""
        text = terminal.printable(text)
        self._notes = [*self._notes[-9:], text]
        if self._page is not None:
            self._unsaid.append(text)
        elif self._err:
            terminal.say(text)
        else:
            terminal.show(terminal.wrapped(text, sys.stdout))

    def command(self, text: str) -> None:
        """Show a command, in one line, to be copied."""
        if self._err:
            terminal.say(f"  {text}")
        else:
            terminal.show(f"  {text}")

    def instruct(self, text: str) -> None:
        """Show a message that stages contain, too, where they are not shown as a page."""
        if not self._has_page:
            self(text)

    @property
    def _has_page(self) -> bool:
        return is_terminal() and not self._err

    def begin(self) -> None:
        """Announce the next stage, even if it is the same again."""
        self._shown = None

    def show(self, stage: Stage, passed_s: float = 0.0) -> None:
        """Show a stage of which some seconds have passed."""
        is_new = self._shown is None or self._shown[0] != stage
        first = self._shown is None or self._shown != (stage, int(passed_s))
        self._shown = stage, int(passed_s)
        if self.phone is not None:
            self.phone.show(stage, passed_s, self._notes)
        if self._has_page:
            self._draw(stage, passed_s, is_new)
        elif first and (passed_s < stage.total_s or not stage.total_s):
            line = stage.line(int(passed_s))
            if line is not None:
                self(line)

    def _draw(self, stage: Stage, passed_s: float, is_new: bool) -> None:
        if self._page is None:
            self._page = self._open.enter_context(Page())
            self._open.enter_context(terminal.warnings_to(self, hidden=True))
        now_s = time.monotonic()
        if is_new or now_s - self._drawn_s >= _REDRAW_S:
            self._drawn_s = now_s
            size = shutil.get_terminal_size()
            self._page.draw(page_lines(stage, passed_s, self._notes, size.columns, size.lines))
        if is_new:
            sys.stdout.write(_BELL)
            sys.stdout.flush()

    def close_page(self) -> None:
        """Leave the page on the terminal, and show the messages that were on it."""
        if self._page is None:
            return
        self._open.close()
        self._page = None
        unsaid, self._unsaid = self._unsaid, []
        for text in unsaid:
            self(text)

    @property
    def can_start(self) -> bool:
        """Whether there is a button or a key to press."""
        return self.phone is not None or (sys.stdin is not None and sys.stdin.isatty())

    def started(self) -> bool:
        """Return whether the wearer has pressed start on the phone, or Enter on the terminal."""
        return (self.phone is not None and self.phone.pressed() == "start") or _enter_pressed()

    def wants_repeat(self, stage: Stage) -> bool:
        """Show the end of a calibration, and wait for the phone's answer; without a phone, return False."""
        if self.phone is None:
            return False
        self.close_page()
        self.phone.show(stage, 0.0, self._notes)
        self("Press repeat or finish on the phone, or Enter here to finish.")
        while True:
            answer = self.phone.pressed()
            if answer in ("repeat", "finish") or _enter_pressed():
                return answer == "repeat"
            time.sleep(_REDRAW_S)


def start_stage(text: str, figure: str) -> Stage:
    """Return the stage that waits for the wearer to press start."""
    return Stage(WAIT, "START", text, figure)


def end_stage(word: str, text: str, figure: str) -> Stage:
    """Return the stage that shows the result."""
    return Stage(DONE, word, text, figure)


def _enter_pressed() -> bool:
    """Return whether a line waits on a terminal, and take it."""
    if sys.stdin is None or not sys.stdin.isatty() or not select.select([sys.stdin], [], [], 0.0)[0]:
        return False
    sys.stdin.readline()
    return True
