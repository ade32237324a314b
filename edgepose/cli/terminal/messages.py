"""Text for the user: messages on standard error, results on standard output.

Both contain text from files and devices, so all of it is cleaned here: no escape sequence in it can move the
cursor or set the clipboard. A message that no one reads any more does not end a run.
"""

from __future__ import annotations

import logging
import os
import select
import stat
import sys
import textwrap
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import IO, Any

import click

_WAIT_MS = 1000
"""Longest wait for a slow reader of standard error, milliseconds."""

LEAST_COLUMNS = 20
"""Narrowest terminal that messages are fitted into; some report a width of 0."""

_LONGEST_LINE = 4000
"""Longest line of a message, characters; longer ones quote damaged files and are cut off."""

_status = False  # whether the cursor stands at the end of a status line
_bar = False  # whether a progress bar is shown, which is drawn again below a message
_lock = threading.RLock()  # threads of outputs write messages, too


def printable(text: str) -> str:
    """Return text with "?" for all unprintable characters except line breaks and tabs."""
    return "".join(c if c.isprintable() or c in "\n\t" else "?" for c in text)


def say(text: str) -> None:
    """Write a message to standard error, over the status line or progress bar if there is one."""
    global _status
    with _lock:
        click.echo(
            ("\r\033[K" if _status or _bar else "") + wrapped(printable(_shortened(text)), sys.stderr),
            err=True,
        )
        _status = False


def _shortened(text: str) -> str:
    return "\n".join(
        line if len(line) <= _LONGEST_LINE else f"{line[:_LONGEST_LINE]} ..." for line in text.split("\n")
    )


def wrapped(text: str, stream: IO[str]) -> str:
    """Return text whose lines fit the terminal of a stream, broken between words; unchanged elsewhere."""
    columns = _columns(stream)
    if columns is None:
        return text
    return "\n".join(piece for line in text.split("\n") for piece in pieces(line, columns))


def pieces(line: str, columns: int) -> list[str]:
    """Return a line broken between words into pieces that fit a number of columns."""
    if len(line) <= columns:
        return [line]
    return textwrap.wrap(
        line,
        columns,
        subsequent_indent="  ",
        replace_whitespace=False,
        break_long_words=False,  # names and addresses stay whole, so that they can be copied
        break_on_hyphens=False,
    )


def _columns(stream: IO[str]) -> int | None:
    """Return the width of the terminal that a stream leads to; None if it leads elsewhere."""
    if not stream.isatty():
        return None
    try:
        return max(LEAST_COLUMNS, os.get_terminal_size(stream.fileno()).columns or 80)
    except OSError:  # the terminal is gone
        return None


def show(text: str) -> None:
    """Write a line of the command's result to standard output."""
    end_status()
    click.echo(printable(text))


def status(text: str) -> None:
    """Show the progress of a command: on a terminal in one status line, elsewhere as a new line."""
    global _status
    columns = _columns(sys.stderr)
    with _lock:
        if columns is None:
            click.echo(printable(text), err=True)
            return
        click.echo(f"\r{printable(text)[: columns - 1]}\033[K", nl=False, err=True)
        _status = True


def end_status() -> None:
    """Keep the status line, if there is one, and continue below it."""
    global _status
    with _lock:
        if _status:
            click.echo(err=True)
        _status = False


@contextmanager
def progress_bar(length: int, label: str, hidden: bool = False) -> Iterator[Any]:
    """Show a progress bar on a terminal, below all messages.

    Args:
        length: number of steps.
        label: shown before the bar.
        hidden: show none.

    Yields:
        An object with a method `update(steps)`.
    """
    global _bar
    hidden = hidden or not has_terminal()
    with click.progressbar(length=length, label=label, show_pos=True, file=sys.stderr, hidden=hidden) as bar:
        _bar = not hidden
        try:
            yield bar
        finally:
            _bar = False


def has_terminal() -> bool:
    """Return whether messages go to a terminal."""
    return sys.stderr.isatty()


class _Handler(logging.Handler):
    def __init__(self, receive: Callable[[str], None]) -> None:
        super().__init__()
        self._receive = receive

    def emit(self, record: logging.LogRecord) -> None:
        self._receive(record.getMessage())


@contextmanager
def warnings_to(receive: Callable[[str], None], hidden: bool) -> Iterator[None]:
    """Pass the program's warnings to a function while the context is entered.

    Args:
        receive: called with each warning, printable.
        hidden: do not write them to standard error as well.
    """
    handler = _Handler(lambda text: receive(printable(text)))
    logger = logging.getLogger("edgepose")
    logger.addHandler(handler)
    logger.propagate = not hidden
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.propagate = True


def prepare() -> None:
    """Set up the standard streams at the start of the program.

    Streams may be closed at the start or break later, and log records become messages.
    """
    _reserve_standard_descriptors()
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115 - open until exit
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115
    reconfigure = getattr(sys.stdout, "reconfigure", None)
    if reconfigure is not None:
        reconfigure(errors="backslashreplace")  # file names may be undecodable
    sys.stderr = _Messages(sys.stderr)
    logging.basicConfig(handlers=[_Handler(say)])


def _reserve_standard_descriptors() -> None:
    """Open closed standard descriptors, or the next file opened would get one and receive their output."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free descriptor


class _Messages:
    """Standard error that drops messages which no one reads, and all of them once its reader is gone."""

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream
        self._poll = _pipe_poll(stream)
        self._stuck = False

    def write(self, text: str) -> int:
        if self._poll is not None:
            # Wait only for the first message that the reader does not take, not for every one.
            self._stuck = not self._poll.poll(0 if self._stuck else _WAIT_MS)
            if self._stuck:
                return len(text)
        try:
            return self._stream.write(text)
        except OSError:
            self._discard()
            return len(text)

    def flush(self) -> None:
        if self._stuck:
            return
        try:
            self._stream.flush()
        except OSError:
            self._discard()

    def _discard(self) -> None:
        number = os.open(os.devnull, os.O_WRONLY)
        os.dup2(number, self._stream.fileno())
        os.close(number)
        self._poll = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _pipe_poll(stream: IO[str]) -> select.poll | None:
    """Return a poll object that reports whether a pipe accepts writes; None if the stream is not a pipe."""
    try:
        number = stream.fileno()
        mode = os.fstat(number).st_mode
    except (OSError, ValueError):  # the stream has no file descriptor
        return None
    if not (stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode)):
        return None
    poll = select.poll()
    poll.register(number, select.POLLOUT)
    return poll
