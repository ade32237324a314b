"""The undecoded data of a serial port or of CAN buses, from a file."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from math import inf
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Protocol

from edgepose.errors import EdgeposeError
from edgepose.formats.ledger import Ledger
from edgepose.imu import ImuSample
from edgepose.placements import SENSORS
from edgepose.sources import Batch, Batches, Device, SourceCounters, sum_counters
from edgepose.sources.clock_sync import DeviceClock
from edgepose.sources.line_decoder import LineDecoder
from edgepose.sources.pacing import paced_batches
from edgepose.sources.protocol_detection import Chunk, decode
from edgepose.utils.fault_messages import JUMPS_OF_TWO, clock_restarted, two_devices

ChunkReader = Callable[[Path, Ledger], Iterator[tuple[str, float, Chunk | None]]]
"""Yields the chunks of a file: name of the line, time in seconds, and data; None for data that is bad."""

_log = logging.getLogger(__name__)


SET_BACK_S = 0.5
"""A log's times that go back by more are those of a clock that was set back, seconds."""

_HEAD, _STEP = 100, 16  # chunks in which the first packet is, bytes of a step towards it

_FEW = 5  # frames whose times are wrong, rather than the clock


class RestartCounts(Protocol):
    """Counts of the restarts of devices' clocks."""

    @property
    def restarts(self) -> Counter[int]:
        """Number of times that the clock of each placement's device has restarted."""


