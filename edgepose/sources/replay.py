"""Samples from recordings of any format, raw captures of serial ports, and logs of CAN buses."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from math import inf, isnan, nan
from pathlib import Path
from types import TracebackType

from edgepose.errors import EdgeposeError
from edgepose.formats.ledger import Ledger
from edgepose.formats.recordings.base import iter_samples
from edgepose.formats.recordings.raw_capture import read_capture
from edgepose.formats.recordings.registry import (
    find_format,
    read_recording,
    recording_suffixes,
    salvage_recording,
)
from edgepose.imu import ImuSample, Recording
from edgepose.sources import Batch, Batches, Device, Source, SourceCounters, sum_counters
from edgepose.sources.clock_sync import CaptureClock, DeviceClock, HostClocks
from edgepose.sources.line_decoder import Clock, LineDecoder, PlacementById
from edgepose.sources.protocol_detection import Chunk, candidate_protocols, protocol_named
from edgepose.sources.sensor_map import SensorMap, default_places
from firmware_protocols.registry import Protocol

CAPTURES = (".bin", ".raw")
"""Endings of raw captures of a serial port."""

CAN_LOGS = (".asc", ".blf", ".log", ".mf4", ".trc", ".db")
"""Endings of logs that python-can reads, besides .csv."""

ChunkReader = Callable[[Path, Ledger], Iterator[tuple[str, float, Chunk | None]]]
"""Yields the chunks of a file: name of the line, time in seconds, and data; None for data that is bad."""

_SLICE_S = 0.01  # length of a batch

SET_BACK_S = 0.5
"""A log's times that go back by more are those of a clock that was set back, seconds."""

_FEW = 5  # frames whose times are wrong, rather than the clock


