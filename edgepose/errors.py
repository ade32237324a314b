"""The one exception that the command line turns into a line on stderr and exit code 1."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class EdgeposeError(Exception):
    """Bad input or a broken device.

    The message is for the user: what is wrong, where (file, row, sensor, byte), and what to do. It has no
    trailing full stop and no line break.
    """


@contextmanager
def named(whose: str) -> Iterator[None]:
    """Errors say whose they are, where he has a name."""
    try:
        yield
    except EdgeposeError as error:
        if not whose:
            raise
        raise EdgeposeError(f"{whose}: {error}") from error
