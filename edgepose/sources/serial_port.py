"""Serial ports as transports."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable, Sequence
from itertools import cycle

import serial
from serial.tools import list_ports

from edgepose.errors import DeviceError
from edgepose.sources import POLL_S
from edgepose.sources.line_reader import LineDisconnectedError

try:
    from termios import error as _TerminalError  # not an OSError, and pyserial does not catch it
except ImportError:  # missing on Windows
    _TerminalError = OSError  # type: ignore[assignment, misc]

_HAS_FILES = os.name == "posix"

_ANSWER_S = 0.02
"""Longest time until a device starts to answer, seconds."""

_FULL = 4095
"""Bytes that the system buffers at a time; if it returns this many, more may follow a moment later."""

_EMPTY_S = 0.002
"""Wait for the first byte that shows that the system's buffers were empty, seconds."""

_MOST = 1 << 16
"""Most bytes read in one poll, so that a line that never pauses does not block the others."""


class SerialPort:
    """A serial port opened for exclusive use."""

    def __init__(self, name: str, baud: int, requests: Sequence[tuple[bytes, int]] = ()) -> None:
        """Open the port.

        Args:
            name: the system's name of the port.
            baud: speed, bit/s.
            requests: requests to send in turn, each with the length of its answer; empty if the devices send
                by themselves.

        Raises:
            DeviceError: the port does not exist, is in use, or may not be opened.
        """
        try:
            self._serial = serial.Serial(name, baud, timeout=POLL_S, exclusive=True)
        except OverflowError:
            raise DeviceError(f"{name}: no port has a speed of {baud} bit/s; check --baud") from None
        except (OSError, ValueError, _TerminalError) as error:
            raise DeviceError(f"{name}: {_opening_problem(error)}") from None
        self._requests = cycle(requests) if requests else None
        if requests:
            longest = max(len(request) + answer for request, answer in requests)
            self._serial.timeout = _ANSWER_S + longest * 10 / baud
        self._was_full = False

    def read(self) -> tuple[bytes, bool]:
        """See `Transport.read`."""
        data = b""
        try:
            if self._requests is not None:
                request, answer = next(self._requests)
                self._serial.write(request)
                data = self._serial.read(answer)
                return data + self._serial.read(self._serial.in_waiting), False
            start_s = time.monotonic()
            data = self._serial.read(1)
            if time.monotonic() - start_s > _EMPTY_S:
                self._was_full = False
            data += self._serial.read(self._serial.in_waiting)
            self._was_full |= len(data) >= _FULL
            return data, bool(data) and (self._was_full or self._serial.in_waiting > 0)
        except (OSError, _TerminalError):
            if data:
                return data, False  # the next read raises
            raise LineDisconnectedError from None

    @property
    def waiting(self) -> Callable[[], tuple[bytes, bool]] | None:
        """See `Transport.waiting`; None for request-response devices, whose answers have to be waited for."""
        return self._read_waiting if self._requests is None else None

    @property
    def file(self) -> int | None:
        """See `Transport.file`; None on Windows, whose ports are no files to wait for."""
        return self._serial.fileno() if _HAS_FILES and self._requests is None else None

    def _read_waiting(self) -> tuple[bytes, bool]:
        data = b""
        try:
            while len(data) < _MOST:
                chunk = self._read_now()
                data += chunk
                if len(chunk) < _FULL:
                    break
            if not data:
                _ = self._serial.in_waiting  # raises if the port has gone, which has no data either
        except BlockingIOError:
            pass
        except (OSError, _TerminalError):
            if not data:  # otherwise the next poll raises
                raise LineDisconnectedError from None
        return data, len(data) >= _FULL

    def _read_now(self) -> bytes:
        """Return data without waiting for any."""
        if _HAS_FILES:  # with a third of the system calls of pyserial
            return os.read(self._serial.fd, _MOST)
        count = self._serial.in_waiting
        data: bytes = self._serial.read(count) if count else b""
        return data

    def close(self) -> None:
        """See `Transport.close`."""
        self._serial.close()


def _opening_problem(error: Exception) -> str:
    code = getattr(error, "errno", None)
    if code in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        ports = ", ".join(sorted(port.device for port in list_ports.comports())) or "none"
        return f"no such port; ports here: {ports}"
    if code in (errno.EACCES, errno.EPERM):
        return (
            "no permission to open it; add yourself to the group dialout "
            "(sudo usermod -aG dialout $USER) and log in again"
        )
    if code in (errno.EAGAIN, errno.EBUSY):
        return "the port is in use by another program; close that first"
    return f"cannot open it as a serial port: {str(error).splitlines()[0]}"
