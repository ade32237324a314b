"""Kinds of error. The command line turns each into one line on standard error and an exit code."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class EdgeposeError(Exception):
    """Bad input or a broken device.

    The message is for the user: what is wrong, where (file, row, sensor, byte), and what to do. It has no
    trailing full stop and no line break.
    """


class ConfigError(EdgeposeError):
    """A flag, a key or a value of the configuration is missing, unknown or not valid."""


class DeviceError(EdgeposeError):
    """A port, bus or address cannot be opened, or a device says nothing usable."""


class FileFormatError(EdgeposeError):
    """A file is damaged, or not of the kind that it should be."""


class CalibrationError(EdgeposeError):
    """A wearer cannot be calibrated from what the sensors say, or a calibration does not fit."""


class ModelError(EdgeposeError):
    """A model archive is missing, damaged, not trusted, or cannot run here."""


def as_edgepose_error(error: Exception) -> EdgeposeError:
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
def prefix_errors(whose: str) -> Iterator[None]:
    """Errors say whose they are, if there is a name."""
    try:
        yield
    except EdgeposeError as error:
        if not whose:
            raise
        raise EdgeposeError(f"{whose}: {error}") from error
