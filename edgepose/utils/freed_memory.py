"""Keeping freed memory in the process, for programs that need as much of it again in every frame."""

from __future__ import annotations

import ctypes
from contextlib import suppress

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # parameters of glibc's mallopt(3)
_KEPT_BYTES = 1 << 25


def keep_freed_memory() -> None:
    """Stop the C library from returning freed memory to the system: getting it back costs page faults.

    Where the C library is not glibc, nothing happens.
    """
    with suppress(AttributeError, OSError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)
        mallopt(_MMAP_THRESHOLD, _KEPT_BYTES)
