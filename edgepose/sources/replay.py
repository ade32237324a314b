"""Samples from recordings of any format, raw captures of serial ports, and logs of CAN buses."""

from __future__ import annotations

import gzip
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from math import isnan, nan
from pathlib import Path
from types import TracebackType

from edgepose.errors import EdgeposeError
from edgepose.formats.ledger import Ledger
from edgepose.formats.recordings.base import iter_samples
from edgepose.formats.recordings.raw_capture import capture_metadata, read_capture
from edgepose.formats.recordings.registry import (
    find_format,
    read_recording,
    recording_suffixes,
    salvage_recording,
)
from edgepose.imu import Recording
from edgepose.sources import Batch, Batches, Device, Source, SourceCounters
from edgepose.sources.clock_sync import CaptureClock, DeviceClock, HostClocks
from edgepose.sources.line_decoder import Clock, LineDecoder, PlacementById
from edgepose.sources.log_source import LogSource
from edgepose.sources.pacing import paced_batches
from edgepose.sources.protocol_detection import candidate_protocols, protocol_named
from edgepose.sources.sensor_map import SensorMap, default_places
from firmware_protocols.registry import Protocol

CAPTURES = (".bin", ".raw")
"""Endings of raw captures of a serial port."""

CAN_LOGS = (".asc", ".blf", ".log", ".mf4", ".trc", ".db")
"""Endings of logs that python-can reads, besides .csv."""

_SAVE = "write its samples as .csv or .npz, as docs/guide/recordings.md describes"

FOREIGN = {
    ".mtb": "MT Manager's own format; export it as text, one file a sensor, and give the folder",
    ".mvn": "MVN's own format; export it as .mvnx, with the data of the sensors",
    ".mat": f"a file of MATLAB; {_SAVE}",
    ".h5": f"an HDF5 file; {_SAVE}",
    ".hdf5": f"an HDF5 file; {_SAVE}",
    ".xlsx": f"a workbook; save the sheet as .csv, or {_SAVE}",
    ".sto": f"a file of OpenSim, which holds no accelerations; {_SAVE}",
    ".mot": "joint angles of OpenSim, not data of sensors",
    ".c3d": "positions of markers, not data of sensors",
    ".fbx": "an animation, not data of sensors",
    ".gz": "packed with gzip; unpack it first",
}
"""Descriptions of other programs' files, by ending, with advice."""


class RecordingSource:
    """A recording of any format."""

    def __init__(
        self,
        path: Path,
        realtime: bool,
        lenient: bool = False,
        blocking: bool = True,
        ids: Mapping[int, str] | None = None,
        without: Sequence[str] = (),
    ) -> None:
        """Store the settings; `__enter__` reads the file.

        Args:
            path: the file, or the folder of a session.
            realtime: deliver it at its own pace.
            lenient: accept any sensors; otherwise all six are needed, but for those of `without`.
            blocking: see `open_source`.
            ids: placements by serial number, see `read_recording`.
            without: sensors that the rig lacks.
        """
        self._path = path
        self._read = salvage_recording if lenient else partial(read_recording, salvage=True, without=without)
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
    def metadata(self) -> Mapping[str, str]:
        """Metadata of the recording."""
        return {} if self._recording is None else self._recording.metadata

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
        for now_s, batch, late_s in paced_batches(rows, self._realtime, self._blocking):
            self._packets += len(batch)
            yield Batch(now_s, batch, backlog_s=late_s)


def open_file(
    path: Path,
    realtime: bool,
    protocol: str,
    sensor_map: SensorMap | None,
    lenient: bool = False,
    blocking: bool = True,
    without: Sequence[str] = (),
) -> Source:
    """Return the source for a file; the arguments are those of `edgepose.sources.open_source`.

    Raises:
        EdgeposeError: the kind of file, or the protocol, is unknown.
    """
    if is_recording(path):
        if protocol != "auto":
            protocol_named(protocol)  # raises for an unknown name, although a recording needs no protocol
        ids = None if sensor_map is None else sensor_map.serial_numbers()
        return RecordingSource(path, realtime, lenient, blocking, ids, without)
    clocks = LogClocks()
    named = None if protocol == "auto" else protocol_named(protocol)
    if is_can_log(path) and (named is None or named.transport == "can"):
        from edgepose.sources.can_log import read_log

        protocols = candidate_protocols(protocol, "can", live=False)
        make_decoder = _decoder_factory(path, protocols, sensor_map, clocks.log)
        return LogSource(path, realtime, read_log, make_decoder, clocks, blocking)
    if path.suffix.lower() in CAPTURES or (named is not None and named.transport == "bytes"):
        protocols = candidate_protocols(protocol, "bytes", live=False)
        make_decoder = _decoder_factory(path, protocols, sensor_map, clocks.capture)
        return LogSource(
            path, realtime, _read_capture, make_decoder, clocks, blocking, capture_metadata(path)
        )
    if not path.suffix and not path.exists():
        raise EdgeposeError(f"{path}: no such file or folder")
    if path.suffix.lower() in FOREIGN:
        raise EdgeposeError(f"{path}: {FOREIGN[path.suffix.lower()]}")
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
    if endings[-1:] != [".csv"]:
        return endings[-1:] != [] and endings[-1] in CAN_LOGS
    opened = gzip.open if path.suffix.lower() == ".gz" else open
    try:
        with opened(path, "rb") as file:
            return file.readline(1000).startswith(b"timestamp,arbitration_id,")
    except (OSError, EOFError, zlib.error):  # reported when the file is read
        return False


def _decoder_factory(
    path: Path,
    protocols: Sequence[Protocol],
    sensor_map: SensorMap | None,
    clock: Callable[[int], Clock],
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

        return LineDecoder(full_name, protocols, placements, clock, placement_owner)

    return make


class LogClocks:
    """The clocks of all lines of a log or a capture."""

    def __init__(self) -> None:
        """Start without a line."""
        self._clocks: list[HostClocks | CaptureClock] = []

    @property
    def restarts(self) -> Counter[int]:
        """Number of times that the clock of each placement's device has restarted."""
        return sum((Counter(clocks.restarts) for clocks in self._clocks), Counter())

    def log(self, wrap_us: int) -> Clock:
        """Return the clock of a line in a log with arrival times."""
        host = HostClocks(wrap_us)
        self._clocks.append(host)
        return host.time

    def capture(self, wrap_us: int) -> Clock:
        """Return a clock of a capture: host time where arrivals are known, device time elsewhere."""
        capture, host = CaptureClock(wrap_us), HostClocks(wrap_us)
        self._clocks += [capture, host]
        last_s: dict[int, float] = {}

        def time_of(sensor: int, t_us: int | None, arrival_s: float) -> float:
            if not isnan(arrival_s):
                return host.time(sensor, t_us, arrival_s)
            # Devices may send a part of their measurements in packets without a time.
            if t_us is not None:
                last_s[sensor] = capture.time(sensor, t_us)
            return last_s.get(sensor, nan)

        return time_of


def _read_capture(path: Path, ledger: Ledger) -> Iterator[tuple[str, float, bytes]]:
    for arrival_s, data in read_capture(path):
        yield "", nan if arrival_s is None else arrival_s, data
