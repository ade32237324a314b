"""Samples from recordings of any format, raw captures of a serial port, and logs of CAN buses."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from math import inf, isnan, nan
from pathlib import Path
from types import TracebackType

from edgepose.errors import EdgeposeError
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

Chunks = Callable[[Path], Iterator[tuple[str, float, Chunk | None]]]

_SLICE_S = 0.01


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
        """Nothing is read yet.

        Args:
            path: the file, or the folder of a session.
            realtime: deliver it at its own pace.
            lenient: take the good rows of any sensors; without, all six and no bad row.
            blocking: see `open_source`.
            ids: placements by serial number, see `read_recording`.
        """
        self._path = path
        self._read = salvage_recording if lenient else read_recording
        self._realtime, self._blocking, self._ids = realtime, blocking, ids
        self._recording: Recording | None = None
        self._packets = 0

    @property
    def counters(self) -> SourceCounters:
        """What has come in so far."""
        return SourceCounters(self._packets)

    @property
    def clocks(self) -> Mapping[int, DeviceClock]:
        """Always none: a recording has one clock."""
        return {}

    @property
    def devices(self) -> Mapping[int, Device]:
        """Always none: a recording holds placements."""
        return {}

    @property
    def damage(self) -> str | None:
        """What is wrong with the file; the rest of it is delivered."""
        return self._recording.damage if self._recording else None

    def __enter__(self) -> RecordingSource:
        """Read the file.

        Raises:
            EdgeposeError: it is no recording.
        """
        self._recording = self._read(self._path, self._ids)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Nothing is open."""

    def __iter__(self) -> Batches:
        """All samples in time order, a hundredth of a second at a time."""
        assert self._recording is not None, "the source has not been entered"
        rows = iter_samples(self._recording)
        for now_s, batch, late_s in _batches(rows, self._realtime, self._blocking):
            self._packets += len(batch)
            yield Batch(now_s, batch, backlog_s=late_s)


class LogSource:
    """What came over a serial port or CAN buses, in a file."""

    def __init__(
        self,
        path: Path,
        realtime: bool,
        chunks: Chunks,
        stream: Callable[[str], LineDecoder],
        blocking: bool = True,
    ) -> None:
        """Nothing is opened yet.

        Args:
            path: the file.
            realtime: deliver it at its own pace.
            chunks: reads the file: name of a line, time in seconds, and what came over it, None if it is bad.
            stream: makes the stream of a line.
            blocking: see `open_source`.
        """
        self._path = path
        self._realtime, self._blocking = realtime, blocking
        self._chunks = chunks
        self._stream = stream
        self._streams: dict[str, LineDecoder] = {}
        self._bad = 0

    @property
    def counters(self) -> SourceCounters:
        """What has come in so far."""
        return sum_counters(
            [SourceCounters(bad=self._bad), *(stream.counters for stream in self._streams.values())]
        )

    @property
    def clocks(self) -> Mapping[int, DeviceClock]:
        """Always none: most logs do not say when what came."""
        return {}

    @property
    def devices(self) -> Mapping[int, Device]:
        """What has sent samples so far, by placement."""
        return {
            place: device._replace(line=None)
            for stream in self._streams.values()
            for place, device in stream.devices.items()
        }

    @property
    def damage(self) -> str | None:
        """Frames of a log that cannot be; a log may start and end anywhere."""
        if not self._bad:
            return None
        return f"{self._path}: {self._bad} of its frames have no possible time or id; they are left out"

    def __enter__(self) -> LogSource:
        """Check that the file can be read.

        Raises:
            EdgeposeError: it cannot.
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
        """All samples in the order of the file.

        Raises:
            EdgeposeError: the file cannot be read to its end, or there is no packet in it.
        """
        for now_s, batch, late_s in _batches(self._samples(), self._realtime, self._blocking):
            yield Batch(now_s, batch, backlog_s=late_s)
        if not self.counters.packets:
            raise EdgeposeError(f"{self._path}: {self._problem()}")

    def _samples(self) -> Iterator[ImuSample]:
        for name, time_s, chunk in self._chunks(self._path):
            if chunk is None:
                self._bad += 1
                continue
            stream = self._streams.get(name)
            if stream is None:
                stream = self._streams[name] = self._stream(name)
            yield from stream.feed(chunk, time_s)
        for stream in self._streams.values():
            yield from stream.finish()

    def _problem(self) -> str:
        streams = self._streams.values()
        unknown = sorted({sensor for stream in streams for sensor in stream.unknown_ids})
        if unknown:
            expected = next(stream.ids for stream in streams if stream.unknown_ids)
            return (
                f"packets only of sensor ids {', '.join(map(str, unknown))}, and known are {expected}; "
                "say with --sensors which is where"
            )
        protocols = {stream.protocol.name for stream in streams if stream.protocol is not None}
        what = " or ".join(sorted(protocols)) or "known"
        amount = sum(stream.amount for stream in streams)
        return (
            f"not one {what} packet in {amount} bytes or frames; is it a raw capture? if so, check --protocol"
        )


def open_file(
    path: Path,
    realtime: bool,
    protocol: str,
    sensor_map: SensorMap | None,
    lenient: bool = False,
    blocking: bool = True,
) -> Source:
    """The source that a file is; the arguments are those of `edgepose.sources.open_source`.

    Raises:
        EdgeposeError: its kind, or the protocol, is not known.
    """
    if is_recording(path):
        if protocol != "auto":
            protocol_named(protocol)  # a wrong name is told although it would not be needed
        ids = None if sensor_map is None else sensor_map.serial_numbers()
        return RecordingSource(path, realtime, lenient, blocking, ids)
    named = None if protocol == "auto" else protocol_named(protocol)
    if is_can_log(path) and (named is None or named.transport == "can"):
        from edgepose.sources.can_bus import read_log

        protocols = candidate_protocols(protocol, "can", live=False)
        return LogSource(
            path, realtime, read_log, _streams(path, protocols, sensor_map, _log_clock), blocking
        )
    if path.suffix.lower() in CAPTURES or (named is not None and named.transport == "bytes"):
        protocols = candidate_protocols(protocol, "bytes", live=False)
        streams = _streams(path, protocols, sensor_map, _capture_clock)
        return LogSource(path, realtime, _read_capture, streams, blocking)
    if not path.suffix and not path.exists():
        raise EdgeposeError(f"{path}: no such file or folder")
    raise EdgeposeError(
        f"{path}: unknown kind of file; recordings end in {', '.join(recording_suffixes())}, logs of CAN "
        f"buses in {', '.join(CAN_LOGS)}, raw serial captures in {' or '.join(CAPTURES)} (with --protocol in "
        "anything else)"
    )


def is_recording(path: Path) -> bool:
    """Whether a file is a recording, by its ending; a .csv may be a log of a CAN bus, by its first line.

    A folder is taken for one: where none is in it, reading tells.
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
    except OSError:  # told where it is read
        return False


