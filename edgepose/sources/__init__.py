"""Where samples come from. A source is a context manager to iterate over once; it yields batches of samples.

    with open_source(port="/dev/ttyUSB0") as source:
        for batch in source:
            ...

A live source's clock is Unix time, taken once in a process and carried on by the monotonic clock, so that it
never jumps; a batch comes at least every 20 ms, empty if need be, also while a line has disappeared. Files
have their own times.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from edgepose.errors import EdgeposeError
from edgepose.imu import ImuSample
from edgepose.sources.clock_sync import DeviceClock


class Batch(NamedTuple):
    """What came together.

    Attributes:
        now_s: time on the source's clock up to which everything has been delivered, seconds.
        samples: in the order in which they came.
        raw: what came over live lines: Unix time of arrival, s, and bytes or a CAN message; nothing in files.
        backlog_s: how long the batch had waited to be taken, at most, seconds; 0 for files unless they come
            at their own pace.
    """

    now_s: float
    samples: list[ImuSample]
    raw: Sequence[tuple[float, Any]] = ()
    backlog_s: float = 0.0


Batches = Generator[Batch, None, None]
"""Closing it ends the reading, without waiting for what is under way."""

POLL_S = 0.02
"""Longest time between two batches of a live source, seconds."""


class SourceCounters(NamedTuple):
    """What has come in so far, for the summary at the end.

    Attributes:
        packets: good packets or samples.
        lost: packets missing from the devices' counts.
        bad: pieces of the stream that were no valid packet.
        unknown: good packets of ids that belong to no placement.
    """

    packets: int = 0
    lost: int = 0
    bad: int = 0
    unknown: int = 0


class Device(NamedTuple):
    """What the samples of a placement come from.

    Attributes:
        protocol: name of its wire format.
        line: its port or bus; None in a file, which does not always say.
        id: its id on the line.
    """

    protocol: str
    line: str | None
    id: int

    def __str__(self) -> str:
        """As a message has it."""
        return f"{self.protocol} id {self.id}{'' if self.line is None else f' on {self.line}'}"


class Source(AbstractContextManager["Source"], Protocol):
    """See the module's text."""

    @property
    def counters(self) -> SourceCounters:
        """What has come in so far."""

    @property
    def clocks(self) -> Mapping[int, DeviceClock]:
        """Clocks of the sensors on live lines that send a time, by placement."""

    @property
    def devices(self) -> Mapping[int, Device]:
        """What has sent samples so far, by placement; of recordings nobody knows."""

    @property
    def damage(self) -> str | None:
        """One line for the user if something was wrong with the input although the rest of it was
        delivered."""

    def __iter__(self) -> Batches:
        """Batches, in order.

        Raises:
            EdgeposeError: the input ended in an error; all that was good has been yielded before.
        """


def sum_counters(counters: Iterable[SourceCounters]) -> SourceCounters:
    """Counters of several lines together."""
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
) -> Source:
    """The source that the options ask for; nothing is opened before it is entered.

    Args:
        port: serial ports, separated by commas.
        baud: their speed, bit/s; None is the protocol's usual one, or 115200.
        can: CAN bus, INTERFACE:CHANNEL.
        bitrate: its speed, bit/s; None is the protocol's usual one, or 500000.
        fd: take CAN FD frames too.
        file: recording of any format ("-" is CSV on stdin), raw serial capture (.bin, .raw) or log of a CAN
            bus.
        realtime: deliver a file at its own pace.
        protocol: name of a wire format, a TOML file that describes text lines, or "auto".
        sensors: map of devices to placements; ports and buses that it names need no `port` and `can`.
        lenient: take what there is: of a recording the good rows of any sensors, of lines those that speak;
            those that do not are told and waited for.
        blocking: a batch may take as long as the module's text says; if not, it is there at once, empty where
            nothing has come, for those who look after several sources.

    Raises:
        EdgeposeError: no input or two; a protocol, kind of file or entry of the map that means nothing.
    """
    if file is not None and (port is not None or can is not None):
        raise EdgeposeError("give one input: --port or --can, or --file")
    # What the kinds of input need is imported only for them.
    from edgepose.sources.sensor_map import read_map

    sensor_map = None if sensors is None else read_map(Path(sensors))
    if file is not None:
        from edgepose.sources.replay import open_file

        return open_file(Path(file), realtime, protocol, sensor_map, lenient, blocking)
    from edgepose.sources.line_config import line_specs
    from edgepose.sources.live import LiveSource

    return LiveSource(line_specs(port, baud, can, bitrate, fd, protocol, sensor_map), lenient, blocking)
