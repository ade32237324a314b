"""Interfaces of the wire formats: `Protocol`, its decoder and its encoder."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal
from typing import Protocol as Interface

from firmware_protocols.sample import CanFrame, Counters, Sample

Frame = tuple[int, bytes, bool, bool]
"""Identifier, data, whether the identifier has 29 bits, whether it is CAN FD."""

Encode = Callable[[Sample, int], Any]
"""Encodes a sample, given the number of samples its sensor sent before: bytes, or a list of Frames on CAN."""


class Host(Interface):
    """The side that trackers over UDP call for before they send anything.

    Trackers are told apart by any hashable value, such as their socket addresses.
    """

    def receive(self, datagram: bytes, tracker: Hashable, now_s: float) -> tuple[bool, bytes]:
        """Return whether a datagram is for the decoder, and the answer to it, empty if there is none.

        Args:
            datagram: what came.
            tracker: who sent it.
            now_s: time, seconds.
        """
        ...

    def identity(self, datagram: bytes, tracker: Hashable) -> str:
        """Return a tracker's own name, such as its MAC address, as it has sent it; "" if it has not."""
        ...

    def due(self, now_s: float) -> list[tuple[Any, bytes]]:
        """Return the messages that are due at a time, seconds, each with the tracker that it is for."""
        ...


class DeviceInfo(Interface):
    """A device's description of itself."""

    @property
    def frame(self) -> str:
        """Inertial frame of its quaternions, such as "ENU", "NED" or "unknown"."""
        ...


class Decoder(ABC):
    """Decodes the input of one line into samples.

    Feeding is incremental: any chunking of the same input gives the same samples. No input raises an
    exception.

    Attributes:
        counters: counts of everything decoded so far.
        infos: the last description of each device, by sensor id; empty if the format has none.
    """

    WRAP_US: int
    """Sample.time_us restarts at 0 after this many microseconds."""

    counters: Counters
    infos: Mapping[int, DeviceInfo] = MappingProxyType({})

    @abstractmethod
    def feed(self, *args: Any, **kwargs: Any) -> list[Sample]:
        """Return the samples completed by the next input, in order of arrival.

        Byte streams: `feed(data: bytes)`. CAN: `feed(can_id: int, data: bytes, extended: bool = False)`.
        Formats that exist over UDP only: `feed(data: bytes)`, one datagram at a time.
        """

    def feed_datagram(self, data: bytes) -> list[Sample]:
        """Return the samples completed by a datagram; formats whose packets end there override it."""
        return self.feed(data)

    def flush(self) -> list[Sample]:
        """Return the samples still held back at the end of a recording; by default there are none."""
        return []

    @property
    def refused(self) -> str | None:
        """Input of this format that could be understood but not used, and what to do; None by default."""
        return None


@dataclass(frozen=True)
class Protocol:
    """One wire format.

    Attributes:
        name: the name that users type.
        transport: "bytes" on a serial line, over TCP or in datagrams, frames on a "can" bus, or "udp" if the
            format exists in datagrams only, or "hid" on a USB receiver, whose reports a program may also pass
            on as datagrams.
        default_bitrate: usual baud or bit rate of the devices as delivered, bit/s; 0 for "udp" and "hid".
        description: one line that describes the sensors and the format.
        decoder: creates a decoder. Two protocols may share one and then differ by name only: detection
            reports the first of them.
        encoder: creates a function that encodes samples; create one per line, because some keep counters. If
            devices have ids on their line, the id is `sample.sensor`. None if the format can only be decoded.
        ids: default ids of six devices on one line; empty if there are no usual ones.
        single_device: whether a device usually has a line to itself.
        common_heading: whether the orientations of several devices have one heading; without it, each starts
            with a heading of its own.
        request: for devices that send only on request: returns the request for one sample of the device with
            an id, and the length of the answer in bytes.
        host: for trackers over UDP that send only to a host that answers them: creates it.
        lacks: what its samples never have: "time", "quat", "acc".
        setup: what a device must be set to, as text for users; empty if it is right as delivered.
        page: its page in `docs/`, without ".md"; by default its name.
    """

    name: str
    transport: Literal["bytes", "can", "udp", "hid"]
    default_bitrate: int
    description: str
    decoder: Callable[[], Decoder]
    encoder: Callable[[], Encode] | None
    ids: Sequence[int] = ()
    single_device: bool = False
    common_heading: bool = True
    request: Callable[[int], tuple[bytes, int]] | None = None
    host: Callable[[], Host] | None = None
    lacks: Sequence[Literal["time", "quat", "acc"]] = ()
    setup: str = ""
    page: str = ""

    @property
    def in_datagrams(self) -> bool:
        """Whether packets come whole, in datagrams or in transfers of a USB receiver."""
        return self.transport in ("udp", "hid")

    @property
    def wrap_us(self) -> int:
        """Sample times restart at 0 after this many microseconds."""
        return self.decoder().WRAP_US

    def encode(self, sample: Sample, seq: int) -> Any:
        """Return `encoder()(sample, seq)`, for formats whose encoders keep no counter.

        Raises:
            ValueError: the format has no encoder.
        """
        if self.encoder is None:
            raise ValueError(f"{self.name} can only be decoded: it has no encoder")
        return self.encoder()(sample, seq)


def uncounted(encode: Callable[[Sample], bytes]) -> Callable[[], Encode]:
    """Return the `Protocol.encoder` of a format in bytes without a sample counter."""
    return lambda: lambda sample, seq: encode(sample)


def uncounted_can(encode: Callable[[Sample], list[CanFrame]]) -> Callable[[], Encode]:
    """Return the `Protocol.encoder` of a CAN 2.0 format without a sample counter."""
    return lambda: lambda sample, seq: [(*frame, False) for frame in encode(sample)]