class RecordingSource:
    """A recording of any format."""

    def __init__(
        self,
        path: Path,
        realtime: bool,
        lenient: bool = False,
        blocking: bool = True,
        ids: Mapping[int, str] | None = None,
    ) -> None:
        """Store the settings; `__enter__` reads the file.

        Args:
            path: the file, or the folder of a session.
            realtime: deliver it at its own pace.
            lenient: accept any sensors; otherwise all six are needed.
            blocking: see `open_source`.
            ids: placements by serial number, see `read_recording`.
        """
        self._path = path
        self._read = salvage_recording if lenient else partial(read_recording, salvage=True)
        self._realtime, self._blocking, self._ids = realtime, blocking, ids
        self._recording: Recording | None = None
        self._packets = 0

    @property
    def counters(self) -> SourceCounters:
        """Counts of the samples delivered so far."""
        return SourceCounters(self._packets)

    @property
    def clocks(self) -> Mapping[int, DeviceClock]:
        """Always empty: a recording has one clock."""
        return {}

    @property
    def devices(self) -> Mapping[int, Device]:
        """Always empty: a recording names placements, not devices."""
        return {}

    @property
    def damage(self) -> str | None:
        """Description of the bad part of the file; the rest of it is delivered."""
        return self._recording.damage if self._recording else None

    def __enter__(self) -> RecordingSource:
        """Read the file.

        Raises:
            EdgeposeError: it is not a recording.
        """
        self._recording = self._read(self._path, self._ids)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Nothing is open."""

    def __iter__(self) -> Batches:
        """Yield all samples in time order, a hundredth of a second at a time."""
        assert self._recording is not None, "the source has not been entered"
        rows = iter_samples(self._recording)
        for now_s, batch, late_s in _batches(rows, self._realtime, self._blocking):
            self._packets += len(batch)
            yield Batch(now_s, batch, backlog_s=late_s)


class LogSource:
    """A file with the undecoded data of a serial port or of CAN buses."""

    def __init__(
        self,
        path: Path,
        realtime: bool,
        read_chunks: ChunkReader,
        make_decoder: Callable[[str], LineDecoder],
        blocking: bool = True,
    ) -> None:
        """Store the settings; iteration opens the file.

        Args:
            path: the file.
            realtime: deliver it at its own pace.
            read_chunks: reads the file.
            make_decoder: makes the decoder of a line, given its name.
            blocking: see `open_source`.
        """
        self._path = path
        self._realtime, self._blocking = realtime, blocking
        self._read_chunks = read_chunks
        self._make_decoder = make_decoder
        self._decoders: dict[str, LineDecoder] = {}
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
        """Always empty: most logs have no arrival times to compare device clocks with."""
        return {}

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
        if self._bad:
            problems.append(f"{self._path}: ignored {self._bad} frames with an impossible time or id")
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
        for now_s, batch, late_s in _batches(self._samples(), self._realtime, self._blocking):
            yield Batch(now_s, batch, backlog_s=late_s)
        if not self.counters.packets:
            raise EdgeposeError(f"{self._path}: {self._problem()}")

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
            yield from decoder.feed(chunk, time_s)
        for decoder in self._decoders.values():
            yield from decoder.finish()

    def _problem(self) -> str:
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


def open_file(
    path: Path,
    realtime: bool,
    protocol: str,
    sensor_map: SensorMap | None,
    lenient: bool = False,
    blocking: bool = True,
) -> Source:
    """Return the source for a file; the arguments are those of `edgepose.sources.open_source`.

    Raises:
        EdgeposeError: the kind of file, or the protocol, is unknown.
    """
    if is_recording(path):
        if protocol != "auto":
            protocol_named(protocol)  # raises for an unknown name, although a recording needs no protocol
        ids = None if sensor_map is None else sensor_map.serial_numbers()
        return RecordingSource(path, realtime, lenient, blocking, ids)
    named = None if protocol == "auto" else protocol_named(protocol)
    if is_can_log(path) and (named is None or named.transport == "can"):
        from edgepose.sources.can_log import read_log

        protocols = candidate_protocols(protocol, "can", live=False)
        make_decoder = _decoder_factory(path, protocols, sensor_map, _log_clock)
        return LogSource(path, realtime, read_log, make_decoder, blocking)
    if path.suffix.lower() in CAPTURES or (named is not None and named.transport == "bytes"):
        protocols = candidate_protocols(protocol, "bytes", live=False)
        make_decoder = _decoder_factory(path, protocols, sensor_map, _capture_clock)
        return LogSource(path, realtime, _read_capture, make_decoder, blocking)
    if not path.suffix and not path.exists():
        raise EdgeposeError(f"{path}: no such file or folder")
    raise EdgeposeError(
        f"{path}: unknown kind of file; recordings end in {', '.join(recording_suffixes())}, logs of CAN "
        f"buses in {', '.join(CAN_LOGS)}, raw serial captures in {' or '.join(CAPTURES)} (or anything else, "
        "with --protocol)"
    )


def is_recording(path: Path) -> bool:
    """Whether a file is a recording, by its ending; a .csv may be a log of a CAN bus, by its first line.

    A folder counts as a recording; reading it fails if it holds none.
    """
    if str(path) == "-" or path.is_dir():
        return True
    return path.suffix.lower() not in CAPTURES and not is_can_log(path) and find_format(path) is not None


def is_can_log(path: Path) -> bool:
    """Whether a file is a log of a CAN bus, by its ending; a .csv by its first line."""
    endings = [ending.lower() for ending in path.suffixes if ending.lower() != ".gz"]
    if endings[-1:] != [".csv"] or path.suffix.lower() == ".gz":
        return endings[-1:] != [] and endings[-1] in (*CAN_LOGS, ".csv")
    try:
        with path.open("rb") as file:
            return file.readline(1000).startswith(b"timestamp,arbitration_id,")
    except OSError:  # reported when the file is read
        return False


def _decoder_factory(
    path: Path,
    protocols: Sequence[Protocol],
    sensor_map: SensorMap | None,
    clock: Callable[[str], Callable[[int], Clock]],
) -> Callable[[str], LineDecoder]:
    """Return a function that makes the decoder of one of a file's lines, given the line's name."""
    placement_owner: dict[int, str] = {}

    def make(name: str) -> LineDecoder:
        full_name = f"{path}: channel {name}" if name else str(path)

        def placements(protocol: Protocol) -> PlacementById:
            if sensor_map is None:
                return default_places(full_name, protocol, 0, 1)
            # A capture does not name its port.
            return sensor_map.places(name) if name else sensor_map.all_places()

        return LineDecoder(full_name, protocols, placements, clock(full_name), placement_owner)

    return make


def _log_clock(name: str) -> Callable[[int], Clock]:
    return lambda wrap_us: HostClocks(wrap_us).time


def _capture_clock(name: str) -> Callable[[int], Clock]:
    """Return a factory of clocks: host time where arrivals are known, device time elsewhere."""

    def make(wrap_us: int) -> Clock:
        capture, host = CaptureClock(wrap_us), HostClocks(wrap_us)

        def time_of(sensor: int, t_us: int | None, arrival_s: float) -> float:
            if not isnan(arrival_s):
                return host.time(sensor, t_us, arrival_s)
            if t_us is None:
                raise EdgeposeError(
                    f"{name}: neither its packets nor the capture hold times; "
                    "make captures with edgepose record, or switch on the device's time"
                )
            return capture.time(sensor, t_us)

        return time_of

    return make


def _read_capture(path: Path, ledger: Ledger) -> Iterator[tuple[str, float, bytes]]:
    for arrival_s, data in read_capture(path):
        yield "", nan if arrival_s is None else arrival_s, data


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


def _batches(
    rows: Iterator[ImuSample], realtime: bool, blocking: bool
) -> Iterator[tuple[float, list[ImuSample], float]]:
    """Yield samples in slices of time: the time up to which all are delivered, the samples, the delay.

    In real time, that time runs on with the clock; otherwise it is that of the newest sample. Until a slice
    is due, empty ones are yielded unless `blocking`.
    """
    now_s = end_s = -inf
    batch: list[ImuSample] = []
    offset_s = 0.0

    def late_s() -> float:
        return max(0.0, time.monotonic() + offset_s - end_s) if realtime else 0.0

    for sample in rows:
        if end_s == -inf:
            now_s, end_s = sample.time_s, sample.time_s + _SLICE_S
            offset_s = sample.time_s - time.monotonic()
        while sample.time_s >= end_s:
            if realtime:
                while not blocking and end_s - offset_s > time.monotonic():
                    yield now_s, [], 0.0
                time.sleep(max(0.0, end_s - offset_s - time.monotonic()))
                now_s = end_s
            yield now_s, batch, late_s()
            batch = []
            # Outside real time, a pause in the samples is skipped.
            end_s = end_s + _SLICE_S if realtime else sample.time_s + _SLICE_S
        batch.append(sample)
        now_s = max(now_s, sample.time_s)
    if batch:
        yield now_s, batch, late_s()
