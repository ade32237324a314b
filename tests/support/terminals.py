"""Terminals on which programs show what they do."""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import subprocess
import termios
from collections.abc import Iterator

from tests.support import processes


def take_terminal() -> None:
    """In a new session: the terminal on its standard input becomes its own, as a shell's is."""
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)


def own_terminal() -> None:
    """In a new process: it begins a session, and takes the terminal on its standard input."""
    os.setsid()
    take_terminal()


def rest_of(master: int) -> bytes:
    """All that is still written on a terminal, until nobody has it open."""
    text = b""
    with contextlib.suppress(OSError):  # Linux says so when the other side has closed
        while piece := os.read(master, 4096):
            text += piece
    return text


@contextlib.contextmanager
def ended(process: subprocess.Popen, master: int) -> Iterator[None]:
    """At the end, the process is gone and its terminal closed, whatever happened."""
    try:
        yield
    finally:
        process.kill()
        process.wait()
        os.close(master)


def on_a_terminal(command: list[object], **options: object) -> tuple[int, bytes]:
    """Runs a command whose output and messages go to a terminal: exit code, and all that came there."""
    master, slave = pty.openpty()
    options = {"stdin": subprocess.DEVNULL, "stdout": slave, "stderr": slave} | options
    process = processes.Popen(list(map(str, command)), **options)
    os.close(slave)
    with ended(process, master):
        text = rest_of(master)
        return process.wait(60), text
