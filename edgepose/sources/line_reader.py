"""One live line: the interface of an open port, bus or socket, and the reader that collects its data."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Sequence
from math import inf
from queue import SimpleQueue
from typing import Any, NamedTuple, Protocol

from edgepose.errors import DeviceError, EdgeposeError
from edgepose.sources import POLL_S
from edgepose.sources.clock_sync import DeviceClock, HostClocks
from edgepose.sources.line_decoder import Clock, LineDecoder, PlacementById
from edgepose.sources.protocol_detection import Chunk
from edgepose.sources.sender_decoders import SenderDecoders, SenderPlacements
from firmware_protocols import registry

_log = logging.getLogger(__name__)

BACKLOG_S = 0.5
"""Longest time spent discarding old data, seconds; a line that is never empty is read from then on."""

REOPEN_S = 0.5
"""Time between two attempts to open a line that has disappeared, seconds."""

FULL_READS = 32
"""Reads in a row that may leave data on a line; no system buffers more, so a longer series is a flood."""

_SETTLE_S = 0.1
"""Shortest time spent discarding: data that the system has buffered comes in several pieces."""

_FULL_S = 0.001
"""Time between two looks at a queue that is too long, seconds."""


class LineDisconnectedError(Exception):
    """The port or bus has disappeared, or the connection has ended."""


class Transport(Protocol):
    """An open port, bus or socket."""

    def read(self) -> tuple[Chunk, bool]:
        """Return the available data, waiting up to POLL_S for the first of it, and whether more is waiting.

        Raises:
            LineDisconnectedError: the port or bus no longer exists.
        """

    def close(self) -> None:
        """Release it."""

    @property
    def waiting(self) -> Callable[[], tuple[Chunk, bool]] | None:
        """A non-blocking `read`; None if the transport has none.

        It returns all data that was available unless it says that more may be waiting.
        """

    @property
    def file(self) -> int | None:
        """Number of the file that is readable while data are `waiting`; None if there is none to wait for."""


class LineSpec(NamedTuple):
    """One line to read from.

    Attributes:
        name: port or bus, for messages.
        open: opens it.
        protocols: wire formats that the line may use.
        placements: the line's map from ids to placements, once the protocol is known.
        unit: "bytes", "frames", "datagrams", "notifications" or "reports", for messages.
        check: advice for the user if no data comes, and if none of it can be decoded.
        senders: for sockets, the maps of `placements` by sender; None for lines without senders.
        most_waiting: number of arrivals from which on the rest stays in the system's buffer. Only lines of
            the network and of Bluetooth have a limit: no other can be flooded faster than it is decoded.
    """

    name: str
    open: Callable[[], Transport]
    protocols: Sequence[registry.Protocol]
    placements: Callable[[registry.Protocol], PlacementById]
    unit: str
    check: tuple[str, str]
    senders: SenderPlacements | None = None
    most_waiting: float = inf


class Arrival(NamedTuple):
    """Data that came over a line, or a report that none did.

    Attributes:
        line: the line.
        time_s: time at which it was read, on the source's clock, seconds.
        data: bytes or messages, empty if nothing came; or the error that ended the line's thread.
        read_s: time up to which everything that came over the line has been read, seconds: `inf` while it is
            disconnected, `-inf` if more is waiting.
    """

    line: LineReader
    time_s: float
    data: Any
    read_s: float


class LineReader:
    """Reads one line, and reopens it after a disconnect.

    A thread reads the line all the time, unless it is to be polled and the transport can be: then the thread
    only empties the line at the start and reopens it after a disconnect.

    Attributes:
        spec: the line's name, protocols and advice.
        transport: the open port or bus; None while it is disconnected.
        file: number of the file that is readable when `poll` would return data; None while the thread reads.
        clocks: clocks of the line's devices that send a time, by placement.
        decoder: turns the line's data into samples.
        clock_resets: resets of each device's clock at the last check, by placement.
        duplicate_ids: the user has been warned about two devices with one id.
        start_checked: usable packets have come, or the user has been warned that none do.
        refused_reported: the user has been warned about input that cannot be used.
    """

    def __init__(
        self,
        spec: LineSpec,
        transport: Transport,
        placement_owner: dict[int, str],
        queue: SimpleQueue[Arrival],
        now: Callable[[], float],
        polled: bool,
    ) -> None:
        """Prepare to read; `start` begins.

        Args:
            spec: the line.
            transport: the open line, closed by this reader.
            placement_owner: see `LineDecoder`.
            queue: gets an `Arrival` from the thread after each read.
            now: the source's clock, seconds.
            polled: read by calls of `poll`, if the transport allows it.
        """
        self.spec = spec
        self.transport: Transport | None = transport
        self.file: int | None = None
        self.clocks: dict[int, DeviceClock] = {}
        self.decoder: LineDecoder | SenderDecoders
        if spec.senders is None:
            self.decoder = LineDecoder(
                spec.name, spec.protocols, spec.placements, self._clock, placement_owner
            )
        else:
            self.decoder = SenderDecoders(
                spec.name, spec.protocols, spec.senders, self._clock, placement_owner
            )
        self.clock_resets: dict[int, int] = {}
        self.duplicate_ids = False
        self.start_checked = False
        self.refused_reported = False
        self._queue = queue
        self._now = now
        self._polled = polled
        self._polled_s = -inf
        self._poll: Callable[[], tuple[Chunk, bool]] | None = None  # None while the thread reads
        self._full_reads = 0  # in a row
        self._stop = threading.Event()
        self._thread = self._thread_from(self._drain)

    def _clock(self, wrap_us: int) -> Clock:
        return HostClocks(wrap_us, self.clocks).time

    def _thread_from(self, first: Callable[[], None]) -> threading.Thread:
        return threading.Thread(target=self._run, args=(first,), daemon=True, name=self.spec.name)

    def start(self) -> None:
        """Start the thread that empties the line and then reads it."""
        self._thread.start()

    def poll(self, now_s: float, has_data: bool = True) -> Arrival | None:
        """Return the data waiting on the line; None while the thread reads.

        Args:
            now_s: the present on the source's clock, seconds.
            has_data: false if the line's `file` is not readable.
        """
        if self._poll is None:
            return None
        # Hosts of trackers have something to send even if nothing comes.
        if not has_data and now_s - self._polled_s < POLL_S:
            return Arrival(self, now_s, b"", now_s)
        self._polled_s = now_s
        try:
            chunk, more = self._poll()
        except LineDisconnectedError:
            self._poll = self.file = None
            self._thread = self._thread_from(self._reopen)
            self._thread.start()
            return None
        except Exception as error:  # raised again by the source
            self._poll = self.file = None
            return Arrival(self, now_s, _reading_error(self.spec, error), -inf)
        return self._arrival(chunk, more)

    def _arrival(self, chunk: Chunk, more: bool) -> Arrival:
        # After the read: a packet that seems to come before it was sent would set its sensor's clock wrong.
        now_s = self._now()
        self._full_reads = self._full_reads + 1 if more else 0
        return Arrival(self, now_s, chunk, -inf if 0 < self._full_reads <= FULL_READS else now_s)

    def _run(self, first: Callable[[], None]) -> None:
        try:
            first()
            while not self._stop.is_set():
                assert self.transport is not None
                if self._polled and self.transport.waiting is not None:
                    self._poll, self.file = self.transport.waiting, self.transport.file
                    return
                if self._queue.qsize() > self.spec.most_waiting:
                    self._stop.wait(_FULL_S)
                    continue
                try:
                    chunk, more = self.transport.read()
                    self._queue.put(self._arrival(chunk, more))
                except LineDisconnectedError:
                    self._reopen()
        except BaseException as error:  # raised again in the thread that iterates over the source
            self._queue.put(Arrival(self, self._now(), _reading_error(self.spec, error), -inf))

    def _drain(self) -> None:
        if self.transport is not None:
            with contextlib.suppress(LineDisconnectedError):  # the next read raises it again
                discard_backlog(self.transport)

    def _reopen(self) -> None:
        disconnected_s = self._now()
        assert self.transport is not None
        self.transport.close()
        self.transport = None
        self._queue.put(Arrival(self, disconnected_s, b"", inf))
        _log.warning("%s: disconnected; the run continues and waits for it", self.spec.name)
        while not self._stop.wait(REOPEN_S):
            try:
                self.transport = self.spec.open()
            except EdgeposeError:
                continue
            _log.warning("%s: back after %.1f s", self.spec.name, self._now() - disconnected_s)
            self._drain()
            return

    def stop(self) -> None:
        """Stop reading, without waiting for a read in progress."""
        self._stop.set()

    def close(self) -> None:
        """Stop reading and close the line."""
        self.stop()
        if self._thread.is_alive():
            self._thread.join()
        if self.transport is not None:
            self.transport.close()


def discard_backlog(transport: Transport) -> None:
    """Read and discard the data that was buffered before a line was opened.

    Its age is unknown, and full buffers have lost parts of it.

    Raises:
        LineDisconnectedError: the port or bus no longer exists.
    """
    start_s = time.monotonic()
    while (passed_s := time.monotonic() - start_s) < BACKLOG_S:
        if not transport.read()[1] and passed_s >= _SETTLE_S:
            return


def _reading_error(spec: LineSpec, error: BaseException) -> EdgeposeError:
    """Return the error to report for a failed read; vendor libraries raise arbitrary exceptions."""
    if isinstance(error, EdgeposeError):
        return error
    text = (str(error).splitlines() or [""])[0]
    reported = DeviceError(
        f"{spec.name}: reading failed ({type(error).__name__}: {text}); edgepose --debug shows where"
    )
    reported.__cause__ = error
    return reported
