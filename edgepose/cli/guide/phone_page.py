"""A page for the browser of a phone in the same network: the stage, big, with sound and buttons.

It is served only at the address that the user gives. Anyone who reaches that address can see it and press its
buttons; it shows nothing but the stage, and takes nothing but the names of its buttons.
"""

from __future__ import annotations

import ipaddress
import json
import socket
import threading
from collections import deque
from collections.abc import Sequence
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from socketserver import TCPServer
from types import TracebackType
from typing import Any
from urllib.parse import urlsplit

from edgepose.cli.guide.stage import DONE, WAIT, Stage
from edgepose.errors import DeviceError
from edgepose.utils.sockets import address_text, failure_text, resolve

BUTTONS = {WAIT: ("start",), DONE: ("repeat", "finish")}
"""Buttons of each kind of stage that has some."""

_HTML = Path(__file__).with_name("phone_page.html")
_MOST_CONNECTIONS = 16
_TIMEOUT_S = 5.0
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'self' 'unsafe-inline'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
}


class PhonePage:
    """The page, served while it is entered.

    Attributes:
        url: its address.
        port: TCP port.
        is_local: whether only this machine can open it.
    """

    def __init__(self, host: str, port: int) -> None:
        """Bind the address.

        Raises:
            DeviceError: the address does not belong to this machine, or is in use.
        """
        self._state = b"{}"
        self._buttons: tuple[str, ...] = ()
        self._pressed: deque[str] = deque(maxlen=1)
        try:
            family, address = resolve(host, port, socket.SOCK_STREAM)
            self._server = _Server(family, address, self, host)
        except (OSError, UnicodeError) as error:
            raise DeviceError(
                f"cannot serve a page at {address_text(host, port)}: {failure_text(error, host)}; "
                "give an address of this machine and a free port"
            ) from error
        self.port: int = self._server.server_port
        bound = ipaddress.ip_address(address[0])
        self.is_local = bound.is_loopback
        shown = address_in_network() if bound.is_unspecified else None  # no browser opens 0.0.0.0 elsewhere
        self.url = f"http://{address_text(shown or host, port)}/"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True)

    def __enter__(self) -> PhonePage:
        """Serve the page."""
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop."""
        self._server.shutdown()
        self._server.server_close()

    def show(self, stage: Stage, passed_s: float, notes: Sequence[str]) -> None:
        """Show a stage of which some seconds have passed, with the last messages."""
        self._buttons = BUTTONS.get(stage.kind, ())
        state = {
            "kind": stage.kind,
            "word": stage.shown_word(passed_s),
            "text": stage.text,
            "figure": stage.figure,
            "share": round(passed_s / stage.total_s, 3) if stage.total_s else 0.0,
            "buttons": self._buttons,
            "notes": notes[-3:],
        }
        self._state = json.dumps(state).encode()

    def pressed(self) -> str | None:
        """Return the button that has been pressed since the last call, if any."""
        return self._pressed.pop() if self._pressed else None

    @property
    def state(self) -> bytes:
        """The stage for the page, JSON."""
        return self._state

    def press(self, button: str) -> bool:
        """Note a pressed button, and return whether the page shows it."""
        if button in self._buttons:
            self._pressed.append(button)
        return button in self._buttons


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    allow_reuse_address = True

    def __init__(self, family: socket.AddressFamily, address: Any, page: PhonePage, host: str) -> None:
        self.address_family = family
        self.page, self.host = page, host
        self._free = threading.BoundedSemaphore(_MOST_CONNECTIONS)
        super().__init__(address, _Handler)

    def server_bind(self) -> None:
        # HTTPServer would look up the machine's name, which can take seconds.
        TCPServer.server_bind(self)
        self.server_name, self.server_port = self.host, self.server_address[1]

    def process_request(self, request: Any, client_address: Any) -> None:
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore connections that break."""


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = _TIMEOUT_S

    def do_GET(self) -> None:
        if not self._is_own_name():
            self._answer(HTTPStatus.FORBIDDEN)
        elif self.path == "/":
            self._answer(HTTPStatus.OK, _HTML.read_bytes(), "text/html; charset=utf-8")
        elif self.path == "/state":
            self._answer(HTTPStatus.OK, self.server.page.state, "application/json")
        else:
            self._answer(HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:
        origins = None, f"http://{self.headers.get('Host')}"
        if self.headers.get("Origin") not in origins or not self._is_own_name():
            self._answer(HTTPStatus.FORBIDDEN)  # another page, open in the same browser
        elif self.server.page.press(self.path.removeprefix("/")):
            self._answer(HTTPStatus.NO_CONTENT)
        else:
            self._answer(HTTPStatus.NOT_FOUND)

    def _is_own_name(self) -> bool:
        """Return whether the request names this server by address: other names may have been bent to it."""
        try:
            name = urlsplit(f"//{self.headers.get('Host', '')}").hostname or ""
            if name not in ("localhost", self.server.host.lower()):
                ipaddress.ip_address(name)
        except ValueError:
            return False
        return True

    def _answer(self, status: HTTPStatus, body: bytes = b"", kind: str = "text/plain") -> None:
        self.send_response(status)
        for name, value in {**_HEADERS, "Content-Type": kind, "Content-Length": str(len(body))}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Write nothing: the terminal shows the stage."""


def address_in_network() -> str | None:
    """Return this machine's address in its network; None if it has none. Nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # an address for documentation; chooses the route only
            return str(probe.getsockname()[0])
        except OSError:
            return None
