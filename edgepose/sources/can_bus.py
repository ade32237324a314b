"""CAN buses as transports, through python-can."""

from __future__ import annotations

import contextlib
import errno
import logging
from pathlib import Path
from typing import Any

import can

from edgepose.errors import DeviceError
from edgepose.sources import POLL_S
from edgepose.sources.line_reader import LineDisconnectedError

# python-can warns about every vendor library and every clock that is not installed.
logging.getLogger("can").setLevel(logging.CRITICAL)

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
        file: see `Transport.file`; None for the same reason.
    """

    waiting = None
    file = None

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
        # A bus that is down can be opened, but not read.
        if interface == "socketcan" and is_down(channel):
            raise DeviceError(f"{name}: it is down; {_bring_up(channel)}")
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


def is_down(channel: str, interfaces: Path = Path("/sys/class/net")) -> bool:
    """Return whether a network interface exists and is down; `interfaces` is where Linux lists them."""
    try:
        return not int((interfaces / channel / "flags").read_text(), 16) & 1  # IFF_UP
    except (OSError, ValueError):
        return False


def _bring_up(channel: str) -> str:
    return f"bring it up with  sudo ip link set {channel or 'can0'} up type can bitrate 500000"


def _opening_problem(interface: str, channel: str, error: Exception) -> str:
    text = (str(error).splitlines() or [""])[0] or type(error).__name__
    if interface == "socketcan":
        if getattr(error, "errno", None) == errno.EAFNOSUPPORT:
            return (
                "this system has no CAN sockets; load them with  sudo modprobe can_raw  or, where they are "
                "missing (WSL, some containers), use slcan:PORT"
            )
        return f"cannot open it: {text}; {_bring_up(channel)}"
    if isinstance(error, can.CanInterfaceNotImplementedError | ImportError):
        return f"python-can cannot use this interface here: {text}; install the vendor's driver and library"
    return f"cannot open it: {text}; see python-can's page on {interface} for the names of its channels"
