"""Sources of samples: context managers that can be iterated over once and yield batches of samples.

    with open_source(port="/dev/ttyUSB0") as source:
        for batch in source:
            ...

A live source's clock is Unix time, read once per process and continued by the monotonic clock, so that it
never jumps. A live source yields a batch at least every 20 ms, an empty one if nothing came, even while a
line is disconnected. Files keep their own times.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from edgepose.errors import EdgeposeError
from edgepose.imu import ImuSample
from edgepose.sources.clock_sync import DeviceClock


class Batch(NamedTuple):
    """Samples that came together.

    Attributes:
        now_s: time on the source's clock up to which everything has been delivered, seconds.
        samples: the samples, in order of arrival.
        raw: the undecoded data of live lines: Unix time of arrival, s, and bytes, a CAN message or a
            datagram; empty for files.
        backlog_s: longest time that the batch may have waited before it was read, seconds; 0 for files unless
            they are replayed at their own pace.
        ahead_s: time by which the newest samples came after `now_s`, seconds: another line may hold older
            ones that have not been read.
    """

    now_s: float
    samples: list[ImuSample]
    raw: Sequence[tuple[float, Any]] = ()
    backlog_s: float = 0.0
    ahead_s: float = 0.0


Batches = Generator[Batch, None, None]
"""Closing the generator ends the reading, without waiting for a read in progress."""

POLL_S = 0.02
"""Longest time between two batches of a live source, seconds."""

LINES = ("port", "can", "listen", "connect", "ble", "hid")
"""Kinds of live lines: the names of their flags, and of their keys in sensor maps."""

LINE_FLAGS = "--port, --can, --listen, --connect, --ble or --hid"
"""The flags, for messages."""


class SourceCounters(NamedTuple):
    """Counts of the packets received so far.

    Attributes:
        packets: good packets or samples.
        lost: packets missing, by the devices' counters.
        bad: pieces of the stream that were not a valid packet.
        unknown: good packets with ids that belong to no placement.
    """

    packets: int = 0
    lost: int = 0
    bad: int = 0
    unknown: int = 0


class Device(NamedTuple):
    """The device that sends a placement's samples.

    Attributes:
        protocol: name of its wire format.
        line: its port, bus or address; None for a file, which does not always name it.
        id: its id on the line.
    """

    protocol: str
    line: str | None
    id: int

    def __str__(self) -> str:
        """Description for a message."""
        return f"{self.protocol} id {self.id}{'' if self.line is None else f' on {self.line}'}"


class Source(AbstractContextManager["Source"], Protocol):
    """The interface of sources; see the module's docstring."""

    @property
    def counters(self) -> SourceCounters:
        """Counts of the packets received so far."""

    @property
    def clocks(self) -> Mapping[int, DeviceClock]:
        """Clocks of the sensors on live lines that send a time, by placement."""

    @property
    def devices(self) -> Mapping[int, Device]:
        """Devices that have sent samples so far, by placement; empty for recordings."""

    @property
    def metadata(self) -> Mapping[str, str]:
        """Facts about the input that its file states, such as when it was started; empty if it is live."""

    @property
    def damage(self) -> str | None:
        """One line for the user if part of the input was bad although the rest of it was delivered."""

    def __iter__(self) -> Batches:
        """Yield batches, in order.

        Raises:
            EdgeposeError: the input ended in an error; all good samples before it have been yielded.
        """


def sum_counters(counters: Iterable[SourceCounters]) -> SourceCounters:
    """Add up the counters of several lines."""
    return SourceCounters(*(sum(column) for column in zip(SourceCounters(), *counters, strict=True)))


def open_source(
    *,
    port: str | None = None,
    baud: int | None = None,
    can: str | None = None,
    bitrate: int | None = None,
    fd: bool = False,
    file: Path | str | None = None,
    realtime: bool = False,
    protocol: str = "auto",
    sensors: Path | str | None = None,
    lenient: bool = False,
    blocking: bool = True,
    listen: str | None = None,
    connect: str | None = None,
    ble: str | None = None,
    hid: str | None = None,
    wanted: Callable[[], float] | None = None,
    without: Sequence[str] = (),
) -> Source:
    """Return the source that the options describe; nothing is opened before it is entered.

    Args:
        port: serial ports, separated by commas.
        baud: speed of the ports, bit/s; None means the protocol's usual speed, or 115200.
        can: CAN bus, INTERFACE:CHANNEL.
        bitrate: speed of the bus, bit/s; None means the protocol's usual speed, or 500000.
        fd: receive CAN FD frames too.
        file: recording ("-" is CSV on stdin), raw serial capture (.bin, .raw) or log of a CAN bus.
        realtime: replay a file at its own pace.
        protocol: name of a wire format, a TOML file that describes text lines, or "auto".
        sensors: map of devices to placements; lines in it need no flag.
        lenient: accept a recording's good rows, of any sensors; warn about lines that send nothing, and wait.
        blocking: wait for a batch as the module's docstring says; if false, one comes at once, maybe empty.
        listen: addresses of this machine to receive datagrams on, HOST:PORT, separated by commas.
        connect: devices to connect to over TCP, HOST:PORT, separated by commas.
        ble: Bluetooth addresses of Movella DOT sensors, separated by commas.
        hid: USB receivers by serial number or path, separated by commas, or "slimevr" for the only one.
        wanted: returns the time on the source's clock, seconds, until which samples of live lines may be
            gathered into one batch; by default they are delivered as they come.
        without: sensors that the rig lacks and that recordings need not hold.

    Raises:
        EdgeposeError: no input or more than one; an unknown protocol or kind of file; an invalid map.
    """
    if file is not None and any(name is not None for name in (port, can, listen, connect, ble, hid)):
        raise EdgeposeError(f"give one input: {LINE_FLAGS}, or --file")
    # Imported only here: each kind of input has dependencies of its own.
    from edgepose.sources.sensor_map import read_map

    sensor_map = None if sensors is None else read_map(Path(sensors))
    if file is not None:
        from edgepose.sources.replay import open_file

        return open_file(Path(file), realtime, protocol, sensor_map, lenient, blocking, without)
    from edgepose.sources.line_config import line_specs
    from edgepose.sources.live import LiveSource

    lines = line_specs(port, baud, can, bitrate, fd, protocol, sensor_map, listen, connect, ble, hid)
    return LiveSource(lines, lenient, blocking, wanted)
