"""A thread that works in the background while an object is entered."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from types import TracebackType
from typing import TypeVar

Self = TypeVar("Self", bound="Background")


class Background(ABC):
    """Base of objects that run `_work` in a thread of their own while they are entered."""

    def __init__(self, name: str) -> None:
        """Create the thread; `__enter__` starts it.

        Args:
            name: of the thread.
        """
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True, name=name)

    def __enter__(self: Self) -> Self:
        """Start the thread."""
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the thread and wait for its end."""
        self._stop.set()
        self._thread.join()

    @abstractmethod
    def _work(self) -> None:
        """Work until `_stop` is set."""
