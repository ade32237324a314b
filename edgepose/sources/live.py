"""Live samples from any number of serial ports, CAN buses and sockets."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from math import inf
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any

from edgepose.errors import EdgeposeError
from edgepose.imu import ImuSample
from edgepose.sources import POLL_S, Batch, Batches, Device, SourceCounters, sum_counters
from edgepose.sources.clock_sync import DeviceClock
from edgepose.sources.line_checks import check_start, warn_about_clock_resets, warn_about_refused
from edgepose.sources.line_polling import LinePoller
from edgepose.sources.line_reader import Arrival, LineReader, LineSpec

_log = logging.getLogger(__name__)

_LEAST_REST_S = 0.001
"""Shortest time for which packets are gathered, seconds; for less it does not pay."""

_STEP = 0.618
"""Fraction by which the reading between two batches moves: its multiples fill the time from 0 to 1 evenly."""

_AT_ONCE_S = 0.0002
"""Data that a shorter wait finds may have come before it, seconds."""

UNREAD_S = 1.0
"""Longest time for which a line that reports nothing delays the frames, seconds: its driver may be stuck."""


class _Gathered:
    """Data for one batch, decoded as they come.

    Attributes:
        arrivals: the data, in order of arrival.
        samples: the samples in them, up to the first error.
        raw: the undecoded data and their times, see `Batch`.
        error: the first error.
        since_s: the earliest time at which data may have come that was only seen now.
    """

    def __init__(self, arrivals: Iterable[Arrival] = (), since_s: float = inf) -> None:
        """Decode arrivals."""
        self.arrivals: list[Arrival] = []
        self.samples: list[ImuSample] = []
        self.raw: list[tuple[float, Any]] = []
        self.error: BaseException | None = None
        self.since_s = since_s
        self.add(arrivals)

    def add(self, arrivals: Iterable[Arrival]) -> None:
        """Decode more arrivals; after an error they are dropped."""
        self.arrivals += arrivals
        for line, arrival_s, chunk, _ in arrivals:
            if self.error is not None or not chunk:
                continue
            if isinstance(chunk, BaseException):
                self.error = chunk
                continue
            self.raw += [(arrival_s, piece) for piece in ([chunk] if isinstance(chunk, bytes) else chunk)]
            try:
                self.samples += line.decoder.feed(chunk, arrival_s)
            except Exception as error:
                self.error = error


class _ReadTime:
    """Time up to which all lines have been read.

    On a busy machine a thread may get no turn to read its line, although data is waiting there. Whether a
    sample is missing is therefore judged by what the lines report, not by the time that has passed.
    """

    def __init__(self, lines: Sequence[LineReader], now_s: float) -> None:
        """Wait for no line before its first report; the present is now_s on the source's clock, seconds."""
        self._read_s = dict.fromkeys(lines, inf)
        self._quiet_s = dict.fromkeys(lines, 0.0)  # without a report although this thread had its turns
        self._called_s = self._result = now_s

    def update(self, arrivals: Iterable[Arrival], now_s: float) -> float:
        """Return the time up to which everything that came has been read, seconds; it never goes back."""
        passed_s = min(now_s - self._called_s, POLL_S)
        self._called_s = now_s
        for line in self._quiet_s:
            self._quiet_s[line] += passed_s
        for line, _, _, read_s in arrivals:
            self._quiet_s[line] = 0.0
            if read_s > -inf:
                self._read_s[line] = read_s
        lines = [line for line, quiet_s in self._quiet_s.items() if quiet_s <= UNREAD_S]
        self._result = max(self._result, min([now_s, *(self._read_s[line] for line in lines)]))
        return self._result


