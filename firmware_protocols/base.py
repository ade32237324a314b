"""What every wire format provides: a `Protocol`, its decoder and its encoder."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal
from typing import Protocol as Interface

from firmware_protocols.sample import CanFrame, Counters, Sample

Frame = tuple[int, bytes, bool, bool]
"""Identifier, data, whether the identifier has 29 bits, whether it is CAN FD."""

Encode = Callable[[Sample, int], Any]
"""Bytes, or a list of Frames on CAN, of a sample and its sensor's count of samples."""


class DeviceInfo(Interface):
    """What a device reports about itself."""

    @property
    def frame(self) -> str:
        """Inertial frame of its quaternions, such as "ENU", "NED" or "unknown"."""
        ...


class Decoder(ABC):
    """Turns what comes over one line into samples.

    Feeding is incremental: any chunking of the same input gives the same samples. Nothing that comes from a
    wire raises.

    Attributes:
        counters: what has been seen so far.
        infos: the last description of each device, by sensor id; empty where a format has none.
    """

    WRAP_US: int
    """Sample.time_us starts again at 0 after this many microseconds."""

    counters: Counters
    infos: Mapping[int, DeviceInfo] = MappingProxyType({})

    @abstractmethod
    def feed(self, *args: Any, **kwargs: Any) -> list[Sample]:
        """Samples completed by the next input, in the order they came.

        Byte streams: `feed(data: bytes)`. CAN: `feed(can_id: int, data: bytes, extended: bool = False)`.
        """

    def flush(self) -> list[Sample]:
        """Samples still held back at the end of a recording; none by default."""
        return []


@dataclass(frozen=True)
class Protocol:
    """One wire format.

    Attributes:
        name: as a user types it.
        transport: "bytes" of a serial line or frames on a "can" bus.
        speed: usual baud or bit rate as the devices are delivered, bit/s.
        text: what it is, one line.
        decoder: makes a decoder with nothing seen. Two protocols with the same one are told apart by name
            only: the first stands for both when a line's format is detected.
        encoder: makes a function that encodes samples; one for each line, as some count for themselves. Where
            a device has an id on its line, `sample.sensor` is it. None where the format is only read.
        ids: ids of six devices on one line when nothing else is said; empty where nothing is usual.
        alone: a device usually has a line to itself.
        request: what has to be sent to the device with an id for one sample, and the length of its answer,
            where devices speak only when asked.
    """

    name: str
    transport: Literal["bytes", "can"]
    default_bitrate: int
    description: str
    decoder: Callable[[], Decoder]
    encoder: Callable[[], Encode] | None
    ids: Sequence[int] = ()
    single_device: bool = False
    request: Callable[[int], tuple[bytes, int]] | None = None

    @property
    def wrap_us(self) -> int:
        """Where the time of its samples starts again at 0, microseconds."""
        return self.decoder().WRAP_US

    def encode(self, sample: Sample, seq: int) -> Any:
        """`encoder()(sample, seq)`, for formats without a count of their own.

        Raises:
            ValueError: the format is only read.
        """
        if self.encoder is None:
            raise ValueError(f"{self.name} is only read")
        return self.encoder()(sample, seq)


def uncounted(encode: Callable[[Sample], bytes]) -> Callable[[], Encode]:
    """`Protocol.encoder` of a serial format whose samples have no count."""
    return lambda: lambda sample, seq: encode(sample)


def uncounted_can(encode: Callable[[Sample], list[CanFrame]]) -> Callable[[], Encode]:
    """`Protocol.encoder` of a CAN 2.0 format whose samples have no count."""
    return lambda: lambda sample, seq: [(*frame, False) for frame in encode(sample)]
