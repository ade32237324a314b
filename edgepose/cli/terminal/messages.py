"""What is written for a person: messages on standard error, results on standard output.

Text of files and devices is in both, so all of it goes through here: nothing in it moves the cursor or sets
the clipboard. A message that nobody can read any more does not end a run.
"""

from __future__ import annotations

import logging
import os
import select
import stat
import sys
from typing import IO, Any

import click

_WAIT_MS = 1000
"""Time that the reader of messages has to take one."""

_status = False  # a line that shows how far a command is stands on the terminal, and the cursor at its end


def printable(text: str) -> str:
    """Text of anyone as a terminal may get it: what is not seen becomes "?", but for line breaks and tabs."""
    return "".join(c if c.isprintable() or c in "\n\t" else "?" for c in text)


def say(text: str) -> None:
    """A line for the user, on standard error; it takes the place of a status line."""
    global _status
    click.echo(("\r\033[K" if _status else "") + printable(text), err=True)
    _status = False


def show(text: str) -> None:
    """A line of what the command is for, on standard output."""
    end_status()
    click.echo(printable(text))


def status(text: str) -> None:
    """How far a command is: on a terminal in the place of what it said last, elsewhere as a line."""
    global _status
    if not has_terminal():
        click.echo(printable(text), err=True)
        return
    columns = max(20, os.get_terminal_size(2).columns or 80)
    click.echo(f"\r{printable(text)[: columns - 1]}\033[K", nl=False, err=True)
    _status = True


def end_status() -> None:
    """Leave the status line, if there is one, as it is, and go on below it."""
    global _status
    if _status:
        click.echo(err=True)
    _status = False


def clear_bar() -> None:
    """The next message takes the place of click's progress bar, which is drawn again below it."""
    global _status
    _status = has_terminal()


def has_terminal() -> bool:
    """Whether messages are read on a terminal."""
    return sys.stderr.isatty()


class _Handler(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        say(record.getMessage())


def prepare() -> None:
    """Once at the start: streams that are closed or go away do no harm from now on; warnings are messages."""
    _keep_numbers()
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115 - for the whole program
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115
    reconfigure = getattr(sys.stdout, "reconfigure", None)
    if reconfigure is not None:
        reconfigure(errors="backslashreplace")  # names of files may be no text
    sys.stderr = _Messages(sys.stderr)
    logging.basicConfig(handlers=[_Handler()])


def _keep_numbers() -> None:
    """Have something at the numbers of the standard streams: a file that got one would be written into."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free


class _Messages:
    """Standard error that loses what nobody reads: once its reader has gone, it leads nowhere."""

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream
        self._poll = _pipe_poll(stream)
        self._stuck = False

    def write(self, text: str) -> int:
        if self._poll is not None:
            # A reader that does not read is waited for once, not at each message.
            self._stuck = not self._poll.poll(0 if self._stuck else _WAIT_MS)
            if self._stuck:
                return len(text)
        try:
            return self._stream.write(text)
        except OSError:
            self._lead_nowhere()
            return len(text)

    def flush(self) -> None:
        if self._stuck:
            return
        try:
            self._stream.flush()
        except OSError:
            self._lead_nowhere()

    def _lead_nowhere(self) -> None:
        number = os.open(os.devnull, os.O_WRONLY)
        os.dup2(number, self._stream.fileno())
        os.close(number)
        self._poll = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _pipe_poll(stream: IO[str]) -> select.poll | None:
    """What tells whether a pipe can take a message; None for what is no pipe."""
    try:
        number = stream.fileno()
        mode = os.fstat(number).st_mode
    except (OSError, ValueError):  # no file of the operating system
        return None
    if not (stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode)):
        return None
    poll = select.poll()
    poll.register(number, select.POLLOUT)
    return poll
