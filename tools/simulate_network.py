"""Network lines of the simulator: senders of datagrams, SlimeVR trackers, and TCP servers."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from contextlib import suppress

from edgepose.errors import DeviceError
from edgepose.utils.sockets import address_text, resolve
from firmware_protocols import slimevr

FIRST_SENDER = 11
"""Last number of the address of the first of several senders: 127.0.0.11, 127.0.0.12 ..."""


class DatagramLine:
    """A sender of datagrams; several on this machine have loopback addresses of their own.

    Attributes:
        name: the address that it sends to.
        sender: the address that it sends from, "" for the system's choice.
        master: file to watch for answers.
    """

    def __init__(self, host: str, port: int, number: int | None = None) -> None:
        """Open the socket of a sender, with an address of its own if it has a number.

        Raises:
            DeviceError: nothing can be sent to the host, or not from such an address.
        """
        self.name = address_text(host, port)
        self.sender = "" if number is None else f"127.0.0.{FIRST_SENDER + number}"
        try:
            family, self._target = resolve(host, port, socket.SOCK_DGRAM)
            self._socket = socket.socket(family, socket.SOCK_DGRAM)
            self._socket.bind((self.sender, 0))
            with socket.socket(family, socket.SOCK_DGRAM) as trial:
                trial.bind((self.sender, 0))
                trial.connect(self._target)  # sends nothing
        except (OSError, UnicodeError) as error:
            raise DeviceError(
                f"--udp {self.name}: cannot send from {self.sender or 'this machine'}: {error}"
            ) from None
        self._socket.setblocking(False)
        self.master = self._socket.fileno()

    def send(self, wire: bytes) -> None:
        """Send a datagram, or lose it."""
        with suppress(OSError):
            self._socket.sendto(wire, self._target)

    def receive(self) -> bytes:
        """Discard what came, because most devices do not listen."""
        with suppress(OSError):
            self._socket.recv(2048)
        return b""

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class SlimevrTracker(DatagramLine):
    """A SlimeVR tracker: it calls for a host once a second, and sends samples to the host that answers."""

    def __init__(self, host: str, port: int, number: int) -> None:
        """Open the socket."""
        super().__init__(host, port, number)
        self._mac = bytes([2, 0, 0, 0, 0, number])
        self._count = 0
        self._heard_s = self._called_s = float("-inf")

    def send(self, wire: bytes) -> None:
        """Send a sample if there is a host; otherwise call for one, once a second."""
        now_s = time.monotonic()
        if now_s - self._heard_s < 3.0:
            self._send_numbered(wire)
        elif now_s - self._called_s >= 1.0:
            self._called_s = now_s
            super().send(slimevr.encode_handshake(self._mac))

    def _send_numbered(self, packet: bytes) -> None:
        self._count += 1
        super().send(packet[:4] + self._count.to_bytes(8, "big") + packet[12:])

    def receive(self) -> bytes:
        """Read an answer of the host, and reply as trackers do."""
        try:
            answer = self._socket.recv(2048)
        except OSError:
            return b""
        self._heard_s = time.monotonic()
        if answer == slimevr.ANSWER:
            self._send_numbered(slimevr.encode_sensor_info(0))
            self._send_numbered(bytes([0, 0, 0, 22]) + bytes(9))  # asks for the host's features
        elif answer[:4] == bytes([0, 0, 0, 1]):
            self._send_numbered(bytes(12))
        elif answer[:4] == bytes([0, 0, 0, 10]):
            super().send(answer)
        return b""


class TcpServer:
    """A device with a TCP server for one client.

    Attributes:
        name: its address.
        master: file to watch for clients.
    """

    def __init__(self, host: str) -> None:
        """Listen on a free port of an address.

        Raises:
            DeviceError: it is not an address of this machine.
        """
        try:
            family, address = resolve(host, 0, socket.SOCK_STREAM)
            self._server = socket.create_server(address, family=family)
        except (OSError, UnicodeError) as error:
            raise DeviceError(f"--tcp {host}: cannot listen there: {error}") from None
        self._server.setblocking(False)
        self.name = address_text(host, self._server.getsockname()[1])
        self.master = self._server.fileno()
        self._client: socket.socket | None = None

    def send(self, wire: bytes) -> None:
        """Send bytes to the client, if there is one; lose them if it does not read."""
        if self._client is None:
            return
        try:
            self._client.send(wire)
        except BlockingIOError:
            pass
        except OSError:
            self._client.close()
            self._client = None

    def receive(self) -> bytes:
        """Accept a client, instead of an earlier one."""
        with suppress(OSError):
            client, _ = self._server.accept()
            client.setblocking(False)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if self._client is not None:
                self._client.close()
            self._client = client
        return b""

    def close(self) -> None:
        """Close the connection and the server."""
        if self._client is not None:
            self._client.close()
        self._server.close()


def network_line(host: str, port: int, protocol: str) -> Callable[[int | None], DatagramLine]:
    """Return a function that makes the sender of a number; None for one sender of all sensors."""
    if protocol == "slimevr":
        return lambda number: SlimevrTracker(host, port, number or 0)
    return lambda number: DatagramLine(host, port, number)