def _streams(
    path: Path,
    protocols: Sequence[Protocol],
    sensor_map: SensorMap | None,
    clock: Callable[[str], Callable[[int], Clock]],
) -> Callable[[str], LineDecoder]:
    """Makes the streams of a file's lines."""
    claimed: dict[int, str] = {}

    def make(name: str) -> LineDecoder:
        whole = f"{path}: channel {name}" if name else str(path)

        def places(protocol: Protocol) -> PlacementById:
            if sensor_map is None:
                return default_places(whole, protocol, 0, 1)
            # A capture does not say of which port it is.
            return sensor_map.places(name) if name else sensor_map.all_places()

        return LineDecoder(whole, protocols, places, clock(whole), claimed)

    return make


def _log_clock(name: str) -> Callable[[int], Clock]:
    return lambda wrap_us: HostClocks(wrap_us).time


def _capture_clock(name: str) -> Callable[[int], Clock]:
    """Where nobody noted when the bytes came, device time is the clock."""

    def make(wrap_us: int) -> Clock:
        capture, host = CaptureClock(wrap_us), HostClocks(wrap_us)

        def time_of(sensor: int, t_us: int | None, arrival_s: float) -> float:
            if not isnan(arrival_s):
                return host.time(sensor, t_us, arrival_s)
            if t_us is None:
                raise EdgeposeError(
                    f"{name}: its packets carry no time, and nobody noted when they came; "
                    "make captures with edgepose record, or switch the device's time on"
                )
            return capture.time(sensor, t_us)

        return time_of

    return make


def _read_capture(path: Path) -> Iterator[tuple[str, float, bytes]]:
    for arrival_s, data in read_capture(path):
        yield "", nan if arrival_s is None else arrival_s, data


def _batches(
    rows: Iterator[ImuSample], realtime: bool, blocking: bool
) -> Iterator[tuple[float, list[ImuSample], float]]:
    """Samples in slices of time, and how late each is; `now_s` is that of the newest sample, or goes on with
    the clock where realtime is asked for; until a slice is due there are empty ones unless this blocks."""
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
            # Nothing is said about a pause unless its time really passes.
            end_s = end_s + _SLICE_S if realtime else sample.time_s + _SLICE_S
        batch.append(sample)
        now_s = max(now_s, sample.time_s)
    if batch:
        yield now_s, batch, late_s()
