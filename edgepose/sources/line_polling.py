"""Reading of live lines by the thread that uses their data: no hand-over between threads per packet."""

from __future__ import annotations

import select
import threading
import time
from collections.abc import Callable, Sequence
from queue import SimpleQueue

from edgepose.sources.line_reader import Arrival, LineReader
from edgepose.utils.background import Background

KEPT_S = 0.05
"""Time after which a thread reads the lines in place of a caller who is busy, seconds.

The system's buffer for a serial port holds 4 kB, which six sensors fill in a tenth of a second.
"""


LOOK_S = 0.005
"""Time between two looks at lines that cannot be waited for yet, seconds."""


class LinePoller(Background):
    """Polls lines, and waits for data on any of them.

    While nobody polls, such as while an output is stuck, a thread collects what comes, so that nothing is
    lost.
    """

    def __init__(
        self, lines: Sequence[LineReader], queue: SimpleQueue[Arrival], now: Callable[[], float]
    ) -> None:
        """Store the lines.

        Args:
            lines: lines that are polled; others are read by threads of their own.
            queue: the arrivals from threads.
            now: the source's clock, seconds.
        """
        super().__init__("keeper")
        self.polled_s = now()
        self._lines, self._queue, self._now = lines, queue, now
        self._lock = threading.Lock()

    @property
    def files(self) -> list[int]:
        """Files that become readable when data come over the lines that can be polled now."""
        return [line.file for line in self._lines if line.file is not None]

    def wait(self, seconds: float) -> Sequence[int]:
        """Wait for data up to a time, seconds; return the files that are readable."""
        files = self.files
        if not files:  # as long as all lines are being emptied or reopened
            time.sleep(min(seconds, LOOK_S))
            return ()
        try:
            return select.select(files, (), (), seconds)[0]
        except OSError:  # meanwhile a thread has found a line disconnected, and closed it
            return ()

    def poll(self, readable: Sequence[int] | None = None) -> list[Arrival]:
        """Return everything that has come since the last call, and reports of lines that nothing came over.

        Args:
            readable: files with data, as `wait` returns them; None if that is unknown.
        """
        with self._lock:
            self.polled_s = now_s = self._now()
            arrivals = [self._queue.get() for _ in range(self._queue.qsize())]
            for line in self._lines:
                arrival = line.poll(now_s, readable is None or line.file in readable)
                if arrival is not None:
                    arrivals.append(arrival)
        return arrivals

    def _work(self) -> None:
        while not self._stop.wait(KEPT_S):
            with self._lock:
                now_s = self._now()
                if now_s - self.polled_s > KEPT_S:
                    self._keep_arrivals(now_s)

    def _keep_arrivals(self, now_s: float) -> None:
        for line in self._lines:
            # The rest stays in the system's buffer.
            arrival = line.poll(now_s) if self._queue.qsize() <= line.spec.most_waiting else None
            if arrival is not None and arrival.data:
                self._queue.put(arrival)
