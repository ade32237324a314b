"""Opening .npz files, which anybody may have made: what damaged ones raise, how large they may be."""

from __future__ import annotations

import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.lib.npyio import NpzFile

from edgepose.errors import FileFormatError

MAX_BYTES = 2 << 30
"""That a file may take in memory: hours of poses or samples."""

_FREE_BYTES = 256 << 20  # up to which the ratio does not matter: a simulated rest packs well
_MAX_RATIO = 100  # real recordings and poses pack less than 3:1

BROKEN = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    ValueError,
    TypeError,
    KeyError,
    RuntimeError,  # passwords; NotImplementedError for odd compression is one, too
    MemoryError,
    # An array's header is Python text, which numpy parses.
    SyntaxError,
    tokenize.TokenError,
)
"""To be caught around reading one; OSError, of a file that is not there, apart."""


def check_size(path: Path, size: int) -> None:
    """Hold a file of any kind to what a true one becomes in memory, `size` bytes.

    Raises:
        FileFormatError: it is far too large, in itself or for a file as small as this.
    """
    if size > MAX_BYTES or size > max(_FREE_BYTES, _MAX_RATIO * path.stat().st_size):
        raise FileFormatError(
            f"{path}: unpacks to {size >> 20} MB; files are read up to {MAX_BYTES >> 20} MB, and up to "
            f"{_MAX_RATIO} times their own size"
        )


def _check_regular(path: Path) -> None:
    """Raises ValueError for what has no end, such as a device."""
    if path.exists() and not path.is_file():
        raise ValueError("it is no file on a disk")


def member_names(path: Path) -> set[str]:
    """Names of what is in a file; those of arrays end in .npy. Raises what `open_npz` raises."""
    _check_regular(path)
    with zipfile.ZipFile(path) as archive:
        return set(archive.namelist())


@contextmanager
def open_npz(path: Path) -> Iterator[NpzFile]:
    """The arrays of a file, none of which is unpacked yet.

    Raises:
        FileFormatError: together they are too large, see `check_size`.
        OSError: it cannot be read; all of `BROKEN`: it is no such file, here or where an array is taken out.
    """
    _check_regular(path)
    # A file of ours, because numpy leaves its own open where there is no archive in it.
    with path.open("rb") as file:
        with zipfile.ZipFile(file) as archive:
            # Sizes as declared are the most that zipfile unpacks.
            check_size(path, sum(member.file_size for member in archive.infolist()))
        file.seek(0)
        with np.load(file, allow_pickle=False) as arrays:
            yield arrays
