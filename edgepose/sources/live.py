"""Live samples of any number of serial ports and CAN buses."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import cache
from math import inf
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any, NamedTuple, Protocol

from edgepose.errors import DeviceError, EdgeposeError
from edgepose.imu import ImuSample
from edgepose.placements import PLACEMENTS
from edgepose.sources import POLL_S, Batch, Batches, Device, SourceCounters, sum_counters
from edgepose.sources.clock_sync import DeviceClock, HostClocks
from edgepose.sources.line_decoder import Clock, LineDecoder, PlacementById
from edgepose.sources.protocol_detection import Chunk
from firmware_protocols import registry

_log = logging.getLogger(__name__)

SILENCE_S = 5.0
"""How long a line may say nothing at the start."""

BACKLOG_S = 0.5
"""Longest time to throw away what has waited, seconds; a line that is never empty is read from then on."""

NOISE_S = 3.0
"""How long there may be data at the start without one usable packet in them."""

REOPEN_S = 0.5
"""Time between two attempts to open a line that has gone, seconds."""

FULL_POLLS = 32
"""Looks in a row that may leave something on a line; no system keeps more, and what goes on is a flood."""

_SETTLE_S = 0.1
"""How long to throw away at least: what has waited in the system comes in several pieces."""

_DUPLICATE_JUMPS = 20  # jumps of a clock within a second that one device does not make


class LineDisconnectedError(Exception):
    """The port or bus has disappeared."""


class Transport(Protocol):
    """An open port or bus."""

    def read(self) -> tuple[Chunk, bool]:
        """What is there, waiting up to POLL_S for the first of it, and whether more waits already.

        Raises:
            LineDisconnectedError: there is nothing to read from any more.
        """

    def close(self) -> None:
        """Give it free."""

    @property
    def waiting(self) -> Callable[[], tuple[Chunk, bool]] | None:
        """As `read`, but without waiting; what it gives is all there was, unless it says that more may wait.

        None where only `read` can.
        """


class LineSpec(NamedTuple):
    """One line to listen to.

    Attributes:
        name: port or bus, for messages.
        open: opens it.
        protocols: what it may speak.
        places: its map of ids, once the protocol is known.
        unit: what it carries, "bytes" or "frames".
        check: what to check when nothing comes, and when nothing can be understood.
    """

    name: str
    open: Callable[[], Transport]
    protocols: Sequence[registry.Protocol]
    places: Callable[[registry.Protocol], PlacementById]
    unit: str
    check: tuple[str, str]


class _LineReader:
    """Reads one line, and opens it again when it was gone.

    A thread waits for the line; if nobody is to wait, and the line can be looked at, only while it is being
    emptied at its start or has gone.
    """

    def __init__(
        self,
        link: LineSpec,
        handle: Transport,
        claimed: dict[int, str],
        queue: SimpleQueue,
        now: Callable[[], float],
        blocking: bool,
    ) -> None:
        self.link = link
        self.handle: Transport | None = handle
        self.clocks: HostClocks | None = None
        self.stream = LineDecoder(link.name, link.protocols, link.places, self._clock, claimed)
        self.jumps: dict[int, int] = {}  # of the devices' clocks, a second ago
        self.duplicate_ids = False
        self.warned = False  # that nothing usable comes
        self._queue = queue
        self._now = now
        self._blocking = blocking
        self._look: Callable[[], tuple[Chunk, bool]] | None = None  # while no thread reads
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(self._drain,), daemon=True, name=link.name)

    def _clock(self, wrap_us: int) -> Clock:
        self.clocks = HostClocks(wrap_us)
        return self.clocks.time

    def start(self) -> None:
        self._thread.start()

    def poll(self) -> tuple[Chunk, bool]:
        """What has come, and whether more may wait, where no thread reads; nothing where one does."""
        if self._look is None:
            return b"", False
        try:
            return self._look()
        except LineDisconnectedError:
            self._look = None
            self._thread = threading.Thread(
                target=self._run, args=(self._reopen,), daemon=True, name=self.link.name
            )
            self._thread.start()
            return b"", False

    def _run(self, first: Callable[[], None]) -> None:
        try:
            first()
            while not self._stop.is_set():
                assert self.handle is not None
                if not self._blocking and self.handle.waiting is not None:
                    self._look = self.handle.waiting
                    return
                try:
                    chunk, _ = self.handle.read()
                    if chunk:
                        self._queue.put((self, self._now(), chunk))
                except LineDisconnectedError:
                    self._reopen()
        except BaseException as error:  # for the thread that can tell the user
            self._queue.put((self, self._now(), _told(self.link, error)))

    def _drain(self) -> None:
        # What has waited since the line was opened is of unknown age, and full buffers have lost parts of it.
        start_s = self._now()
        while self.handle is not None and (passed_s := self._now() - start_s) < BACKLOG_S:
            try:
                if not self.handle.read()[1] and passed_s >= _SETTLE_S:
                    return
            except LineDisconnectedError:  # the next read tells
                return

    def _reopen(self) -> None:
        gone_s = self._now()
        assert self.handle is not None
        self.handle.close()
        self.handle = None
        _log.warning("%s: gone; the run goes on and waits for it", self.link.name)
        while not self._stop.wait(REOPEN_S):
            try:
                self.handle = self.link.open()
            except EdgeposeError:
                continue
            _log.warning("%s: back after %.1f s", self.link.name, self._now() - gone_s)
            self._drain()
            return

    def stop(self) -> None:
        """Reads no more, without waiting for what is under way."""
        self._stop.set()

    def close(self) -> None:
        self.stop()
        if self._thread.is_alive():
            self._thread.join()
        if self.handle is not None:
            self.handle.close()


Arrival = tuple[_LineReader, float, Any]
"""A line, when something came over it, and what: a chunk, or what ended its thread."""


class _Arrivals(NamedTuple):
    """What there is for a batch.

    Attributes:
        arrivals: what came.
        since_s: it may have waited since then, although it was seen later.
        emptied: nothing is known to wait behind it.
    """

    arrivals: list[Arrival]
    since_s: float
    emptied: bool


class LiveSource:
    """Samples from serial ports and CAN buses. A line that disappears is opened again when it is back."""

    def __init__(
        self,
        links: Sequence[LineSpec],
        lenient: bool = False,
        blocking: bool = True,
    ) -> None:
        """Nothing is opened yet.

        Args:
            links: what to listen to.
            lenient: warn of a line on which nothing usable comes, and go on with the others.
            blocking: see `open_source`.
        """
        self._blocking = blocking
        self._lenient = lenient
        self._links = links
        self._lines: list[_LineReader] = []
        self._queue: SimpleQueue = SimpleQueue()
        self._open = ExitStack()

    @property
    def counters(self) -> SourceCounters:
        """What has come in so far."""
        return sum_counters(line.stream.counters for line in self._lines)

    @property
    def clocks(self) -> Mapping[int, DeviceClock]:
        """Clocks of the sensors that send a time, by placement."""
        return {
            place: clock
            for line in self._lines
            if line.clocks is not None
            for place, clock in line.clocks.devices.items()
        }

    @property
    def devices(self) -> Mapping[int, Device]:
        """What has sent samples so far, by placement."""
        return {place: device for line in self._lines for place, device in line.stream.devices.items()}

    @property
    def damage(self) -> str | None:
        """Always None: trouble is told when it happens."""
        return None

    def __enter__(self) -> LiveSource:
        """Open all lines.

        Raises:
            DeviceError: one is not there, in use, or not allowed.
        """
        claimed: dict[int, str] = {}
        with ExitStack() as stack:
            for link in self._links:
                handle = link.open()
                stack.callback(handle.close)
                line = _LineReader(link, handle, claimed, self._queue, _now, self._blocking)
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
        """Batches as they come, without end.

        Raises:
            DeviceError: nothing usable comes at the start, or a line cannot be read.
        """
        start_s = checked_s = now_s = _now()
        for line in self._lines:
            line.start()
        try:
            for came, since_s, emptied in self._wait_for_data() if self._blocking else self._poll_lines():
                samples, raw, error = _fed(came)
                # On a machine that is behind, what has not been taken from queue or line is not missing yet.
                if emptied:
                    now_s = max(now_s, *(arrival_s for _, arrival_s, _ in came)) if came else _now()
                if raw or error is None:
                    yield Batch(now_s, samples, raw, _now() - min(now_s, since_s))
                if error is not None:
                    raise error
                for line in self._lines:
                    self._check_start(line, now_s, start_s)
                if now_s - checked_s > 1.0:
                    checked_s = now_s
                    for line in self._lines:
                        _warn_of_duplicate_ids(line)
        finally:
            for line in self._lines:
                line.stop()

    def _wait_for_data(self) -> Iterator[_Arrivals]:
        """The next that comes, or nothing where nothing comes within POLL_S."""
        while True:
            try:
                came = [self._queue.get(timeout=POLL_S)]
            except Empty:
                came = []
            yield _Arrivals(came, inf, True)

    def _poll_lines(self) -> Iterator[_Arrivals]:
        """All that has come."""
        since_s, full = _now(), 0
        while True:
            poll_s, left = _now(), False
            came: list[Arrival] = [self._queue.get() for _ in range(self._queue.qsize())]
            for line in self._lines:
                chunk, more = line.poll()
                left |= more
                if chunk:
                    came.append((line, _now(), chunk))
            full = full + 1 if left else 0
            yield _Arrivals(came, since_s, not left or full > FULL_POLLS)
            since_s = poll_s

    def _check_start(self, line: _LineReader, now_s: float, start_s: float) -> None:
        if line.warned:
            return
        try:
            _check_start(line, now_s, start_s)
        except EdgeposeError as error:
            if not self._lenient:
                raise
            line.warned = True
            _log.warning("%s", error)


def _fed(came: list[Arrival]) -> tuple[list[ImuSample], list[tuple[float, Any]], BaseException | None]:
    """Samples of what came and what it was, up to an error."""
    samples: list[ImuSample] = []
    raw: list[tuple[float, Any]] = []
    for line, arrival_s, chunk in came:
        if isinstance(chunk, BaseException):
            return samples, raw, chunk
        raw += [(arrival_s, piece) for piece in ([chunk] if isinstance(chunk, bytes) else chunk)]
        try:
            samples += line.stream.feed(chunk, arrival_s)
        except Exception as error:
            return samples, raw, error
    return samples, raw, None


def _now() -> float:
    """Unix time that never jumps."""
    return _unix_s() + time.monotonic()


@cache
def _unix_s() -> float:
    """Unix time at 0 of the monotonic clock, the same for all sources: wearers share their ticks."""
    return time.time() - time.monotonic()


def _told(link: LineSpec, error: BaseException) -> EdgeposeError:
    """What ended a line's thread, for the user; makers' libraries fail in ways that nobody has foreseen."""
    if isinstance(error, EdgeposeError):
        return error
    text = (str(error).splitlines() or [""])[0]
    told = DeviceError(
        f"{link.name}: reading it failed ({type(error).__name__}: {text}); edgepose --debug shows where"
    )
    told.__cause__ = error
    return told


def _check_start(line: _LineReader, now_s: float, start_s: float) -> None:
    stream, link = line.stream, line.link
    if stream.first_s is None:
        if now_s - start_s > SILENCE_S and line.handle is not None:
            raise DeviceError(f"{link.name}: nothing came for {SILENCE_S:g} s; check {link.check[0]}")
    elif now_s - stream.first_s > NOISE_S and not stream.counters.packets:
        if stream.unknown_ids:
            ids = ", ".join(map(str, stream.unknown_ids))
            raise DeviceError(
                f"{link.name}: packets come only of sensor ids {ids}; give the sensors the ids {stream.ids}, "
                "or say with --sensors which is where"
            )
        what = "" if stream.protocol is None else f"{stream.protocol.name} "
        raise DeviceError(
            f"{link.name}: {stream.amount} {link.unit} in {NOISE_S:g} s and not one valid {what}packet; "
            f"check {link.check[1]}"
        )


def _warn_of_duplicate_ids(line: _LineReader) -> None:
    """A clock that began anew is told; two devices with one id look like one that jumps to and fro."""
    devices = {} if line.clocks is None else line.clocks.devices
    for place, clock in devices.items():
        if clock.resets - line.jumps.get(place, 0) >= _DUPLICATE_JUMPS and not line.duplicate_ids:
            line.duplicate_ids = True
            _log.warning(
                "%s: the clock of the sensor for %s jumps to and fro; are there two devices with its id?",
                line.link.name,
                PLACEMENTS[place],
            )
        elif clock.resets > line.jumps.get(place, 0):
            _log.warning(
                "%s: the clock of the sensor for %s began anew; if it was switched off, its heading may be "
                "another: calibrate again",
                line.link.name,
                PLACEMENTS[place],
            )
        line.jumps[place] = clock.resets
