"""TCP connections to devices as transports."""

from __future__ import annotations

import select
import socket
from collections.abc import Callable
from contextlib import suppress

from edgepose.errors import DeviceError
from edgepose.sources import POLL_S
from edgepose.sources.line_reader import LineDisconnectedError
from edgepose.utils.sockets import address_text, failure_text

CONNECT_S = 2.0
"""Longest time until a device accepts the connection, seconds."""

_MOST = 1 << 16
"""Most bytes read at a time."""

_PROBES = (("TCP_KEEPIDLE", 2), ("TCP_KEEPINTVL", 1), ("TCP_KEEPCNT", 3))
"""Settings with which a device that has vanished is noticed within 5 s."""


class TcpConnection:
    """A connection to a device that sends by itself; nothing is sent to it."""

    def __init__(self, host: str, port: int) -> None:
        """Connect.

        Raises:
            DeviceError: no such host, or it does not accept the connection.
        """
        try:
            self._socket = socket.create_connection((host, port), CONNECT_S)
        except (OSError, UnicodeError) as error:
            reason = failure_text(error, host)
            raise DeviceError(
                f"{address_text(host, port)}: cannot connect: {reason}; check that the device is on, in this "
                "network, and serves no other program"
            ) from None
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _PROBES:
            with suppress(AttributeError, OSError):  # missing on some systems
                self._socket.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)

    def read(self) -> tuple[bytes, bool]:
        """See `Transport.read`."""
        select.select([self._socket], [], [], POLL_S)
        return self._receive()

    @property
    def waiting(self) -> Callable[[], tuple[bytes, bool]]:
        """See `Transport.waiting`."""
        return self._receive

    @property
    def file(self) -> int:
        """See `Transport.file`."""
        return self._socket.fileno()

    def _receive(self) -> tuple[bytes, bool]:
        try:
            data = self._socket.recv(_MOST)
        except BlockingIOError:
            return b"", False
        except OSError:
            raise LineDisconnectedError from None
        if not data:  # the device has closed it
            raise LineDisconnectedError
        return data, len(data) == _MOST

    def close(self) -> None:
        """See `Transport.close`."""
        self._socket.close()
