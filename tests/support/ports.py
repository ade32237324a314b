"""Serial ports of which a test holds the other end, and threads that send on them as devices do."""

from __future__ import annotations

import contextlib
import os
import pty
import threading
import time
import tty
from abc import ABC, abstractmethod
from itertools import count


class Port:
    """A raw pty.

    Its number stays its own until it is closed: while it is unplugged, /dev/pts/N is nobody else's port.
    """

    def __init__(self, blocking: bool = False) -> None:
        self.master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self.master, blocking)
        self.name = os.ttyname(self._slave)
        self._open = {self.master, self._slave}

    def write(self, data: bytes) -> None:
        """Bytes for which there is no room, as nobody reads, are lost."""
        with contextlib.suppress(BlockingIOError):
            os.write(self.master, data)

    def unplug(self) -> None:
        """Whoever has it open gets an error; it cannot be opened any more."""
        self._close(self.master)

    def close(self) -> None:
        self._close(self.master)
        self._close(self._slave)

    def _close(self, file: int) -> None:
        """Once only: the number of a closed file may be another file's."""
        if file in self._open:
            self._open.remove(file)
            os.close(file)

    def __enter__(self) -> Port:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Sender(threading.Thread, ABC):
    """Calls `send` with the count, about 100 times a second, until it is left; then its ports are closed."""

    def __init__(self, *ports: Port, rate: float = 100.0) -> None:
        super().__init__(daemon=True)
        self.ports = ports
        self.left = threading.Event()
        self._pause_s = 1.0 / rate
        self._start_s = 0.0

    @property
    def elapsed_s(self) -> float:
        return time.monotonic() - self._start_s

    @abstractmethod
    def send(self, k: int) -> None:
        """Write what the devices send at the count k."""

    def run(self) -> None:
        self._start_s = time.monotonic()
        for k in count():
            if self.left.wait(self._pause_s):
                return
            self.send(k)

    def stop(self) -> None:
        self.left.set()
        if self.is_alive():
            self.join()

    def unplug(self) -> None:
        self.stop()
        for port in self.ports:
            port.unplug()

    def __enter__(self):
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        for port in self.ports:
            port.close()
