"""Re-zero requests during a run: by key, or over UDP by the text `rezero` or OSC message /edgepose/rezero."""

from __future__ import annotations

import math
import socket
import struct
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial

from edgepose.errors import DeviceError
from edgepose.utils.sockets import resolve

MAX_DELAY_S = 60.0
# OSC terminates a string with a zero byte and pads it to a multiple of four.
_ADDRESS = b"/edgepose/rezero" + bytes(4)


class Control:
    """A UDP socket that receives requests; it never answers.

    Attributes:
        ignored: number of datagrams that were not a request.
    """

    def __init__(self, host: str, port: int) -> None:
        """Bind the socket.

        Raises:
            DeviceError: the address does not belong to this machine, or is in use.
        """
        self.ignored = 0
        try:
            family, address = resolve(host, port, socket.SOCK_DGRAM)
            self._socket = socket.socket(family, socket.SOCK_DGRAM)
        except (OSError, UnicodeError) as error:
            raise DeviceError(f"cannot find {host!r} to listen on: {error}") from error
        self._socket.setblocking(False)
        try:
            self._socket.bind(address)
        except OSError as error:
            self._socket.close()
            raise DeviceError(
                f"cannot listen on {host} port {port}: {error.strerror or error}; "
                "give an address of this machine and a free port"
            ) from error

    def requests(self) -> list[float]:
        """Return the delay of each re-zero request received since the last call, seconds."""
        delays = []
        # Limited, so that a flood of datagrams does not stop the frames.
        for _ in range(16):
            try:
                datagram = self._socket.recv(1024)
            except OSError:  # nothing to receive
                break
            delay_s = parse(datagram)
            if delay_s is None:
                self.ignored += 1
            else:
                delays.append(delay_s)
        return delays

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def __enter__(self) -> Control:
        """Return the object itself; the socket is open since its construction."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the socket."""
        self.close()


def parse(datagram: bytes) -> float | None:
    """Return the delay until the requested hold, seconds; None if the datagram is not a request.

    An OSC 1.0 message may have one argument, the delay in seconds, as int32 or float32.
    """
    if datagram.strip() == b"rezero":
        return 0.0
    address, rest = datagram[: len(_ADDRESS)], datagram[len(_ADDRESS) :]
    if address != _ADDRESS:
        return None
    # Old senders omit the type tags.
    if rest in (b"", b",\0\0\0"):
        return 0.0
    form = {b",i\0\0": ">i", b",f\0\0": ">f"}.get(rest[:4])
    if form is None or len(rest) != 8:
        return None
    (delay_s,) = struct.unpack(form, rest[4:])
    return float(delay_s) if math.isfinite(delay_s) and 0.0 <= delay_s <= MAX_DELAY_S else None


KEY_DELAY_S = 3.0
"""Time from a key press to the hold, seconds: the wearer has to leave the keyboard first."""


class RezeroRequests:
    """Requests to re-zero the headings, from the keyboard or over UDP."""

    def __init__(
        self, stack: ExitStack, control: tuple[str, int] | None, by_key: Callable[[], list[float]]
    ) -> None:
        """Listen until the stack is closed.

        Args:
            stack: closes the socket.
            control: host and port to listen on; None for none.
            by_key: returns the requests from the keyboard, one of `key_requests`.

        Raises:
            DeviceError: the address cannot be listened on.
        """
        self._control = None if control is None else stack.enter_context(Control(*control))
        self._by_key = by_key

    def poll(self) -> list[float]:
        """Return the delay of each new request, seconds."""
        return self._by_key() + ([] if self._control is None else self._control.requests())

    def summary_lines(self) -> list[str]:
        """Return the lines for the end of the run."""
        if self._control is None or not self._control.ignored:
            return []
        return [f"control  {self._control.ignored} datagrams without a known request"]


def key_requests(count: int, pressed: Callable[[], str]) -> list[Callable[[], list[float]]]:
    """Return one callable per wearer, which returns the requests since its last call.

    Every key press goes to all wearers.

    Args:
        count: number of wearers.
        pressed: returns the keys pressed since its last call.
    """
    pending: list[list[float]] = [[] for _ in range(count)]

    def by_key(wearer: int) -> list[float]:
        delays = [KEY_DELAY_S for key in pressed() if key in "rR\r\n"]
        for queue in pending:
            queue += delays
        requests, pending[wearer] = pending[wearer], []
        return requests

    return [partial(by_key, wearer) for wearer in range(count)]
