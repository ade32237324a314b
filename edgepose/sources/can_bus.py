"""CAN buses as transports, and logs of CAN buses, through python-can."""

from __future__ import annotations

import contextlib
import logging
import sqlite3
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can

from edgepose.errors import DeviceError, FileFormatError
from edgepose.sources import POLL_S
from edgepose.sources.line_reader import LineDisconnectedError

# python-can warns about every vendor library and every clock that is not installed.
logging.getLogger("can").setLevel(logging.CRITICAL)

_LATEST_S = 1e11  # 5000 years of Unix time
_BLF_OBJECT, _BLF_HEAD = b"LOBJ", struct.Struct("<4sHHII")
_MOST = 256
"""Most messages read at a time."""


class Buffered:
    """A serial port that fetches all available bytes at once, however few of them are read.

    python-can reads slcan adapters byte by byte, with two system calls per byte. The frames of six sensors
    would take 4 ms, which would add to the error of the arrival times of devices that send no time.
    """

    def __init__(self, port: Any) -> None:
        """Start with an empty buffer."""
        self._port = port
        self._data = b""
        self._at = 0

    @property
    def in_waiting(self) -> int:
        """Number of bytes that can be read without waiting: those in the buffer, if any, or in the port."""
        return len(self._data) - self._at or self._port.in_waiting

    def read(self, size: int = 1) -> bytes:
        """Read up to `size` bytes, waiting for the first as long as the port does."""
        if self._at == len(self._data):
            self._data = self._port.read(1)
            self._data += self._port.read(self._port.in_waiting)
            self._at = 0
        data = self._data[self._at : self._at + size]
        self._at += len(data)
        return data

    def reset_input_buffer(self) -> None:
        """Discard all data received so far."""
        self._data, self._at = b"", 0
        self._port.reset_input_buffer()

    def __getattr__(self, name: str) -> Any:
        """Forward everything else to the port."""
        return getattr(self._port, name)


class CanBus:
    """An open CAN bus.

    Attributes:
        waiting: see `Transport.waiting`; None, because not all of python-can's interfaces can be polled.
    """

    waiting = None

    def __init__(self, name: str, bitrate: int, fd: bool) -> None:
        """Open the bus.

        Args:
            name: INTERFACE:CHANNEL, in python-can's names.
            bitrate: speed, bit/s, for interfaces that python-can configures; the system sets SocketCAN's.
            fd: receive CAN FD frames too.

        Raises:
            DeviceError: no such interface or channel, or it cannot be opened.
        """
        interface, _, channel = name.partition(":")
        if interface not in can.VALID_INTERFACES:
            known = ", ".join(sorted(can.VALID_INTERFACES))
            raise DeviceError(f"{name}: no CAN interface {interface!r}; python-can has {known}")
        flags: dict[str, Any] = {"fd": True} if fd else {}
        try:
            self._bus = can.Bus(channel or None, interface, bitrate=bitrate, **flags)
        # Vendor libraries raise arbitrary exceptions.
        except Exception as error:
            raise DeviceError(f"{name}: {_opening_problem(interface, channel, error)}") from None
        self._port: Buffered | None = None
        if interface == "slcan":
            bus: Any = self._bus
            self._port = bus.serialPortOrig = Buffered(bus.serialPortOrig)

    def read(self) -> tuple[list[can.Message], bool]:
        """See `Transport.read`."""
        messages: list[can.Message] = []
        timeout = POLL_S
        try:
            while len(messages) < _MOST:
                try:
                    message = self._bus.recv(timeout)
                except (ValueError, IndexError):  # a corrupted slcan line
                    continue
                if message is None:
                    return messages, False
                timeout = 0.0
                if not message.is_error_frame and not message.is_remote_frame:
                    messages.append(message)
                # Reading an empty slcan port takes a millisecond.
                if self._port is not None and not self._port.in_waiting:
                    return messages, False
        except (can.CanError, OSError):
            if not messages:
                raise LineDisconnectedError from None
        return messages, True

    def close(self) -> None:
        """See `Transport.close`."""
        with contextlib.suppress(can.CanError, OSError):  # it may be disconnected already
            self._bus.shutdown()


def _opening_problem(interface: str, channel: str, error: Exception) -> str:
    text = (str(error).splitlines() or [""])[0] or type(error).__name__
    if interface == "socketcan":
        return (
            f"cannot open it: {text}; bring it up with  "
            f"sudo ip link set {channel or 'can0'} up type can bitrate 500000"
        )
    if isinstance(error, can.CanInterfaceNotImplementedError | ImportError):
        return f"python-can cannot use this interface here: {text}; install the vendor's driver and library"
    return f"cannot open it: {text}; see python-can's page on {interface} for the names of its channels"


class _BlfReader(can.BLFReader):
    """A BLF reader that stops at an object whose stated size is below its header's: python-can would loop."""

    def _parse_data(self, data: bytes) -> Iterator[can.Message]:
        end = _find_empty_object(data)
        yield from super()._parse_data(data if end is None else data[:end])
        if end is not None:
            raise ValueError("damaged: an object in it has no length")


def _find_empty_object(data: bytes) -> int | None:
    """Return the offset of the first object without a length in a BLF container; None if there is none."""
    at = data.find(_BLF_OBJECT, 0, 8)
    while at >= 0 and at + _BLF_HEAD.size <= len(data):
        size = _BLF_HEAD.unpack_from(data, at)[3]
        if size < _BLF_HEAD.size:
            return at
        at = data.find(_BLF_OBJECT, at + size, at + size + 8)
    return None


def _check_table(path: Path) -> None:
    """Raise ValueError unless the messages of an SQLite log are a table.

    A view can be endless, and SQLite cannot be interrupted by a signal while it computes one.
    """
    with contextlib.closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as log:
        row = log.execute("SELECT type, sql FROM sqlite_master WHERE name = 'messages'").fetchone()
    if row is None or row[0] != "table" or not str(row[1]).upper().lstrip().startswith("CREATE TABLE"):
        raise ValueError("it has no table of messages")


def _open_log(path: Path) -> Any:
    if path.suffix.lower() == ".db":
        _check_table(path)
    return _BlfReader(path) if path.suffix.lower() == ".blf" else can.LogReader(path)


def _is_good(message: can.Message) -> bool:
    """Whether a frame's time and id are possible; logs are untrusted files, and python-can does not check."""
    return (
        isinstance(message.timestamp, int | float)
        and abs(message.timestamp) < _LATEST_S
        and isinstance(message.arbitration_id, int)
        and 0 <= message.arbitration_id < 1 << 29
    )


def read_log(path: Path) -> Iterator[tuple[str, float, list[can.Message] | None]]:
    """Yield channel, time in seconds and message of each frame of a log, in the file's order.

    The message is None if its time or id is impossible.

    Raises:
        FileFormatError: the log cannot be read, from its start or to its end.
    """
    try:
        with _open_log(path) as messages:
            for message in messages:
                if message.is_error_frame or message.is_remote_frame:
                    continue
                channel = "" if message.channel is None else str(message.channel)
                if _is_good(message):
                    yield channel, message.timestamp, [message]
                else:
                    yield channel, 0.0, None
    except OSError as error:
        raise FileFormatError(f"{path}: cannot read it: {error.strerror or error}") from None
    # python-can's readers raise arbitrary exceptions for damaged files.
    except Exception as error:
        text = (str(error).splitlines() or [""])[0] or type(error).__name__
        raise FileFormatError(f"{path}: cannot read it as a log of a CAN bus: {text}") from None
