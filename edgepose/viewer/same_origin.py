"""Restriction of a viser server to its own pages.

viser accepts WebSockets from any web page, so a foreign page that is open in the same browser could read the
wearer's poses and press buttons. A page whose name has been bent to this machine is foreign, too, though its
requests name it as their host. One that shows the view in a frame could lead the user's click to a button, so
browsers are told to show it in none.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from ipaddress import ip_address
from typing import Any
from urllib.parse import urlsplit


@contextmanager
def same_origin_only(host: str) -> Iterator[None]:
    """Let servers that viser starts in this block refuse requests of other pages.

    viser has no setting for it, but passes its handler of requests to `websockets`.

    Args:
        host: address of this machine that the servers listen at.
    """
    from websockets.asyncio import server

    serve = server.serve

    def serve_own_pages(*args: Any, process_request: Any = None, **options: Any) -> Any:
        return serve(*args, process_request=_refusing(process_request, host), **options)

    server.serve = serve_own_pages  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        server.serve = serve  # type: ignore[misc]


def _refusing(handler: Callable[[Any, Any], Any] | None, host: str) -> Callable[[Any, Any], Any]:
    """Wrap a handler of requests so that those of other pages get no further."""

    def handle(connection: Any, request: Any) -> Any:
        origin, named = request.headers.get("Origin"), request.headers.get("Host", "")
        foreign = origin is not None and origin.partition("://")[2] != named
        if foreign or not _is_own_name(named, host):
            return connection.respond(HTTPStatus.FORBIDDEN, "this page may not read the view\n")
        response = None if handler is None else handler(connection, request)
        if response is not None:
            response.headers["Content-Security-Policy"] = "frame-ancestors 'none'"
        return response

    return handle


def _is_own_name(named: str, host: str) -> bool:
    """Return whether a Host header names this machine: by address, by its own name, or as it was told."""
    try:
        name = (urlsplit(f"//{named}").hostname or "").lower()
        own = socket.gethostname().lower()
        if name not in ("localhost", host.lower(), own, f"{own}.local"):
            ip_address(name)
    except ValueError:
        return False
    return True
