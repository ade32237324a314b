"""Requests during a run: to re-zero the headings, or to reset the place to the origin.

They come by key, by a button of the viewer, or over UDP: the texts `rezero` and `origin`, or the OSC messages
/edgepose/rezero and /edgepose/origin.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from math import inf
from typing import Literal, NamedTuple

from edgepose.utils.sockets import bound_socket

Action = Literal["rezero", "origin"]

MAX_DELAY_S = 60.0
# OSC terminates a string with a zero byte and pads it to a multiple of four.
_ADDRESSES: dict[bytes, Action] = {
    b"/edgepose/rezero" + bytes(4): "rezero",
    b"/edgepose/origin" + bytes(4): "origin",
}
_ADDRESS_LENGTH = 20
_TEXTS: dict[bytes, Action] = {b"rezero": "rezero", b"origin": "origin"}


class Request(NamedTuple):
    """A request, and the time until it is to be met, seconds."""

    action: Action
    delay_s: float = 0.0


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
        self._socket = bound_socket(host, port)

    def requests(self) -> list[Request]:
        """Return the requests received since the last call."""
        requests = []
        # Limited, so that a flood of datagrams does not stop the frames.
        for _ in range(16):
            try:
                datagram = self._socket.recv(1024)
            except OSError:  # nothing to receive
                break
            request = parse(datagram)
            if request is None:
                self.ignored += 1
            else:
                requests.append(request)
        return requests

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def __enter__(self) -> Control:
        """Return the object itself; the socket is open since its construction."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the socket."""
        self.close()


def parse(datagram: bytes) -> Request | None:
    """Return the request in a datagram; None if there is none.

    An OSC 1.0 message may have one argument, the delay in seconds, as int32 or float32.
    """
    action = _TEXTS.get(datagram.strip())
    if action is not None:
        return Request(action)
    address, rest = datagram[:_ADDRESS_LENGTH], datagram[_ADDRESS_LENGTH:]
    action = _ADDRESSES.get(address)
    if action is None:
        return None
    # Old senders omit the type tags.
    if rest in (b"", b",\0\0\0"):
        return Request(action)
    form = {b",i\0\0": ">i", b",f\0\0": ">f"}.get(rest[:4])
    if form is None or len(rest) != 8:
        return None
    (delay_s,) = struct.unpack(form, rest[4:])
    in_range = math.isfinite(delay_s) and 0.0 <= delay_s <= MAX_DELAY_S
    return Request(action, float(delay_s)) if in_range else None


_REZERO = Request("rezero", 3.0)
"""Re-zeroing by key: the wearer has to leave the keyboard first."""

KEYS = {"r": _REZERO, "R": _REZERO, "\r": _REZERO, "\n": _REZERO, **dict.fromkeys("oO", Request("origin"))}


class Requests:
    """A wearer's requests, from the keyboard or over UDP."""

    def __init__(
        self, stack: ExitStack, control: tuple[str, int] | None, by_key: Callable[[], list[Request]]
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
        self._pending: dict[Action, float] = {}
        self._pressed: deque[str] = deque(maxlen=16)

    def press(self, key: str) -> None:
        """Press a key of `KEYS` in an output such as the viewer; other threads may call this."""
        self._pressed.append(key)

    def poll(self, action: Action) -> list[float]:
        """Return the delay of a new request for an action, the shortest of several, seconds."""
        pressed = [self._pressed.popleft() for _ in range(len(self._pressed))]
        buttons = [KEYS[key] for key in pressed if key in KEYS]
        for request in buttons + self._by_key() + ([] if self._control is None else self._control.requests()):
            # Only one is kept, so that a flood for an action that is not polled yet takes no memory.
            self._pending[request.action] = min(self._pending.get(request.action, inf), request.delay_s)
        return [self._pending.pop(action)] if action in self._pending else []

    def summary_lines(self) -> list[str]:
        """Return the lines for the end of the run."""
        if self._control is None or not self._control.ignored:
            return []
        return [f"control  {self._control.ignored} datagrams without a known request"]


def key_requests(count: int, pressed: Callable[[], str]) -> list[Callable[[], list[Request]]]:
    """Return one callable per wearer, which returns the requests since its last call.

    Every key press goes to all wearers.

    Args:
        count: number of wearers.
        pressed: returns the keys pressed since its last call.
    """
    pending: list[list[Request]] = [[] for _ in range(count)]

    def by_key(wearer: int) -> list[Request]:
        if keys := pressed():
            new = [KEYS[key] for key in keys if key in KEYS]
            for queue in pending:
                queue += new
        requests, pending[wearer] = pending[wearer], []
        return requests

    return [partial(by_key, wearer) for wearer in range(count)]
