"""Live samples from any number of serial ports, CAN buses and sockets."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import cache
from math import inf
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any, NamedTuple

from edgepose.errors import EdgeposeError
from edgepose.imu import ImuSample
from edgepose.sources import POLL_S, Batch, Batches, Device, SourceCounters, sum_counters
from edgepose.sources.clock_sync import DeviceClock
from edgepose.sources.line_checks import check_start, warn_about_clock_resets, warn_about_refused
from edgepose.sources.line_reader import Arrival, LineReader, LineSpec

_log = logging.getLogger(__name__)

UNREAD_S = 1.0
"""Longest time for which a line that reports nothing delays the frames, seconds: its driver may be stuck."""


class _Arrivals(NamedTuple):
    """Data for one batch.

    Attributes:
        arrivals: the data, in order of arrival.
        since_s: the earliest time at which data may have come that was only seen now.
    """

    arrivals: list[Arrival]
    since_s: float


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
    ) -> None:
        """Store the settings; `__enter__` opens the lines.

        Args:
            specs: lines to read from.
            lenient: warn about a line without usable data instead of raising, and go on with the others.
            blocking: see `open_source`.
        """
        self._blocking = blocking
        self._lenient = lenient
        self._specs = specs
        self._lines: list[LineReader] = []
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
            for spec in self._specs:
                transport = spec.open()
                stack.callback(transport.close)
                line = LineReader(spec, transport, placement_owner, self._queue, unix_now, self._blocking)
                self._lines.append(line)
            stack.pop_all()
        for line in self._lines:
            self._open.callback(line.close)
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
            for arrivals, since_s in self._wait_for_data() if self._blocking else self._poll_lines():
                samples, raw, error = _decode_arrivals(arrivals)
                arrival_s = max(now_s, *(arrival.time_s for arrival in arrivals)) if arrivals else unix_now()
                now_s = read.update(arrivals, arrival_s)
                if raw or error is None:
                    yield Batch(now_s, samples, raw, unix_now() - min(arrival_s, since_s), arrival_s - now_s)
                if error is not None:
                    raise error
                for line in self._lines:
                    self._check_start(line, now_s, start_s)
                if now_s - checked_s > 1.0:
                    checked_s = now_s
                    for line in self._lines:
                        warn_about_clock_resets(line)
                        if line.decoder.counters.packets:
                            warn_about_refused(line)
        finally:
            for line in self._lines:
                line.stop()

    def _wait_for_data(self) -> Iterator[_Arrivals]:
        """Yield each arrival by itself, or an empty batch after POLL_S without any."""
        while True:
            try:
                arrivals = [self._queue.get(timeout=POLL_S)]
            except Empty:
                arrivals = []
            yield _Arrivals(arrivals, inf)

    def _poll_lines(self) -> Iterator[_Arrivals]:
        """Yield everything that has come since the last batch, without waiting."""
        since_s = unix_now()
        while True:
            poll_s = unix_now()
            arrivals = [self._queue.get() for _ in range(self._queue.qsize())]
            polled = [line.poll() for line in self._lines]
            yield _Arrivals(arrivals + [arrival for arrival in polled if arrival is not None], since_s)
            since_s = poll_s

    def _check_start(self, line: LineReader, now_s: float, start_s: float) -> None:
        if line.start_checked:
            return
        try:
            check_start(line, now_s, start_s)
        except EdgeposeError as error:
            if not self._lenient:
                raise
            line.start_checked = True
            _log.warning("%s", error)


def _decode_arrivals(
    arrivals: Iterable[Arrival],
) -> tuple[list[ImuSample], list[tuple[float, Any]], BaseException | None]:
    """Return the samples and the raw data of arrivals up to the first error, and that error."""
    samples: list[ImuSample] = []
    raw: list[tuple[float, Any]] = []
    for line, arrival_s, chunk, _ in arrivals:
        if isinstance(chunk, BaseException):
            return samples, raw, chunk
        if not chunk:
            continue
        raw += [(arrival_s, piece) for piece in ([chunk] if isinstance(chunk, bytes) else chunk)]
        try:
            samples += line.decoder.feed(chunk, arrival_s)
        except Exception as error:
            return samples, raw, error
    return samples, raw, None


def unix_now() -> float:
    """Return the Unix time, seconds, on the clock of live sources, which never jumps."""
    return _unix_s() + time.monotonic()


@cache
def _unix_s() -> float:
    """Unix time at 0 of the monotonic clock; one value for all sources, because wearers share their ticks."""
    return time.time() - time.monotonic()
