"""Signals that end a run as a question that a loop asks, so that nothing is lost in the middle of a step."""

from __future__ import annotations

import signal
from types import FrameType, TracebackType
from typing import Any


def endings() -> list[int]:
    """Signals that ask a program to end, unless they are ignored, as SIGHUP is under nohup."""
    numbers = [signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", None)]
    return [number for number in numbers if number is not None and signal.getsignal(number) != signal.SIG_IGN]


class StopSignal:
    """Whether one of these signals has come. A second one interrupts at once, as outside of this."""

    def __init__(self) -> None:
        """Signals are as before until it is entered."""
        self.asked = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopSignal:
        """Note signals from now on."""
        for number in endings():
            self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Signals are as before."""
        self._restore()

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.asked = True
        self._restore()

    def _restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