class LiveSource:
    """Samples from serial ports, CAN buses and sockets. Lines that disappear are reopened."""

    def __init__(
        self,
        specs: Sequence[LineSpec],
        lenient: bool = False,
        blocking: bool = True,
        wanted: Callable[[], float] | None = None,
    ) -> None:
        """Store the settings; `__enter__` opens the lines.

        Args:
            specs: lines to read from.
            lenient: warn about a line without usable data instead of raising, and go on with the others.
            blocking: see `open_source`.
            wanted: see `open_source`.
        """
        self._blocking, self._wanted = blocking, wanted or (lambda: -inf)
        self._gathers = blocking and wanted is not None
        self._lenient = lenient
        self._specs = specs
        self._lines: list[LineReader] = []
        self._batches = self._poll_lines
        self._all_started = False  # usable data have come over all lines
        self._all_timed = False  # all devices send times
        self._queue: SimpleQueue[Arrival] = SimpleQueue()
        self._open = ExitStack()

    @property
    def counters(self) -> SourceCounters:
        """Counts of the packets received so far."""
        return sum_counters(line.decoder.counters for line in self._lines)

    @property
    def clocks(self) -> Mapping[int, DeviceClock]:
        """Clocks of the sensors that send a time, by placement."""
        return {placement: clock for line in self._lines for placement, clock in line.clocks.items()}

    @property
    def devices(self) -> Mapping[int, Device]:
        """Devices that have sent samples so far, by placement."""
        return {
            placement: device for line in self._lines for placement, device in line.decoder.devices.items()
        }

    @property
    def metadata(self) -> Mapping[str, str]:
        """Always empty: what arrives says nothing about itself."""
        return {}

    @property
    def damage(self) -> str | None:
        """Always None: problems are reported when they happen."""
        return None

    def __enter__(self) -> LiveSource:
        """Open all lines.

        Raises:
            DeviceError: a line does not exist, is in use, or may not be opened.
        """
        placement_owner: dict[int, str] = {}
        with ExitStack() as stack:
            transports = []
            for spec in self._specs:
                transports.append(spec.open())
                stack.callback(transports[-1].close)
            stack.pop_all()
        if self._gathers and all(transport.file is not None for transport in transports):
            self._batches = self._gather
        elif self._blocking:
            self._batches = self._wait_for_data
        polled = self._batches != self._wait_for_data
        for spec, transport in zip(self._specs, transports, strict=True):
            line = LineReader(spec, transport, placement_owner, self._queue, unix_now, polled)
            self._lines.append(line)
            self._open.callback(line.close)
        self._poller = LinePoller(self._lines, self._queue, unix_now)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close all lines."""
        self._open.close()

    def __iter__(self) -> Batches:
        """Yield batches as data comes, without end.

        Raises:
            DeviceError: nothing usable comes at the start, or a line cannot be read.
        """
        start_s = checked_s = now_s = unix_now()
        read = _ReadTime(self._lines, start_s)
        for line in self._lines:
            line.start()
        try:
            for data in self._batches():
                times_s = [arrival.time_s for arrival in data.arrivals]
                arrival_s = max(now_s, *times_s) if times_s else unix_now()
                now_s = read.update(data.arrivals, arrival_s)
                if data.raw or data.error is None:
                    backlog_s = unix_now() - min(arrival_s, data.since_s)
                    yield Batch(now_s, data.samples, data.raw, backlog_s, arrival_s - now_s)
                if data.error is not None:
                    raise data.error
                if not self._all_started:
                    self._all_started = all([self._has_started(line, now_s, start_s) for line in self._lines])
                if now_s - checked_s > 1.0:
                    checked_s = now_s
                    self._all_timed = len(self.clocks) == len(self.devices)
                    for line in self._lines:
                        warn_about_clock_resets(line)
                        if line.decoder.counters.packets:
                            warn_about_refused(line)
        finally:
            for line in self._lines:
                line.stop()

    def _wait_for_data(self) -> Iterator[_Gathered]:
        """Yield what threads have read by the time that is `wanted`, or an empty batch after POLL_S."""
        while True:
            rest_s = min(self._wanted() - unix_now(), POLL_S)
            if rest_s > _LEAST_REST_S:
                time.sleep(rest_s)
            try:
                arrivals = [self._queue.get(timeout=POLL_S)]
            except Empty:
                arrivals = []
            yield _Gathered(arrivals + [self._queue.get() for _ in range(self._queue.qsize())])

    def _gather(self) -> Iterator[_Gathered]:
        """Yield what has come by the time that is `wanted`, or what there is after POLL_S.

        Until then this thread sleeps, because waking up costs more than most of the work on a packet. In
        between it reads once, each time at another instant: so, again and again, packets of each sensor are
        read as soon as they come, which is what its clock is estimated from. Packets without a time are read
        at once.
        """
        share = 0.0
        with self._poller as poller:
            while True:
                data = _Gathered()
                now_s = unix_now()
                last_s = now_s + POLL_S
                wanted_s = min(self._wanted(), last_s) if self._all_timed else -inf
                if wanted_s > now_s + _LEAST_REST_S:
                    share = (share + _STEP) % 1.0
                    time.sleep(share * (wanted_s - now_s))
                    data.add(poller.poll())
                    time.sleep(max(0.0, wanted_s - unix_now()))
                seen_s, asked_s = poller.polled_s, unix_now()
                data.add(poller.poll(poller.wait(max(0.0, last_s - asked_s)) or None))
                if poller.polled_s - asked_s < _AT_ONCE_S:
                    # What came before it was wanted has not been late for any frame.
                    data.since_s = min(max(seen_s, wanted_s), asked_s)
                yield data

    def _poll_lines(self) -> Iterator[_Gathered]:
        """Yield everything that has come since the last batch, without waiting."""
        since_s = unix_now()
        while True:
            poll_s = unix_now()
            yield _Gathered(self._poller.poll(), since_s)
            since_s = poll_s

    def _has_started(self, line: LineReader, now_s: float, start_s: float) -> bool:
        if not line.start_checked:
            try:
                check_start(line, now_s, start_s)
            except EdgeposeError as error:
                if not self._lenient:
                    raise
                line.start_checked = True
                _log.warning("%s", error)
        return line.start_checked


_UNIX_S = time.time() - time.monotonic()
"""Unix time at 0 of the monotonic clock; one value for all sources, because wearers share their ticks."""


def unix_now() -> float:
    """Return the Unix time, seconds, on the clock of live sources, which never jumps."""
    return _UNIX_S + time.monotonic()
