"""Preparations of a new process before its program starts: arguments for `preexec_fn`.

All of them can be pickled, so that `processes.Popen` can fork the process from the warm Python.
"""

from __future__ import annotations

import ctypes
import os
import resource
import signal
from collections.abc import Callable
from functools import partial


def limit(kind: int, value: int) -> Callable[[], None]:
    """Set a limit of `resource`, such as RLIMIT_FSIZE."""
    return partial(resource.setrlimit, kind, (value, value))


def close(file: int) -> Callable[[], None]:
    """Close a standard stream."""
    return partial(os.close, file)


def ignore_hangup() -> None:
    """Ignore SIGHUP, as under nohup."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)


class _Header(ctypes.Structure):
    _fields_ = [("version", ctypes.c_uint32), ("pid", ctypes.c_int)]


class _Sets(ctypes.Structure):
    _fields_ = [(name, ctypes.c_uint32) for name in ("effective", "permitted", "inheritable")]


def mind_permissions() -> None:
    """Make the permissions of files and folders hold for root, too."""
    libc = ctypes.CDLL(None)
    header, sets = _Header(0x20080522, 0), (_Sets * 2)()
    libc.capget(ctypes.byref(header), ctypes.byref(sets))
    for capability in (1, 2):  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH
        libc.prctl(24, capability, 0, 0, 0)  # PR_CAPBSET_DROP, for a program that is executed
        for name, _ in _Sets._fields_:
            setattr(sets[0], name, getattr(sets[0], name) & ~(1 << capability))
    libc.capset(ctypes.byref(header), ctypes.byref(sets))
