"""Receivers of what is sent over the network, and free addresses for it."""

from __future__ import annotations

import contextlib
import json
import random
import socket
import threading
import time

LIMIT_S = 60.0
"""Nobody waits so long; a machine under load may."""


class Listener(threading.Thread):
    """Receives datagrams on a free port of this machine until it is left."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(0.05)
        self.address = f"127.0.0.1:{self.socket.getsockname()[1]}"
        self.datagrams: list[bytes] = []
        self.first = threading.Event()
        self._left = False

    def run(self) -> None:
        while True:
            try:
                self.datagrams.append(self.socket.recv(65536))
                self.first.set()
            except TimeoutError:
                if self._left:
                    return

    def wait_for(self, status: str, poses: int) -> None:
        """Returns when so many more poses of a status have come."""
        seen, end_s = len(self.datagrams), time.monotonic() + LIMIT_S
        while [json.loads(d)["status"] for d in self.datagrams[seen:]].count(status) < poses:
            assert time.monotonic() < end_s, f"no {poses} poses {status!r}"
            time.sleep(0.02)

    def __enter__(self) -> Listener:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._left = True
        self.join()
        self.socket.close()


def free_address(kind: socket.SocketKind = socket.SOCK_STREAM) -> str:
    """An address of this machine at which nobody listens.

    Its port is below those that the system gives away, so that nobody else gets it before it is used.
    """
    while True:
        port = random.SystemRandom().randrange(15_000, 32_000)
        with contextlib.suppress(OSError), socket.socket(socket.AF_INET, kind) as free:
            free.bind(("127.0.0.1", port))
            return f"127.0.0.1:{port}"
