"""Frames of a CAN bus and of logs of one, through python-can."""

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
from edgepose.sources.live import LineDisconnectedError

# It tells of every maker's library that is not installed, and of every clock that is not.
logging.getLogger("can").setLevel(logging.CRITICAL)

_LATEST_S = 1e11  # 5000 years of Unix time
_BLF_OBJECT, _BLF_HEAD = b"LOBJ", struct.Struct("<4sHHII")
_MOST = 256
"""Messages read at a time."""


class Buffered:
    """A serial port whose bytes are fetched all at once, however few of them are asked for.

    python-can reads slcan adapters byte by byte. At two system calls each, the frames of six sensors take it
    4 ms, and where devices send no time these would be an error of their times.
    """

    def __init__(self, port: Any) -> None:
        """Nothing fetched yet."""
        self._port = port
        self._data = b""
        self._at = 0

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read without waiting; those fetched already, if there are any."""
        return len(self._data) - self._at or self._port.in_waiting

    def read(self, size: int = 1) -> bytes:
        """Up to so many bytes; waits for the first one for as long as the port does."""
        if self._at == len(self._data):
            self._data = self._port.read(1)
            self._data += self._port.read(self._port.in_waiting)
            self._at = 0
        data = self._data[self._at : self._at + size]
        self._at += len(data)
        return data

    def reset_input_buffer(self) -> None:
        """Throws away what came."""
        self._data, self._at = b"", 0
        self._port.reset_input_buffer()

    def __getattr__(self, name: str) -> Any:
        """All else is the port's."""
        return getattr(self._port, name)


class CanBus:
    """An open bus.

    Attributes:
        waiting: see `live.Handle`; python-can's interfaces differ in whether they can be looked at.
    """

    waiting = None

    def __init__(self, name: str, bitrate: int, fd: bool) -> None:
        """Open it.

        Args:
            name: INTERFACE:CHANNEL, as python-can names them.
            bitrate: speed, bit/s, for interfaces that are set up here; the system sets that of SocketCAN.
            fd: take CAN FD frames too.

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
        # Every maker's library fails in its own way.
        except Exception as error:
            raise DeviceError(f"{name}: {_opening_problem(interface, channel, error)}") from None
        self._port: Buffered | None = None
        if interface == "slcan":
            bus: Any = self._bus
            self._port = bus.serialPortOrig = Buffered(bus.serialPortOrig)

    def read(self) -> tuple[list[can.Message], bool]:
        """See `live.Handle`."""
        messages: list[can.Message] = []
        timeout = POLL_S
        try:
            while len(messages) < _MOST:
                try:
                    message = self._bus.recv(timeout)
                except (ValueError, IndexError):  # slcan's line was damaged
                    continue
                if message is None:
                    return messages, False
                timeout = 0.0
                if not message.is_error_frame and not message.is_remote_frame:
                    messages.append(message)
                # To ask slcan for what is not there takes a millisecond.
                if self._port is not None and not self._port.in_waiting:
                    return messages, False
        except (can.CanError, OSError):
            if not messages:
                raise LineDisconnectedError from None
        return messages, True

    def close(self) -> None:
        """See `live.Handle`."""
        with contextlib.suppress(can.CanError, OSError):  # it may have gone already
            self._bus.shutdown()


def _opening_problem(interface: str, channel: str, error: Exception) -> str:
    text = (str(error).splitlines() or [""])[0] or type(error).__name__
    if interface == "socketcan":
        return (
            f"cannot open it: {text}; bring it up with  "
            f"sudo ip link set {channel or 'can0'} up type can bitrate 500000"
        )
    if isinstance(error, can.CanInterfaceNotImplementedError | ImportError):
        return f"python-can cannot use this interface here: {text}; install the maker's driver and library"
    return f"cannot open it: {text}; see python-can's page on {interface} for how its channels are named"


class _BlfReader(can.BLFReader):
    """Ends where python-can's would turn in a circle: at an object that says it is shorter than its head."""

    def _parse_data(self, data: bytes) -> Iterator[can.Message]:
        end = _circle(data)
        yield from super()._parse_data(data if end is None else data[:end])
        if end is not None:
            raise ValueError("damaged: an object in it has no length")


def _circle(data: bytes) -> int | None:
    """Where the first object without a length is in a container of a BLF file; None if there is none."""
    at = data.find(_BLF_OBJECT, 0, 8)
    while at >= 0 and at + _BLF_HEAD.size <= len(data):
        size = _BLF_HEAD.unpack_from(data, at)[3]
        if size < _BLF_HEAD.size:
            return at
        at = data.find(_BLF_OBJECT, at + size, at + size + 8)
    return None


def _check_table(path: Path) -> None:
    """Raises ValueError unless the messages of an SQLite log are a table.

    A view can be without an end, and SQLite looks at no signal while it computes one.
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
    """Whether what a log says of a frame can be: logs are files of anyone, and readers do not look."""
    return (
        isinstance(message.timestamp, int | float)
        and abs(message.timestamp) < _LATEST_S
        and isinstance(message.arbitration_id, int)
        and 0 <= message.arbitration_id < 1 << 29
    )


def read_log(path: Path) -> Iterator[tuple[str, float, list[can.Message] | None]]:
    """Channel, time in seconds, and message, of a log, in its order; None for one whose time or id cannot be.

    Raises:
        FileFormatError: it cannot be read, at once or up to its end.
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
    # The readers of the formats fail in many ways.
    except Exception as error:
        text = (str(error).splitlines() or [""])[0] or type(error).__name__
        raise FileFormatError(f"{path}: cannot read it as a log of a CAN bus: {text}") from None
