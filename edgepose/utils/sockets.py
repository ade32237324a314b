"""Where sockets go: the address of a name."""

from __future__ import annotations

import socket
from typing import Any


def resolve(host: str, port: int, kind: socket.SocketKind) -> tuple[socket.AddressFamily, Any]:
    """Family and address of a name, to listen at or to send to.

    A name with addresses of both kinds, as `localhost`, stands for its IPv4 one: senders and listeners must
    choose alike.

    Raises:
        OSError, UnicodeError: there is no such host.
    """
    found = socket.getaddrinfo(host, port, type=kind)
    family, _, _, _, address = min(found, key=lambda entry: entry[0] != socket.AF_INET)
    return family, address
