"""Feeds every decoder of the registry noise and damaged packets, and counts what it makes of them.

Nothing may raise, hang or grow without end, and every good packet that no damage has touched must be found.
"""

from __future__ import annotations

import gc
import random
import time
import tracemalloc
from collections.abc import Iterator
from itertools import chain
from math import atan2, cos, pi, sin
from typing import Any, NamedTuple

import click

from firmware_protocols.registry import PROTOCOLS, Decoder, Protocol
from firmware_protocols.sample import Sample

ROUND = 300
"""Samples sent between two counts."""

REST = 20
"""Samples at the end of a round that are left whole and not judged: some decoders give a sample late."""

DAMAGED = 0.15
"""Share of the samples that are damaged."""

STEP = 0.1
"""m/s^2 between the forces of two samples, by which they are told apart."""

FD_LENGTHS = (12, 16, 20, 24, 32, 48, 64)


LINES = ("adafruit", "razor", "openlog", "openlog-dmp")
"""Formats in which a line without its end spoils the next one: they have no mark of where a line begins."""


class Result(NamedTuple):
    """What a decoder made of its input.

    Attributes:
        fed: bytes (data bytes on CAN).
        good: samples that no damage touched.
        missed: of these, how many were not given.
        grown: bytes of memory that the decoder holds more than after the first round.
        slowest_us: longest time that one piece of input took, microseconds a byte.
    """

    fed: int
    good: int
    missed: int
    grown: int
    slowest_us: float


def sample_of(number: int, sensor: int, time_us: int) -> Sample:
    """A sample that can be told from the others of its round by its force or its heading."""
    half = pi * number / ROUND
    # Less than 16 g.
    acc = (STEP * (number - ROUND / 2), 1.0, 9.0)
    return Sample(
        sensor, time_us, (cos(half), 0.0, 0.0, sin(half)), acc, (0.1, 0.2, 0.3), (20.0, 1.0, -40.0), 25.0
    )


def number_of(sample: Sample) -> int:
    """Inverse of `sample_of`; any number for a sample that is none of those."""
    if sample.acc is not None:
        return round(sample.acc[0] / STEP + ROUND / 2)
    if sample.quat is not None:
        w, _, _, z = sample.quat
        # q and -q are the same.
        return round(atan2(z, w) / pi * ROUND) % ROUND
    return -1


class Sender:
    """Packets of six sensors (or of one, where a sensor has a line to itself), one sample after the other."""

    def __init__(self, protocol: Protocol) -> None:
        """Nothing sent yet."""
        self._encode = protocol.encoder()
        self._ids = [0] if protocol.single_device else list(protocol.ids)
        self._bytes = protocol.transport == "bytes"
        self._count = 0

    def round(self) -> list[list[Any]]:
        """The pieces (bytes, or CAN frames) of each sample of a round."""
        result = []
        for number in range(ROUND):
            seq, which = divmod(self._count, len(self._ids))
            wire = self._encode(sample_of(number, self._ids[which], 10_000 * (seq + 1)), seq)
            result.append([wire] if self._bytes else list(wire))
            self._count += 1
        return result


# --- damage -----------------------------------------------------------------------------------------


def damage_bytes(rng: random.Random, piece: bytes) -> bytes:
    """A packet after something happened to it on its way."""
    data = bytearray(piece)
    kind = rng.randrange(5)
    at = rng.randrange(len(data))
    if kind == 0:
        data[at] ^= 1 << rng.randrange(8)
    elif kind == 1:
        del data[at : at + rng.randint(1, 40)]
    elif kind == 2:
        data[at:at] = rng.randbytes(rng.randint(1, 40))
    elif kind == 3:
        end = min(len(data), at + rng.randint(1, 40))
        data[at:end] = rng.randbytes(end - at)
    else:
        data = data[: at + 1] + data
    return bytes(data)


def damage_frames(rng: random.Random, frames: list[Any], used: set[tuple[int, bool]]) -> list[Any]:
    """The CAN frames of a sample after something happened to one of them."""
    at = rng.randrange(len(frames))
    can_id, data, extended, fd = frames[at]
    kind = rng.randrange(5)
    if kind == 0:
        changed = []
    elif kind == 1:
        changed = [(can_id, rng.randbytes(len(data)), extended, fd)]
    elif kind == 2:
        changed = [(can_id, rng.randbytes(rng.choice((*range(9), *FD_LENGTHS))), extended, True)]
    elif kind == 3:
        changed = [frames[at]] * 2
    else:
        changed = [foreign_frame(rng, used)]
    return frames[:at] + changed + frames[at + 1 :]


def foreign_frame(rng: random.Random, used: set[tuple[int, bool]]) -> Any:
    """A frame of somebody else on the bus."""
    while True:
        extended = rng.random() < 0.5
        can_id = rng.getrandbits(29 if extended else 11)
        if (can_id, extended) not in used:
            return can_id, rng.randbytes(rng.choice((*range(9), *FD_LENGTHS))), extended, False


