"""Ptys that hidapi takes for HID devices.

Only root can make a HID device, and only with a kernel module that many machines lack. hidapi asks the kernel
one question about a file before it reads it: the ioctl HIDIOCGRDESCSIZE. A seccomp filter answers it with
success for all files. The rest is real: hidapi opens, waits for and reads the file, and is hung up on.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Result = TypeVar("Result")

_HIDIOCGRDESCSIZE = 0x80044801
_IOCTL = {"x86_64": 16, "aarch64": 29}
_NO_NEW_PRIVS, _SECCOMP, _FILTER = 38, 22, 2
_LOAD, _JUMP_IF_EQUAL, _RETURN = 0x20, 0x15, 0x06
_SUCCEED, _ALLOW = 0x00050000, 0x7FFF0000
_NUMBER_AT, _REQUEST_AT = 0, 24  # in what a filter sees of a system call


def take_files_for_hid_devices() -> None:
    """From now on, this thread and those that it starts do so; also for `preexec_fn` of a process."""
    steps = [
        (_LOAD, 0, 0, _NUMBER_AT),
        (_JUMP_IF_EQUAL, 0, 3, _IOCTL[platform.machine()]),
        (_LOAD, 0, 0, _REQUEST_AT),
        (_JUMP_IF_EQUAL, 0, 1, _HIDIOCGRDESCSIZE),
        (_RETURN, 0, 0, _SUCCEED),
        (_RETURN, 0, 0, _ALLOW),
    ]
    program = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *step) for step in steps))
    header = struct.pack("HxxxxxxQ", len(steps), ctypes.addressof(program))
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_NO_NEW_PRIVS, 1, 0, 0, 0) or libc.prctl(_SECCOMP, _FILTER, header, 0, 0):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def with_hid_devices(function: Callable[[], Result]) -> Result:
    """Call a function in a thread that takes files for HID devices."""
    with ThreadPoolExecutor(1, initializer=take_files_for_hid_devices) as thread:
        return thread.submit(function).result()
