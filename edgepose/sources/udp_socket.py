"""UDP sockets as transports."""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Callable, Collection
from contextlib import suppress
from typing import Any

from edgepose.sources import POLL_S
from edgepose.sources.line_reader import LineDisconnectedError
from edgepose.sources.protocol_detection import Datagram
from edgepose.utils.sockets import bound_socket
from firmware_protocols.base import Host

LONGEST = 2048
"""Length limit of a datagram, bytes; longer ones, and empty ones, come out empty."""

_LARGEST = 1 << 16
"""Size of the buffer for a datagram, bytes: none is larger. On Windows one that does not fit is an error."""

_MOST, _MOST_POLLED = 32, 512
"""Most datagrams read at a time, when waiting for them and when polling."""

_BUFFER = 1 << 20
"""Size of the system's buffer to ask for, bytes; the system may give less."""


class UdpSocket:
    """A socket that receives the datagrams of any number of senders.

    It sends nothing unless there is a host for the trackers.
    """

    def __init__(
        self, host: str, port: int, trackers: Host | None = None, senders: Collection[str] | None = None
    ) -> None:
        """Bind the socket.

        Args:
            host: address of this machine to listen on.
            port: UDP port.
            trackers: host that answers the senders, if they need one.
            senders: IP addresses, and names that senders give themselves, that are answered; None for all.

        Raises:
            DeviceError: the address does not belong to this machine, or the port is in use.
        """
        self._socket = bound_socket(host, port)
        with suppress(OSError):
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        self._trackers = trackers
        self._senders = senders

    def read(self) -> tuple[list[Datagram], bool]:
        """See `Transport.read`."""
        select.select([self._socket], [], [], POLL_S)
        return self._receive(_MOST)

    @property
    def waiting(self) -> Callable[[], tuple[list[Datagram], bool]]:
        """See `Transport.waiting`."""
        return lambda: self._receive(_MOST_POLLED)

    @property
    def file(self) -> int:
        """See `Transport.file`."""
        return self._socket.fileno()

    def _receive(self, most: int) -> tuple[list[Datagram], bool]:
        datagrams: list[Datagram] = []
        more = True
        for _ in range(most):
            try:
                data, address = self._socket.recvfrom(_LARGEST)
            except BlockingIOError:
                more = False
                break
            except ConnectionError:  # on Windows: an earlier answer did not arrive
                continue
            except OSError:
                if not datagrams:
                    raise LineDisconnectedError from None
                break
            sender: str | None = address[0].removeprefix("::ffff:")
            if self._trackers is not None and sender is not None:
                sender = self._answer(data, sender, address)
            if sender is not None:
                datagrams.append(Datagram(sender, data if len(data) <= LONGEST else b""))
        if self._trackers is not None:
            for address, message in self._trackers.due(time.monotonic()):
                self._send(message, address)
        return datagrams, more

    def _answer(self, data: bytes, sender: str, address: Any) -> str | None:
        """Answer a datagram, and return its sender; None if it is not for the decoder."""
        assert self._trackers is not None
        if self._senders is not None and sender not in self._senders:
            identity = self._trackers.identity(data, address)
            if identity not in self._senders:
                return sender
            sender = identity
        wanted, answer = self._trackers.receive(data, address, time.monotonic())
        if answer:
            self._send(answer, address)
        return sender if wanted else None

    def _send(self, message: bytes, address: Any) -> None:
        with suppress(OSError):  # a message that is lost on the way is not reported either
            self._socket.sendto(message, address)

    def close(self) -> None:
        """See `Transport.close`."""
        self._socket.close()
