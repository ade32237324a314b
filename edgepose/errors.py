"""The one exception that the command line turns into a line on stderr and exit code 1."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class EdgeposeError(Exception):
    """Bad input or a broken device.

    The message is for the user: what is wrong, where (file, row, sensor, byte), and what to do. It has no
    trailing full stop and no line break.
    """


def as_told(error: Exception) -> EdgeposeError:
    """An error as the user is told of it; what nobody has foreseen is the cause of what it becomes."""
    if isinstance(error, EdgeposeError):
        return error
    text = (str(error).splitlines() or [""])[0]
    if isinstance(error, MemoryError):
        told = EdgeposeError("not enough memory; give it a shorter file")
    else:
        told = EdgeposeError(
            f"an unexpected fault ({type(error).__name__}: {text}); please report it, with what "
            "edgepose --debug shows"
        )
    told.__cause__ = error
    return told


@contextmanager
def named(whose: str) -> Iterator[None]:
    """Errors say whose they are, where he has a name."""
    try:
        yield
    except EdgeposeError as error:
        if not whose:
            raise
        raise EdgeposeError(f"{whose}: {error}") from error
