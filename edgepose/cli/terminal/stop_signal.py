"""Stop signals as a flag that a loop polls, so that no step is interrupted halfway."""

from __future__ import annotations

import signal
import time
from types import FrameType, TracebackType
from typing import Any

REPEAT_S = 1.0
"""Signals that follow the first this closely are part of it, seconds.

Programs that start others pass on a Ctrl-C that the terminal has sent to all of them, and a session that ends
may send SIGTERM and SIGHUP.
"""


def stop_signals() -> list[int]:
    """Return the signals that ask a program to end, without ignored ones such as SIGHUP under nohup."""
    numbers = [signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", None)]
    return [number for number in numbers if number is not None and signal.getsignal(number) != signal.SIG_IGN]


class StopSignal:
    """Remembers the first stop signal while it is entered; one after REPEAT_S interrupts at once.

    Attributes:
        asked: whether a stop signal has arrived.
    """

    def __init__(self) -> None:
        """Create the flag; `__enter__` installs the signal handlers."""
        self.asked = False
        self._asked_s = 0.0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopSignal:
        """Install the signal handlers."""
        for number in stop_signals():
            self._before[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Restore the previous signal handlers; after a stop signal, leave that to one after REPEAT_S."""
        if not self.asked:
            self._restore()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if not self.asked:
            self.asked, self._asked_s = True, time.monotonic()
        elif time.monotonic() - self._asked_s > REPEAT_S:
            self._restore()
            signal.raise_signal(number)

    def _restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
