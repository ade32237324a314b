"""Exceptions. The command line turns each into one line on standard error and an exit code."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager


class EdgeposeError(Exception):
    """Bad input or a broken device.

    The message is written for the user: what is wrong, where (file, row, sensor, byte), and what to do. It
    has no trailing full stop and no line break.
    """


class ConfigError(EdgeposeError):
    """A flag, key or value of the configuration is missing, unknown or invalid."""


class DeviceError(EdgeposeError):
    """A port, bus or address cannot be opened, or a device sends nothing usable."""


class FileFormatError(EdgeposeError):
    """A file is damaged or of the wrong kind."""


class CalibrationError(EdgeposeError):
    """A wearer cannot be calibrated from the sensors' data, or a calibration does not fit."""


class ModelError(EdgeposeError):
    """A model archive is missing, damaged, not trusted, or cannot run on this machine."""


def as_edgepose_error(error: Exception) -> EdgeposeError:
    """Return an error in the form shown to the user, with an unexpected exception as its cause."""
    if isinstance(error, EdgeposeError):
        return error
    text = (str(error).splitlines() or [""])[0]
    if isinstance(error, ModuleNotFoundError) and error.name == "torch":
        reported = EdgeposeError("this needs PyTorch, which is not installed; see docs/guide/install.md")
    elif isinstance(error, MemoryError):
        reported = EdgeposeError("not enough memory; use a shorter file")
    elif isinstance(error, OSError) and error.filename is not None and error.strerror:
        name = str(error.filename)  # the system's answer about a file, such as a name that is too long
        reported = EdgeposeError(f"{name if len(name) <= 200 else f'{name[:200]}...'}: {error.strerror}")
    elif isinstance(error, OSError) and error.errno == errno.ENOSPC:  # of standard output, without a name
        reported = EdgeposeError("cannot write the result: the disk is full")
    else:
        reported = EdgeposeError(
            f"unexpected error ({type(error).__name__}: {text}); please report it, with the output of "
            "edgepose --debug"
        )
    reported.__cause__ = error
    return reported


@contextmanager
def prefix_errors(name: str) -> Iterator[None]:
    """Prefix errors with a name, such as the wearer's, unless it is empty."""
    try:
        yield
    except EdgeposeError as error:
        if not name:
            raise
        raise EdgeposeError(f"{name}: {error}") from error
