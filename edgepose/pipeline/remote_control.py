"""Wishes that come by UDP during a run: the text `rezero`, or the OSC message /edgepose/rezero."""

from __future__ import annotations

import math
import socket
import struct

from edgepose.errors import EdgeposeError
from edgepose.utils.sockets import resolve

MAX_DELAY_S = 60.0
# OSC ends a text with a zero byte and fills it up to a multiple of four.
_ADDRESS = b"/edgepose/rezero" + bytes(4)


class Control:
    """A socket that hears wishes; it never answers.

    Attributes:
        ignored: datagrams that were no wish.
    """

    def __init__(self, host: str, port: int) -> None:
        """Binds it.

        Raises:
            EdgeposeError: the address is not of this machine, or in use.
        """
        self.ignored = 0
        try:
            family, address = resolve(host, port, socket.SOCK_DGRAM)
            self._socket = socket.socket(family, socket.SOCK_DGRAM)
        except (OSError, UnicodeError) as error:
            raise EdgeposeError(f"cannot find {host!r} to listen on: {error}") from error
        self._socket.setblocking(False)
        try:
            self._socket.bind(address)
        except OSError as error:
            self._socket.close()
            raise EdgeposeError(
                f"cannot listen on {host} port {port}: {error.strerror or error}; "
                "give an address of this machine and a free port"
            ) from error

    def requests(self) -> list[float]:
        """What has come: for each wish to re-zero, in how many seconds."""
        wishes = []
        # A flood must not stop the frames.
        for _ in range(16):
            try:
                datagram = self._socket.recv(1024)
            except OSError:  # nothing is there
                break
            delay_s = parse(datagram)
            if delay_s is None:
                self.ignored += 1
            else:
                wishes.append(delay_s)
        return wishes

    def close(self) -> None:
        """Stops listening."""
        self._socket.close()

    def __enter__(self) -> Control:
        """Listening since its construction."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stops listening."""
        self.close()


def parse(datagram: bytes) -> float | None:
    """Seconds until the hold that a datagram asks for; None if it asks for nothing.

    An OSC 1.0 message may have one argument, the seconds, as int32 or float32.
    """
    if datagram.strip() == b"rezero":
        return 0.0
    address, rest = datagram[: len(_ADDRESS)], datagram[len(_ADDRESS) :]
    if address != _ADDRESS:
        return None
    # The oldest senders leave the type tags out.
    if rest in (b"", b",\0\0\0"):
        return 0.0
    form = {b",i\0\0": ">i", b",f\0\0": ">f"}.get(rest[:4])
    if form is None or len(rest) != 8:
        return None
    (delay_s,) = struct.unpack(form, rest[4:])
    return float(delay_s) if math.isfinite(delay_s) and 0.0 <= delay_s <= MAX_DELAY_S else None
