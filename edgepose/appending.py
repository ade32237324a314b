"""Writing files that grow for hours and must be whole whenever the power, the disk or the reader goes."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import stat
import sys
from pathlib import Path
from typing import Any

from edgepose.errors import EdgeposeError

FLUSH_S = 1.0
"""A killed program loses at most what came in this time, seconds."""


def open_output(path: str, what: str, *, replace: bool = True) -> Any:
    """A new file without a buffer; "-" is standard output.

    Args:
        path: of the file.
        what: what goes into it, for the message.
        replace: whether a file that is there already is replaced.

    Raises:
        EdgeposeError: it cannot be written, or is there already.
    """
    if path == "-":
        # Below Python's buffers: what they still held would fail at exit without a reader.
        sys.stdout.flush()
        return getattr(sys.stdout.buffer, "raw", sys.stdout.buffer)
    try:
        return Path(path).open("wb" if replace else "xb", buffering=0)
    except FileExistsError:
        raise EdgeposeError(f"{path} is there already; choose another name or give --overwrite") from None
    except OSError as error:
        raise EdgeposeError(explain(error, path, what)) from error


def is_regular(file: Any) -> bool:
    """Whether it is a file on a disk and not a pipe, a terminal or a device."""
    try:
        return stat.S_ISREG(os.fstat(file.fileno()).st_mode)
    except OSError:  # Not a file of the operating system, such as a captured standard output.
        return False


def write_rows(file: Any, rows: bytes) -> None:
    """Write whole lines; where that fails, a file on a disk ends at a whole line.

    Raises:
        OSError: as the system tells it.
    """
    done = 0
    try:
        while done < len(rows):
            count = file.write(rows[done:])
            if count is None:  # A pipe that another program has made non-blocking, and it is full.
                select.select([], [file], [])
            done += count or 0
    except OSError:
        if is_regular(file):
            _drop_end(file, done - (rows.rfind(b"\n", 0, done) + 1))
        raise


def explain(error: OSError, name: str, what: str) -> str:
    """The line for the user where writing has failed."""
    name = "standard output" if name == "-" else name
    if isinstance(error, BrokenPipeError):
        return f"the program that read the {what} from {name} has ended"
    if error.errno == errno.ENOENT:
        return f"cannot write {what} to {name}: its folder does not exist, create it first"
    if error.errno == errno.ENOSPC:
        return f"cannot write {what} to {name}: the disk is full; rows written before are complete"
    return f"cannot write {what} to {name}: {error.strerror or error}"


def _drop_end(file: Any, count: int) -> None:
    """Take the last `count` bytes, the beginning of a row, off the file."""
    with contextlib.suppress(OSError):  # The error that led here is the one to report.
        size = file.seek(0, os.SEEK_CUR) - count
        file.truncate(size)
        file.seek(size)
