"""Restriction of a viser server to its own pages.

viser accepts WebSockets from any web page, so a foreign page that is open in the same browser could read the
wearer's poses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit


@contextmanager
def same_origin_only() -> Iterator[None]:
    """Let servers that viser starts in this block refuse requests of other pages.

    viser has no setting for it, but passes its handler of requests to `websockets`.
    """
    from websockets.asyncio import server

    serve = server.serve

    def serve_own_pages(*args: Any, process_request: Any = None, **options: Any) -> Any:
        return serve(*args, process_request=_refusing(process_request), **options)

    server.serve = serve_own_pages  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        server.serve = serve  # type: ignore[misc]


def _refusing(handler: Callable[[Any, Any], Any] | None) -> Callable[[Any, Any], Any]:
    """Wrap a handler of requests so that those of other pages get no further."""

    def handle(connection: Any, request: Any) -> Any:
        origin = request.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != request.headers.get("Host"):
            return connection.respond(HTTPStatus.FORBIDDEN, "this page may not read the view\n")
        return None if handler is None else handler(connection, request)

    return handle
