"""Safe opening of untrusted .npz files: the exceptions that damaged ones raise, limits on their size.

The exceptions are those of other zip files, too.
"""

from __future__ import annotations

import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray

from edgepose.errors import FileFormatError

try:
    from lzma import LZMAError
except ImportError:  # a Python built without it, whose zipfile raises RuntimeError
    LZMAError = RuntimeError  # type: ignore[misc,assignment]

MAX_BYTES = 2 << 30
"""Most memory that a file may take, enough for hours of poses or samples."""

_FREE_BYTES = 256 << 20  # size below which the ratio is not limited: simulated data at rest compress well
_MAX_RATIO = 100  # real recordings and poses compress by less than 3:1

_LONGEST_NAME = 60  # characters of a name in a message

BROKEN = (
    zipfile.BadZipFile,
    zlib.error,
    LZMAError,
    EOFError,
    ValueError,
    TypeError,
    KeyError,
    RuntimeError,  # passwords, and its subclass NotImplementedError for unknown compression
    MemoryError,
    # numpy parses an array's header as Python source.
    SyntaxError,
    tokenize.TokenError,
)
"""Exceptions to catch around reading a file, besides OSError for one that does not exist."""


def check_size(path: Path, size: int) -> None:
    """Check that a compressed file of any kind does not take too much memory, `size` bytes.

    Raises:
        FileFormatError: it is far too large, in itself or in relation to the file.
    """
    if size > MAX_BYTES or size > max(_FREE_BYTES, _MAX_RATIO * path.stat().st_size):
        raise FileFormatError(
            f"{path}: unpacks to {size >> 20} MB; the limits are {MAX_BYTES >> 20} MB and {_MAX_RATIO} times "
            "the size of the file"
        )


def _check_regular(path: Path) -> None:
    """Raise ValueError for files without an end, such as devices."""
    if path.exists() and not path.is_file():
        raise ValueError("it is not a file on a disk")


def member_names(path: Path) -> set[str]:
    """Return the names in a file; those of arrays end in .npy. Raises the same as `open_npz`."""
    _check_regular(path)
    with zipfile.ZipFile(path) as archive:
        return set(archive.namelist())


class Arrays(Mapping[str, NDArray[Any]]):
    """The arrays of a file by name; numpy would return the bytes of a member that is no array."""

    def __init__(self, file: NpzFile) -> None:
        """Wrap an open file."""
        self.files = list(file.files)
        self._file = file

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Unpack an array; raise one of `BROKEN` if it is damaged, or not an array."""
        array = self._file[name]
        if not isinstance(array, np.ndarray):
            raise ValueError(f"{name[:_LONGEST_NAME]!r} is not an array")
        return array

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names."""
        return iter(self.files)

    def __len__(self) -> int:
        """Return the number of arrays."""
        return len(self.files)


@contextmanager
def open_npz(path: Path) -> Iterator[Arrays]:
    """Open a file for reading arrays, which are unpacked on access.

    Raises:
        FileFormatError: the arrays together are too large, see `check_size`.
        OSError: the file cannot be read. Any of `BROKEN`: it is damaged, here or on access to an array.
    """
    _check_regular(path)
    # Opened here, because numpy does not close a file that is not an archive.
    with path.open("rb") as file:
        with zipfile.ZipFile(file) as archive:
            # zipfile unpacks no more than the declared sizes.
            check_size(path, sum(member.file_size for member in archive.infolist()))
        file.seek(0)
        with np.load(file, allow_pickle=False) as arrays:
            yield Arrays(arrays)
