"""Finds out what a line speaks: every decoder listens, the one that understands it is chosen."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

from edgepose.errors import ConfigError
from firmware_protocols.registry import PROTOCOLS, Decoder, Protocol
from firmware_protocols.sample import Sample

Chunk = bytes | list[Any]
"""Bytes of a serial line, or messages (`can.Message`) of a bus."""

Heard = list[tuple[float, list[Sample]]]
"""Arrival, seconds, and samples."""

SURE_PACKETS = 10
"""So many good packets of one format, and none of any other, need no further listening."""

LEAST_PACKETS = 3
"""Fewer good packets prove nothing."""


def decode(decoder: Decoder, chunk: Chunk) -> list[Sample]:
    """Samples that a chunk completes."""
    if isinstance(chunk, bytes):
        return decoder.feed(chunk)
    samples: list[Sample] = []
    for message in chunk:
        samples += decoder.feed(message.arbitration_id, bytes(message.data), message.is_extended_id)
    return samples


def protocol_named(name: str) -> Protocol:
    """A protocol of the table, or the text lines that a TOML file describes.

    Raises:
        ConfigError: there is none, or it does not fit.
    """
    if name.endswith(".toml"):
        return _text_lines(Path(name))
    if name not in PROTOCOLS:
        raise ConfigError(f"unknown protocol {name!r}; known are auto, {', '.join(PROTOCOLS)}")
    return PROTOCOLS[name]


def candidate_protocols(name: str, transport: Literal["bytes", "can"], live: bool) -> list[Protocol]:
    """The protocols that a line may speak.

    Args:
        name: one of them, or "auto".
        transport: of the line.
        live: the line has devices on it; those that want to be asked are not found by listening.

    Raises:
        ConfigError: no such protocol, it is one of another transport, or a package for it is missing.
    """
    if name != "auto":
        protocol = protocol_named(name)
        if protocol.transport != transport:
            where = "CAN" if protocol.transport == "can" else "serial lines"
            flag = "--can" if protocol.transport == "can" else "--port"
            raise ConfigError(f"protocol {name} is one of {where}; use it with {flag} or a log of one")
        return [protocol]
    # Two names can stand for one decoder.
    first = {
        protocol.decoder: protocol
        for protocol in reversed(list(PROTOCOLS.values()))
        if protocol.transport == transport and not (live and protocol.request)
    }
    return list(reversed(first.values()))


class Detector:
    """Listens to a line with the decoders of several protocols.

    Attributes:
        decoders: one for each protocol that can be listened for.
    """

    def __init__(self, name: str, protocols: Sequence[Protocol]) -> None:
        """Start with nothing heard.

        Args:
            name: of the line, for messages.
            protocols: the candidates.

        Raises:
            ConfigError: a package for the only candidate is missing.
        """
        self._name = name
        self._protocols: list[Protocol] = []
        self.decoders: list[Decoder] = []
        self._heard: list[Heard] = []
        for protocol in protocols:
            try:
                decoder = protocol.decoder()
            except RuntimeError as error:  # an optional package
                if len(protocols) == 1:
                    raise ConfigError(str(error)) from None
                continue
            self._protocols.append(protocol)
            self.decoders.append(decoder)
            self._heard.append([])

    def feed(self, chunk: Chunk, arrival_s: float) -> None:
        """Listen to what came at a time, seconds."""
        for decoder, heard in zip(self.decoders, self._heard, strict=True):
            samples = decode(decoder, chunk)
            if samples:
                heard.append((arrival_s, samples))

    def best(self, now: bool) -> tuple[Protocol, Decoder, Heard] | None:
        """The protocol that the line speaks, its decoder, and what that has heard; None if it is not clear.

        Args:
            now: decide on weak evidence too.

        Raises:
            ConfigError: two fit equally well.
        """
        heard = [i for i, samples in enumerate(self._heard) if samples]
        most = max((self.decoders[i].counters.packets for i in heard), default=0)
        # Decoders of text lines can understand some columns of another format, as many times.
        close = [i for i in heard if 2 * self.decoders[i].counters.packets >= most]
        close.sort(key=self._quantities, reverse=True)
        if not close:
            return None
        best = close[0]
        packets, bad = self.decoders[best].counters.packets, self.decoders[best].counters.bad
        # A line that is heard from the middle of a packet begins with a bad one.
        sure = len(heard) == 1 and packets >= SURE_PACKETS and bad <= 1
        if not sure and not (now and packets >= LEAST_PACKETS and 2 * packets >= bad):
            return None
        for other in close[1:]:
            if self._quantities(other) == self._quantities(best):
                raise ConfigError(
                    f"{self._name}: it could be {self._protocols[best].name} ({packets} good packets) or "
                    f"{self._protocols[other].name} ({self.decoders[other].counters.packets}); "
                    "say which with --protocol"
                )
        return self._protocols[best], self.decoders[best], self._heard[best]

    def _quantities(self, i: int) -> int:
        """How much there is in the last good packet of a decoder."""
        return sum(value is not None for value in self._heard[i][-1][1][-1][2:])


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
