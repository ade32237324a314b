"""How late threads get their turn on this machine, which delays whatever they read."""

from __future__ import annotations

import time
from collections import deque

from edgepose.utils.background import Background

_STEP_S = 0.02
_KEPT = 500  # of the last 10 s


class MachineLag(Background):
    """Measures, while it is entered, how much later than asked a thread wakes up."""

    def __init__(self) -> None:
        """Create the measurement; `__enter__` starts it."""
        super().__init__("machine lag")
        self._late_s: deque[float] = deque([0.0], maxlen=_KEPT)

    @property
    def late_ms(self) -> float:
        """The delay that 95 % of the last waits did not exceed, milliseconds."""
        late_s = sorted(self._late_s)
        return 1e3 * late_s[int(0.95 * (len(late_s) - 1))]

    def _work(self) -> None:
        while not self._stop.is_set():
            start_s = time.monotonic()
            self._stop.wait(_STEP_S)
            self._late_s.append(max(0.0, time.monotonic() - start_s - _STEP_S))
