"""Packets with random content and right checksums: what a decoder makes of them must be plausible."""

from __future__ import annotations

import random
import re
import struct
import time
from binascii import crc_hqx
from collections.abc import Callable, Iterator
from functools import reduce
from itertools import cycle, islice
from math import isfinite
from operator import xor
from pathlib import Path
from typing import Any, NamedTuple

from firmware_protocols._numbers import LARGEST
from firmware_protocols.base import Protocol
from firmware_protocols.mip import checksum
from firmware_protocols.native import cobs_decode, cobs_encode
from firmware_protocols.sample import Sample
from firmware_protocols.witmotion_modbus import crc16

CAPTURES = Path(__file__).parents[1] / "tests" / "data" / "protocols"

RECORDED = {
    "xsens": ("xsens-mtig710-1.bin", "xsens-mtig710-2.bin"),
    "mip": ("microstrain-mip.bin",),
}
"""Real captures by format."""

BATCH = 100
"""Packets that are fed together."""

DAMAGED = 0.5
"""Share of the packets that are damaged."""

SLOWEST_S = 5.0
"""Longest time for a batch, seconds; it takes milliseconds."""

NEW_DECODER = 0.02
"""Share of the batches that begin with a new decoder."""

EXTREMES = (
    *(struct.pack(order + kind, value) for order in "<>" for kind in "fd" for value in (1e7, -3e38)),
    *(struct.pack(order + "f", float(value)) for order in "<>" for value in ("nan", "inf", "-inf")),
    *(struct.pack(order + "d", float(value)) for order in "<>" for value in ("nan", "inf", "1e308")),
    *(bytes(2), bytes(4), bytes(8), b"\xff" * 2, b"\xff" * 4, b"\xff" * 8, b"\x80\x00", b"\x7f\xff"),
)
"""Bytes in the place of others: numbers at their ends."""

TEXTS = (
    *(b"nan", b"inf", b"-inf", b"1e308", b"-0", b"", b"9" * 30, b"1e400", b"x", b"-1", b"0x1", b"1_0"),
    *(b",", b",,", b"\xd9\xa1", b"+", b"1e7", b"99999999"),
)
"""Text in the place of a number."""

NUMBER = re.compile(rb"[-+]?\d+(?:\.\d+)?")


class Framing(NamedTuple):
    """Start and checksum of a format's packets.

    Attributes:
        start: pattern of the first bytes.
        content: returns the part of a packet that its checksum protects.
        packet: returns the packet of a content, with the right length and checksum.
    """

    start: bytes
    content: Callable[[bytes], bytes]
    packet: Callable[[bytes], bytes]


def _xsens(content: bytes) -> bytes:
    head = content[:2] + bytes([max(0, len(content) - 3)]) if len(content) < 258 else content[:3]
    body = head + content[3:]
    return b"\xfa" + body + bytes([-sum(body) & 0xFF])


def _hipnuc(content: bytes) -> bytes:
    head = b"\x5a\xa5" + len(content).to_bytes(2, "little")
    return head + crc_hqx(content, crc_hqx(head, 0)).to_bytes(2, "little") + content


def _lpms(content: bytes) -> bytes:
    body = content[:4] + max(0, len(content) - 6).to_bytes(2, "little") + content[6:]
    return b"\x3a" + body + (sum(body) & 0xFFFF).to_bytes(2, "little") + b"\r\n"


def _mip(content: bytes) -> bytes:
    body = content[:3] + bytes([max(0, len(content) - 4) & 0xFF]) + content[4:]
    return body + checksum(body)


def _mavlink(content: bytes) -> bytes:
    from pymavlink.dialects.v20 import common

    kind = int.from_bytes(content[6:9], "little")
    body = bytes([max(0, len(content) - 9) & 0xFF]) + content[1:]
    extra = common.mavlink_map[kind].crc_extra if kind in common.mavlink_map else 0
    crc = common.x25crc(body + bytes([extra])).crc
    return b"\xfd" + body + crc.to_bytes(2, "little")


