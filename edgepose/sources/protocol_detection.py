"""Protocol detection: all decoders listen to a line, and the one that decodes it best is chosen."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

from edgepose.errors import ConfigError
from edgepose.utils.similar_names import choices
from firmware_protocols.registry import PROTOCOLS, Decoder, Protocol
from firmware_protocols.sample import Sample

Chunk = bytes | list[Any]
"""Bytes of a stream, messages (`can.Message`) of a bus, or datagrams (`Datagram`)."""

Transport = Literal["bytes", "can", "udp", "hid"]
"""Kind of a line: a stream of bytes, a CAN bus, a UDP socket, or a USB receiver."""


class Datagram(NamedTuple):
    """A UDP datagram, and the IP address of its sender, or the name that it gives itself.

    Also a transfer of a USB receiver, and the receiver's name.
    """

    sender: str
    data: bytes


DecodedChunks = list[tuple[float, list[Sample]]]
"""Arrival time, seconds, and samples of each chunk that completed any."""

SURE_PACKETS = 10
"""Good packets of one format that settle the matter at once, if no other format has any."""

LEAST_PACKETS = 3
"""Fewest good packets that count as evidence."""


def decode(decoder: Decoder, chunk: Chunk) -> list[Sample]:
    """Return the samples completed by a chunk."""
    if isinstance(chunk, bytes):
        return decoder.feed(chunk)
    samples: list[Sample] = []
    for message in chunk:
        if isinstance(message, Datagram):
            samples += decoder.feed_datagram(message.data)
        else:
            samples += decoder.feed(message.arbitration_id, bytes(message.data), message.is_extended_id)
    return samples


def refused_by(protocol: Protocol, decoder: Decoder) -> str | None:
    """Return a decoder's `refused`, with the name of its protocol."""
    return None if decoder.refused is None else f"{protocol.name}: {decoder.refused}"


def protocol_named(name: str) -> Protocol:
    """Return the protocol of that name, or the text protocol that a TOML file of that name describes.

    Raises:
        ConfigError: no such protocol, or the file is not valid.
    """
    if name.endswith(".toml"):
        return _text_lines(Path(name))
    if name not in PROTOCOLS:
        raise _unknown(name)
    return PROTOCOLS[name]


def checked_protocol(name: str) -> str:
    """Return a name if it is "auto", that of a protocol, or that of a TOML file, which is read later.

    Raises:
        ConfigError: there is no such protocol.
    """
    if name == "auto" or name.endswith(".toml") or name in PROTOCOLS:
        return name
    raise _unknown(name)


def _unknown(name: str) -> ConfigError:
    return ConfigError(f"unknown protocol {name!r}; {choices(name, ['auto', *PROTOCOLS])}")


def candidate_protocols(name: str, transport: Transport, live: bool) -> list[Protocol]:
    """Return the protocols that a line may use.

    Args:
        name: name of a protocol, or "auto".
        transport: kind of line. Datagrams may hold the packets of any protocol but those of CAN.
        live: the line has devices on it; listening cannot find those that have to be polled.

    Raises:
        ConfigError: no such protocol, it is for another transport, or a package for it is missing.
    """
    possible = ("bytes", "udp", "hid") if transport == "udp" else (transport,)
    if name != "auto":
        protocol = protocol_named(name)
        if protocol.transport not in possible:
            raise ConfigError(f"protocol {name} is for {_LINES[protocol.transport]}")
        return [protocol]
    # Two names can stand for one decoder.
    first = {
        protocol.decoder: protocol
        for protocol in reversed(list(PROTOCOLS.values()))
        if protocol.transport in possible and not (live and protocol.request)
    }
    return list(reversed(first.values()))


_LINES = {
    "bytes": "serial lines; use it with --port, --listen or --connect, or a log of one",
    "can": "CAN buses; use it with --can or a log of one",
    "udp": "datagrams; use it with --listen",
    "hid": "USB receivers; use it with --hid, or --listen if a program passes their reports on",
}
"""The lines of a protocol, for a message."""


class Detector:
    """The decoders of several protocols, all fed with one line's data.

    Attributes:
        decoders: one for each protocol whose packages are installed.
    """

    def __init__(self, name: str, protocols: Sequence[Protocol]) -> None:
        """Create the decoders.

        Args:
            name: name of the line, for messages.
            protocols: the candidates.

        Raises:
            ConfigError: a package for the only candidate is missing.
        """
        self._name = name
        self._protocols: list[Protocol] = []
        self.decoders: list[Decoder] = []
        self._decoded: list[DecodedChunks] = []
        for protocol in protocols:
            try:
                decoder = protocol.decoder()
            except RuntimeError as error:  # an optional package is missing
                if len(protocols) == 1:
                    raise ConfigError(str(error)) from None
                continue
            self._protocols.append(protocol)
            self.decoders.append(decoder)
            self._decoded.append([])

    def feed(self, chunk: Chunk, arrival_s: float) -> None:
        """Pass a chunk that came at a time, seconds, to all decoders."""
        for decoder, decoded in zip(self.decoders, self._decoded, strict=True):
            samples = decode(decoder, chunk)
            if samples:
                decoded.append((arrival_s, samples))

    def best(self, now: bool) -> tuple[Protocol, Decoder, DecodedChunks] | None:
        """Return the line's protocol, its decoder, and the samples decoded so far; None if not yet clear.

        Args:
            now: decide on weak evidence too.

        Raises:
            ConfigError: two protocols fit equally well.
        """
        active = [i for i, chunks in enumerate(self._decoded) if chunks]
        most = max((self.decoders[i].counters.packets for i in active), default=0)
        # A text decoder can find some of its columns in another text format, in as many lines.
        close = [i for i in active if 2 * self.decoders[i].counters.packets >= most]
        close.sort(key=self._quantities, reverse=True)
        if not close:
            return None
        best = close[0]
        packets, bad = self.decoders[best].counters.packets, self.decoders[best].counters.bad
        # One bad packet is expected: listening may start in the middle of one.
        sure = len(active) == 1 and packets >= SURE_PACKETS and bad <= 1
        if not sure and not (now and packets >= LEAST_PACKETS and 2 * packets >= bad):
            return None
        for other in close[1:]:
            if self._quantities(other) == self._quantities(best):
                raise ConfigError(
                    f"{self._name}: it could be {self._protocols[best].name} ({packets} good packets) or "
                    f"{self._protocols[other].name} ({self.decoders[other].counters.packets}); "
                    "choose one with --protocol"
                )
        return self._protocols[best], self.decoders[best], self._decoded[best]

    @property
    def refused(self) -> str | None:
        """Input that a candidate could understand but not use, see `Decoder.refused`; None if none."""
        reasons = [
            refused_by(protocol, decoder)
            for protocol, decoder in zip(self._protocols, self.decoders, strict=True)
        ]
        return next(filter(None, reasons), None)

    def _quantities(self, i: int) -> int:
        """Return the number of quantities in a decoder's last good packet."""
        return sum(value is not None for value in self._decoded[i][-1][1][-1][2:])


def _text_lines(path: Path) -> Protocol:
    from edgepose.utils.text_files import read_toml
    from firmware_protocols.text import TextDecoder
    from firmware_protocols.text_pattern import pattern_from_table

    try:
        pattern = pattern_from_table(read_toml(path))
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from None

    return Protocol(
        name=path.name,
        transport="bytes",
        default_bitrate=115200,
        description="text lines as a file says",
        decoder=partial(TextDecoder, pattern),
        encoder=None,
        ids=range(6),
        single_device="sensor" not in (pattern.regex or "") and "sensor" not in pattern.columns,
    )