class LogSource:
    """A file with the undecoded data of a serial port or of CAN buses."""

    def __init__(
        self,
        path: Path,
        realtime: bool,
        read_chunks: ChunkReader,
        make_decoder: Callable[[str], LineDecoder],
        clocks: RestartCounts,
        blocking: bool = True,
        metadata: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Store the settings; iteration opens the file.

        Args:
            path: the file.
            realtime: deliver it at its own pace.
            read_chunks: reads the file.
            make_decoder: makes the decoder of a line, given its name.
            clocks: of the devices in the file.
            blocking: see `open_source`.
            metadata: see `Source.metadata`.
        """
        self.metadata = metadata
        self._path = path
        self._realtime, self._blocking = realtime, blocking
        self._read_chunks = read_chunks
        self._make_decoder, self._clocks = make_decoder, clocks
        self._decoders: dict[str, LineDecoder] = {}
        self._heads: dict[str, list[Chunk]] = {}
        self._bad = 0
        self._ledger = Ledger(str(path), "line")
        self._set_back_s = 0.0

    @property
    def counters(self) -> SourceCounters:
        """Counts of the packets decoded so far."""
        return sum_counters(
            [SourceCounters(bad=self._bad), *(decoder.counters for decoder in self._decoders.values())]
        )

    @property
    def clocks(self) -> Mapping[int, DeviceClock]:
        """Clocks that have restarted, without drift: most logs have no arrival times to compare with."""
        result = {}
        for placement, times in self._clocks.restarts.items():
            result[placement] = DeviceClock()
            result[placement].resets = times
        return result

    @property
    def devices(self) -> Mapping[int, Device]:
        """Devices that have sent samples so far, by placement."""
        return {
            placement: device._replace(line=None)
            for decoder in self._decoders.values()
            for placement, device in decoder.devices.items()
        }

    @property
    def damage(self) -> str | None:
        """What is wrong with the file; partial packets do not count: a log may start and end anywhere."""
        problems = [self._ledger.damage()]
        if corrupted := sum(map(self._corrupted, self._decoders)):
            problems.append(f"{self._path}: {corrupted} corrupted packets left out")
        if self._bad:
            problems.append(f"{self._path}: ignored {self._bad} frames with an impossible time or id")
        if self.counters.packets:
            problems += [f"{self._path}: {text}" for text in self._refused]
        if self._untimed:
            problems.append(f"{self._path}: left out {self._untimed} samples before the first time")
        if self._set_back_s:
            problems.append(
                f"{self._path}: its clock was set back by {self._set_back_s:.1f} s on the way; the times "
                "after that are moved on by as much"
            )
        return "; ".join(filter(None, problems)) or None

    def __enter__(self) -> LogSource:
        """Check that the file can be read.

        Raises:
            EdgeposeError: it cannot be read.
        """
        try:
            with self._path.open("rb"):
                return self
        except OSError as error:
            raise EdgeposeError(f"{self._path}: cannot read it: {error.strerror}") from None

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Nothing is open."""

    def __iter__(self) -> Batches:
        """Yield all samples in the order of the file.

        Raises:
            EdgeposeError: the file cannot be read to its end, or there is no packet in it.
        """
        for now_s, batch, late_s in paced_batches(self._samples(), self._realtime, self._blocking):
            yield Batch(now_s, batch, backlog_s=late_s)
        if not self.counters.packets:
            raise EdgeposeError(f"{self._path}: {self._problem()}")
        for placement, times in sorted(self._clocks.restarts.items()):
            fault = two_devices() if times >= JUMPS_OF_TWO else clock_restarted(times)
            _log.warning("%s: %s: %s", self._path, SENSORS[placement], fault)

    def _samples(self) -> Iterator[ImuSample]:
        steady = _SteadyTime()
        for name, arrival_s, chunk in self._read_chunks(self._path, self._ledger):
            if chunk is None:
                self._bad += 1
                continue
            time_s = steady.corrected(arrival_s)
            self._set_back_s = steady.set_back_s
            decoder = self._decoders.get(name)
            if decoder is None:
                decoder = self._decoders[name] = self._make_decoder(name)
                self._heads[name] = []
            if len(self._heads[name]) < _HEAD:
                self._heads[name].append(chunk)
            yield from decoder.feed(chunk, time_s)
        for decoder in self._decoders.values():
            yield from decoder.finish()
        timed = self.counters.packets - self._untimed
        if self._untimed and not timed:
            raise EdgeposeError(
                f"{self._path}: neither its packets nor the capture hold times; "
                "make captures with edgepose record, or switch on the device's time"
            )

    def _corrupted(self, name: str) -> int:
        """Return the number of bad packets of a line after its first good one."""
        line = self._decoders[name]
        bad = line.counters.bad
        if not bad or line.protocol is None:
            return 0
        decoder = line.protocol.decoder()
        for chunk in self._heads[name]:
            for piece in [chunk[i : i + _STEP] for i in range(0, len(chunk), _STEP)]:
                decode(decoder, piece)
                if decoder.counters.packets:
                    return bad - decoder.counters.bad
        return 0

    @property
    def _untimed(self) -> int:
        return sum(decoder.untimed for decoder in self._decoders.values())

    @property
    def _refused(self) -> list[str]:
        return [text for decoder in self._decoders.values() if (text := decoder.refused) is not None]

    def _problem(self) -> str:
        if self._refused:
            return self._refused[0]
        if not self._decoders and (damage := self._ledger.damage()):
            return f"not a log of frames ({damage})"
        decoders = self._decoders.values()
        unknown = sorted({sensor for decoder in decoders for sensor in decoder.unknown_ids})
        if unknown:
            expected = next(decoder.ids for decoder in decoders if decoder.unknown_ids)
            return (
                f"packets come only from sensor ids {', '.join(map(str, unknown))}, but the expected ids are "
                f"{expected}; assign ids to placements with --sensors"
            )
        protocols = {decoder.protocol.name for decoder in decoders if decoder.protocol is not None}
        kind = " or ".join(sorted(protocols)) or "known"
        amount = sum(decoder.amount for decoder in decoders)
        return f"no {kind} packet in {amount} bytes or frames; is it a raw capture? if so, check --protocol"


class _SteadyTime:
    """Arrival times of a log that do not go back, although its clock has been set back.

    Attributes:
        set_back_s: by how much it was set back so far, seconds.
    """

    def __init__(self) -> None:
        """Start before the first time."""
        self.set_back_s = 0.0
        self._last_s = -inf
        self._before_jump_s = -inf
        self._since_jump = 0

    def corrected(self, time_s: float) -> float:
        """Return a time, moved on if it is far before the one before it; NaN stays NaN."""
        time_s += self.set_back_s
        if time_s < self._last_s - SET_BACK_S:
            if self._since_jump < _FEW and time_s >= self._before_jump_s - SET_BACK_S:
                self._last_s = time_s  # the few before it had a wrong time, far ahead
            else:
                self.set_back_s += self._last_s - time_s
                time_s = self._last_s
        self._since_jump += 1
        if time_s > self._last_s + SET_BACK_S:
            self._before_jump_s, self._since_jump = self._last_s, 0
        # Lines of several buses may be slightly out of order.
        if time_s > self._last_s:
            self._last_s = time_s
        return time_s