FRAMINGS = {
    "native": Framing(
        b"(?<=\0)|^",
        lambda packet: cobs_decode(packet[:-1])[:-2],
        lambda content: cobs_encode(content + crc_hqx(content, 0xFFFF).to_bytes(2, "little")) + b"\0",
    ),
    "xsens": Framing(b"\xfa\xff", lambda packet: packet[1:-1], _xsens),
    "hipnuc": Framing(b"\x5a\xa5", lambda packet: packet[6:], _hipnuc),
    "witmotion": Framing(
        b"\x55", lambda packet: packet[:-1], lambda content: content + bytes([sum(content) & 0xFF])
    ),
    "witmotion-modbus": Framing(
        b"^", lambda packet: packet[:-2], lambda content: content + crc16(content).to_bytes(2, "little")
    ),
    "lpms": Framing(b"\x3a", lambda packet: packet[1:-4], _lpms),
    "bno08x-rvc": Framing(
        b"\xaa\xaa",
        lambda packet: packet[2:-1],
        lambda content: b"\xaa\xaa" + content + bytes([sum(content) & 0xFF]),
    ),
    "mip": Framing(b"\x75\x65", lambda packet: packet[:-2], _mip),
    "vectornav": Framing(
        b"\xfa",
        lambda packet: packet[1:-2],
        lambda content: b"\xfa" + content + crc_hqx(content, 0).to_bytes(2, "big"),
    ),
    "vectornav-ascii": Framing(
        rb"\$",
        lambda packet: packet[1:-5],
        lambda content: b"$" + content + b"*%02X\r\n" % reduce(xor, content, 0),
    ),
    "mavlink": Framing(b"\xfd", lambda packet: packet[1:-2], _mavlink),
}
"""Formats with a checksum in each packet."""

UNPROTECTED = Framing(b"^", lambda packet: packet, lambda content: content)
"""Formats without one: text, x-io, HaritoraX, CAN."""


def packets(framing: Framing, stream: bytes) -> list[bytes]:
    """Return the whole packets of a stream."""
    starts = [match.start() for match in re.finditer(framing.start, stream)]
    found = []
    at = 0
    for i, start in enumerate(starts):
        if start < at:
            continue
        # A start can occur inside a packet: it ends at the first one that makes the checksum right.
        for end in (*starts[i + 1 : i + 20], len(stream)):
            piece = stream[start:end]
            try:
                whole = framing.packet(framing.content(piece)) == piece
            except (ValueError, IndexError):
                whole = False
            if whole:
                found.append(piece)
                at = end
                break
    return found