def noise(rng: random.Random, protocol: Protocol, pieces: list[list[Any]]) -> Iterator[Any]:
    """Input without meaning: bytes of any kind, or only of those that the format uses; frames of any kind."""
    if protocol.transport == "bytes":
        alphabet = b"".join(chain.from_iterable(pieces[:20]))
        for _ in range(10):
            yield rng.randbytes(rng.randint(1, 300))
            yield bytes(rng.choices(alphabet, k=rng.randint(1, 300)))
        return
    used = [frame[0] for frame in chain.from_iterable(pieces[:20])]
    for _ in range(400):
        extended = rng.random() < 0.5
        data = rng.randbytes(rng.choice((*range(9), 8, 8, 8, *FD_LENGTHS)))
        yield rng.choice((rng.choice(used), rng.getrandbits(29 if extended else 11))), data, extended, False


def damaged(rng: random.Random, protocol: Protocol, pieces: list[list[Any]]) -> tuple[list[Any], set[int]]:
    """The input of a round, and the numbers of the samples in it that nothing happened to."""
    used = (
        {frame[0::2][:2] for frame in chain.from_iterable(pieces)} if protocol.transport == "can" else set()
    )
    out: list[Any] = []
    good = set()
    spoilt = False
    for number, sample in enumerate(pieces):
        if number < ROUND - REST and rng.random() < DAMAGED:
            if protocol.transport == "can":
                out += damage_frames(rng, sample, used)
            else:
                out.append(damage_bytes(rng, sample[0]))
                spoilt = protocol.name in LINES and not out[-1].endswith(b"\n")
        else:
            if protocol.transport == "can" and rng.random() < 0.1:
                out.append(foreign_frame(rng, used))
            out += sample
            if not spoilt:
                good.add(number)
            spoilt = False
    return out, good


# --- feeding ----------------------------------------------------------------------------------------


class Feeder:
    """Feeds a decoder in pieces of any size and keeps the slowest time a byte."""

    def __init__(self, decoder: Decoder, rng: random.Random) -> None:
        """Nothing fed yet; rng chooses the sizes of the pieces."""
        self.fed = 0
        self.slowest_us = 0.0
        self._decoder = decoder
        self._rng = rng

    def feed(self, pieces: list[Any]) -> list[Sample]:
        """Samples of the pieces."""
        if not pieces:
            return []
        if isinstance(pieces[0], tuple):
            result = []
            for can_id, data, extended, _ in pieces:
                result += self._timed(len(data), can_id, data, extended)
            return result
        stream = b"".join(pieces)
        result = []
        at = 0
        while at < len(stream):
            size = self._rng.choice((1, 7, 64, 1024, 4096))
            result += self._timed(min(size, len(stream) - at), stream[at : at + size])
            at += size
        return result

    def _timed(self, size: int, *words: Any) -> list[Sample]:
        start = time.perf_counter()
        samples = self._decoder.feed(*words)
        # Short pieces show the interruptions of this machine.
        if size >= 1024:
            self.slowest_us = max(self.slowest_us, (time.perf_counter() - start) * 1e6 / size)
        self.fed += size
        return samples


def fuzz(protocol: Protocol, size: int, seed: int) -> Result:
    """Feeds at least `size` bytes to a fresh decoder: rounds of damaged packets, with noise between them."""
    rng = random.Random(seed)
    sender = Sender(protocol)
    feeder = Feeder(protocol.decoder(), rng)
    first = list(chain.from_iterable(sender.round()[:REST]))  # with the header, where a format has one
    feeder.feed(first)
    judged = missed = held = rounds = 0
    tracemalloc.start()
    try:
        while feeder.fed < size or rounds < 2:
            pieces = sender.round()
            feeder.feed(list(noise(rng, protocol, pieces)))
            feeder.feed(
                list(chain.from_iterable(sender.round()[:REST]))
            )  # an end to whatever the noise began
            pieces = sender.round()
            known = expected(protocol, first, pieces)
            stream, good = damaged(rng, protocol, pieces)
            got = {number_of(sample) for sample in feeder.feed(stream)}
            wanted = {number for number in good & known if number < ROUND - REST}
            judged += len(wanted)
            missed += len(wanted - got)
            del pieces, stream, good, got, wanted, known
            held = held or held_bytes()
            rounds += 1
        grown = held_bytes() - held
    finally:
        tracemalloc.stop()
    return Result(feeder.fed, judged, missed, grown, feeder.slowest_us)


def held_bytes() -> int:
    """Memory in use, bytes."""
    gc.collect()
    return tracemalloc.get_traced_memory()[0]


def expected(protocol: Protocol, first: list[Any], pieces: list[list[Any]]) -> set[int]:
    """Numbers of the samples that come out of a round without any damage."""
    feeder = Feeder(protocol.decoder(), random.Random(0))
    feeder.feed(first)
    return {number_of(sample) for sample in feeder.feed(list(chain.from_iterable(pieces)))}


@click.command(help=__doc__)
@click.option(
    "--bytes", "size", type=click.IntRange(1), default=1_000_000, show_default=True, help="For each decoder."
)
@click.option("--seed", type=int, default=0, show_default=True)
@click.argument("names", nargs=-1, type=click.Choice(list(PROTOCOLS)))
def main(size: int, seed: int, names: tuple[str, ...]) -> None:
    """The command line."""
    print(f"{'format':<18}{'bytes':>9}{'good':>8}{'missed':>8}{'held more, B':>14}{'slowest, us/B':>15}")
    for name in names or PROTOCOLS:
        r = fuzz(PROTOCOLS[name], size, seed)
        print(f"{name:<18}{r.fed:>9}{r.good:>8}{r.missed:>8}{r.grown:>14}{r.slowest_us:>15.1f}", flush=True)


if __name__ == "__main__":
    main()
