"""Runs edgepose with a slow clock, so that a slow computer is as good as one that keeps up.

\b
    slow_clock.py 10 run --port /dev/pts/3 ...    `edgepose run`; its time passes at a tenth of the pace

Everything that asks for the time or waits for some of it is slowed down, also in other threads. Whoever sends
packets has to be as slow.
"""

from __future__ import annotations

import queue
import select
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any


def slow_down(times: float) -> None:
    """Let time pass slower in this process; call it before other modules are imported.

    Args:
        times: real seconds of a second.
    """
    for name in ("monotonic", "perf_counter", "time"):
        clock = getattr(time, name)
        # A plain function would become a method where a class stores it, as pyserial's does.
        setattr(time, name, partial(_now, clock, clock(), times))
    real_sleep, real_select = time.sleep, select.select
    condition_wait = threading.Condition.wait

    def sleep(seconds: float) -> None:
        real_sleep(seconds * times)

    def wait_for_files(reads: Any, writes: Any, others: Any, seconds: float | None = None) -> Any:
        return real_select(reads, writes, others, None if seconds is None else seconds * times)

    def wait(self: threading.Condition, seconds: float | None = None) -> bool:
        return condition_wait(self, None if seconds is None else seconds * times)

    class SlowQueue(queue.SimpleQueue):  # type: ignore[type-arg]
        def get(self, block: bool = True, timeout: float | None = None) -> Any:
            return super().get(block, None if timeout is None else timeout * times)

    time.sleep, select.select = sleep, wait_for_files
    threading.Condition.wait = wait  # type: ignore[method-assign]
    queue.SimpleQueue = SlowQueue  # type: ignore[misc]


def _now(clock: Callable[[], float], start_s: float, times: float) -> float:
    return start_s + (clock() - start_s) / times


if __name__ == "__main__":
    slow_down(float(sys.argv.pop(1)))
    from edgepose.cli import main

    main()