def damage(rng: random.Random, content: bytes) -> bytes:
    """Return a content with one to four random changes; most keep its length."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 4))):
        if not data:
            break
        at = rng.randrange(len(data))
        kind = rng.random()
        if kind < 0.35:
            data[at] = rng.randrange(256)
        elif kind < 0.45:
            data[at] ^= 1 << rng.randrange(8)
        elif kind < 0.75:
            extreme = rng.choice(EXTREMES)
            data[at : at + len(extreme)] = extreme[: len(data) - at]
        elif kind < 0.85:
            end = min(len(data), at + rng.randint(1, 12))
            data[at:end] = rng.randbytes(end - at)
        elif kind < 0.9:
            del data[at : at + rng.randint(1, 8)]
        elif kind < 0.95:
            data[at:at] = rng.randbytes(rng.randint(1, 8))
        else:
            other = rng.randrange(len(data))
            data[at : at + 4], data[other : other + 4] = data[other : other + 4], data[at : at + 4]
    return bytes(data)


def damage_text(rng: random.Random, content: bytes) -> bytes:
    """Return a line with numbers replaced, or with the changes of `damage`."""
    if rng.random() < 0.3:
        return damage(rng, content)
    for _ in range(rng.choice((1, 1, 3))):
        numbers = list(NUMBER.finditer(content))
        if not numbers:
            break
        start, end = rng.choice(numbers).span()
        content = content[:start] + rng.choice(TEXTS) + content[end:]
    return content


def implausible(sample: Sample, wrap_us: int) -> str | None:
    """Return what is wrong with a sample; None if it could come from a sensor that is worn."""
    if not 0 <= sample.sensor < 1 << 64:
        return "sensor"
    if sample.time_us is not None and not (
        isinstance(sample.time_us, int) and 0 <= sample.time_us <= wrap_us
    ):
        return "time_us"
    if sample.quat is not None and not abs(sum(v * v for v in sample.quat) - 1.0) < 1e-6:
        return "quat"
    for name, values in zip(("acc", "gyr", "mag"), sample[3:6], strict=True):
        if values is not None and not sum(map(abs, values)) <= LARGEST:
            return name
    if sample.temperature is not None and not (
        isfinite(sample.temperature) and abs(sample.temperature) <= LARGEST
    ):
        return "temperature"
    return None


class Report(NamedTuple):
    """Result of fuzzing a decoder.

    Attributes:
        packets: damaged packets that were fed.
        samples: samples that came out.
        slowest_s: longest time for a batch, seconds.
        problems: what went wrong.
    """

    packets: int
    samples: int
    slowest_s: float
    problems: list[str]


def sources(protocol: Protocol, pieces: list[Any]) -> list[Any]:
    """Return contents of byte packets, or CAN frames: those of the encoder, and those of real captures."""
    if protocol.transport == "can":
        return [frame for frames in pieces for frame in frames]
    if protocol.in_datagrams:
        return [piece[0] for piece in pieces]
    framing = FRAMINGS.get(protocol.name, UNPROTECTED)
    whole = [packet for piece in pieces for packet in packets(framing, piece[0])]
    for name in RECORDED.get(protocol.name, ()):
        whole += packets(framing, (CAPTURES / name).read_bytes())
    return [framing.content(packet) for packet in whole]


def batches(
    rng: random.Random, protocol: Protocol, found: list[Any], count: int
) -> Iterator[tuple[int, list[tuple[Any, ...]]]]:
    """Yield the number of damaged packets in a batch, and the batch as arguments of `feed`.

    Packets keep their order, for many samples are made of several, and DAMAGED of them are damaged.
    """
    framing = FRAMINGS.get(protocol.name, UNPROTECTED)
    text = all(content.isascii() for content in found if isinstance(content, bytes))
    change = damage_text if text and protocol.transport == "bytes" else damage
    order = cycle(found)
    done = 0
    while done < count:
        batch = [(content, rng.random() < DAMAGED) for content in islice(order, BATCH)]
        damaged = sum(is_damaged for _, is_damaged in batch)
        done += damaged
        if protocol.transport == "can":
            yield (
                damaged,
                [
                    (number, damage(rng, data)[:64] if is_damaged else data, extended)
                    for (number, data, extended, _), is_damaged in batch
                ],
            )
        else:
            contents = (change(rng, content) if is_damaged else content for content, is_damaged in batch)
            packets = list(map(framing.packet, contents))
            yield damaged, [(p,) for p in packets] if protocol.in_datagrams else [(b"".join(packets),)]


def fuzz_packets(protocol: Protocol, pieces: list[Any], count: int, seed: int) -> Report:
    """Feed damaged packets with right checksums to decoders.

    Args:
        protocol: the format.
        pieces: undamaged packets of its encoder: lists of bytes, or of CAN frames.
        count: number of damaged packets, or a few more.
        seed: of all random numbers.
    """
    rng = random.Random(f"{seed} {protocol.name}")
    decoder = protocol.decoder()
    fed = samples = 0
    slowest_s = 0.0
    problems: list[str] = []
    inputs = batches(rng, protocol, sources(protocol, pieces), count)
    for number, (damaged, batch) in enumerate(inputs):
        if rng.random() < NEW_DECODER:
            decoder = protocol.decoder()
        start = time.perf_counter()
        got: list[Sample] = []
        try:
            for words in batch:
                got += decoder.feed(*words)
        except Exception as error:
            problems.append(f"batch {number}: {error!r}")
            decoder = protocol.decoder()
        took_s = time.perf_counter() - start
        slowest_s = max(slowest_s, took_s)
        if took_s > SLOWEST_S:
            problems.append(f"batch {number}: {took_s:.1f} s")
        for sample in got:
            wrong = implausible(sample, decoder.WRAP_US)
            if wrong is not None:
                problems.append(f"batch {number}: {wrong} of {sample}")
        fed += damaged
        samples += len(got)
    return Report(fed, samples, slowest_s, problems)
