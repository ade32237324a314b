"""Feeds noise and damaged packets to every decoder of the registry, and counts the samples that come out.

No decoder may raise, hang or grow without limit, and each must find every packet that the damage did not
touch. With --packets, the damaged packets have right checksums, and what comes out must be plausible.
"""

from __future__ import annotations

import gc
import random
import sys
import time
import tracemalloc
from collections.abc import Iterator, Sequence
from itertools import chain
from math import atan2, cos, pi, sin
from typing import Any, NamedTuple

import click
from fuzz_packets import fuzz_packets

from firmware_protocols.registry import PROTOCOLS, Decoder, Protocol
from firmware_protocols.sample import Sample

ROUND = 300
"""Samples per round."""

REST = 20
"""Samples at the end of a round that are neither damaged nor judged, because some decoders are late."""

DAMAGED = 0.15
"""Share of the samples that are damaged."""

STEP = 0.1
"""Difference between the forces of two samples, by which they are identified, m/s^2."""

FD_LENGTHS = (12, 16, 20, 24, 32, 48, 64)


LINES = ("adafruit", "razor", "openlog", "openlog-dmp")
"""Formats in which a line without its end corrupts the next one, because line starts are not marked."""

CONFIRMED_BY_NEXT = ("witmotion-ble",)
"""Formats without a checksum, in which a packet counts only if an undamaged one follows."""


class Result(NamedTuple):
    """Result of fuzzing a decoder.

    Attributes:
        fed: number of bytes (data bytes on CAN).
        good: number of undamaged samples.
        missed: number of undamaged samples that the decoder did not return.
        grown: growth of the memory in use since the first round, bytes.
        slowest_us: longest time for a piece of input, microseconds per byte.
    """

    fed: int
    good: int
    missed: int
    grown: int
    slowest_us: float


def sample_of(number: int, sensor: int, time_us: int) -> Sample:
    """Return a sample that differs from the others of its round in force and heading."""
    half = pi * number / ROUND
    # Below 16 g.
    acc = (STEP * (number - ROUND / 2), 1.0, 9.0)
    return Sample(
        sensor, time_us, (cos(half), 0.0, 0.0, sin(half)), acc, (0.1, 0.2, 0.3), (20.0, 1.0, -40.0), 25.0
    )


def number_of(sample: Sample) -> int:
    """Return the number of a sample made by `sample_of`; any number for other samples."""
    if sample.acc is not None:
        return round(sample.acc[0] / STEP + ROUND / 2)
    if sample.quat is not None:
        w, _, _, z = sample.quat
        # q and -q are the same rotation.
        return round(atan2(z, w) / pi * ROUND) % ROUND
    return -1


class Sender:
    """Source of packets of six sensors, or of one if each sensor has its own line."""

    def __init__(self, protocol: Protocol) -> None:
        """Create the encoder."""
        self._encode = protocol.encoder()
        self._ids = [0] if protocol.single_device else list(protocol.ids)
        self._bytes = protocol.transport != "can"
        self._count = 0

    def round(self) -> list[list[Any]]:
        """Return the pieces (bytes, or CAN frames) of each sample of a round."""
        result = []
        for number in range(ROUND):
            seq, which = divmod(self._count, len(self._ids))
            wire = self._encode(sample_of(number, self._ids[which], 10_000 * (seq + 1)), seq)
            result.append([wire] if self._bytes else list(wire))
            self._count += 1
        return result


# --- damage -----------------------------------------------------------------------------------------


def damage_bytes(rng: random.Random, piece: bytes) -> bytes:
    """Return a packet with random damage: flipped, lost, inserted, changed or repeated bytes."""
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
    """Return the CAN frames of a sample with random damage to one of them."""
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
    """Return a frame of another device on the bus."""
    while True:
        extended = rng.random() < 0.5
        can_id = rng.getrandbits(29 if extended else 11)
        if (can_id, extended) not in used:
            return can_id, rng.randbytes(rng.choice((*range(9), *FD_LENGTHS))), extended, False


def noise(rng: random.Random, protocol: Protocol, pieces: list[list[Any]]) -> Iterator[Any]:
    """Yield random input: arbitrary bytes, bytes that occur in the format, or arbitrary frames."""
    if protocol.transport != "can":
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
    """Return the input of a round, and the numbers of the undamaged samples in it."""
    used = (
        {frame[0::2][:2] for frame in chain.from_iterable(pieces)} if protocol.transport == "can" else set()
    )
    out: list[Any] = []
    good = set()
    corrupted = False
    for number, sample in enumerate(pieces):
        if number < ROUND - REST and rng.random() < DAMAGED:
            if protocol.transport == "can":
                out += damage_frames(rng, sample, used)
            else:
                out.append(damage_bytes(rng, sample[0]))
                if protocol.name in CONFIRMED_BY_NEXT:
                    good.discard(number - 1)
                corrupted = protocol.name in LINES and not out[-1].endswith(b"\n")
        else:
            if protocol.transport == "can" and rng.random() < 0.1:
                out.append(foreign_frame(rng, used))
            out += sample
            if not corrupted:
                good.add(number)
            corrupted = False
    return out, good


# --- feeding ----------------------------------------------------------------------------------------


class Feeder:
    """Feeds a decoder in pieces of random size and records the longest time per byte."""

    def __init__(self, protocol: Protocol, rng: random.Random) -> None:
        """Create a decoder; `rng` chooses the sizes of the pieces."""
        self.fed = 0
        self.slowest_us = 0.0
        self._decoder: Decoder = protocol.decoder()
        self._datagrams = protocol.in_datagrams
        self._rng = rng

    def feed(self, pieces: list[Any]) -> list[Sample]:
        """Feed the pieces and return their samples."""
        if not pieces:
            return []
        if isinstance(pieces[0], tuple):
            result = []
            for can_id, data, extended, _ in pieces:
                result += self._timed(len(data), can_id, data, extended)
            return result
        result = []
        if self._datagrams:
            for piece in pieces:
                result += self._timed(len(piece), piece)
            return result
        stream = b"".join(pieces)
        at = 0
        while at < len(stream):
            size = self._rng.choice((1, 7, 64, 1024, 4096))
            result += self._timed(min(size, len(stream) - at), stream[at : at + size])
            at += size
        return result

    def _timed(self, size: int, *words: Any) -> list[Sample]:
        start = time.perf_counter()
        samples = self._decoder.feed(*words)
        # For short pieces, interruptions by other programs would dominate.
        if size >= 1024:
            self.slowest_us = max(self.slowest_us, (time.perf_counter() - start) * 1e6 / size)
        self.fed += size
        return samples


def fuzz(protocol: Protocol, size: int, seed: int) -> Result:
    """Feed at least `size` bytes to a new decoder: rounds of damaged packets, with noise between them."""
    rng = random.Random(seed)
    sender = Sender(protocol)
    feeder = Feeder(protocol, rng)
    first = list(chain.from_iterable(sender.round()[:REST]))  # with the header, if the format has one
    feeder.feed(first)
    judged = missed = held = rounds = 0
    tracemalloc.start()
    try:
        while feeder.fed < size or rounds < 2:
            pieces = sender.round()
            feeder.feed(list(noise(rng, protocol, pieces)))
            feeder.feed(
                list(chain.from_iterable(sender.round()[:REST]))
            )  # completes whatever the noise began
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
    """Return the memory in use, bytes."""
    gc.collect()
    return tracemalloc.get_traced_memory()[0]


def expected(protocol: Protocol, first: list[Any], pieces: list[list[Any]]) -> set[int]:
    """Return the numbers of the samples that come out of an undamaged round."""
    feeder = Feeder(protocol, random.Random(0))
    feeder.feed(first)
    return {number_of(sample) for sample in feeder.feed(list(chain.from_iterable(pieces)))}


@click.command(help=__doc__)
@click.option(
    "--bytes",
    "size",
    type=click.IntRange(1),
    default=1_000_000,
    show_default=True,
    help="Input for each decoder.",
)
@click.option(
    "--packets",
    type=click.IntRange(1),
    help="Feed this number of damaged packets with right checksums to each decoder instead.",
)
@click.option("--seed", type=int, default=0, show_default=True)
@click.argument("names", nargs=-1, type=click.Choice(list(PROTOCOLS)))
def main(size: int, packets: int | None, seed: int, names: tuple[str, ...]) -> None:
    """Run the command line."""
    chosen = names or tuple(PROTOCOLS)
    if packets is not None:
        sys.exit(print_packets(chosen, packets, seed))
    print(f"{'format':<18}{'bytes':>9}{'good':>8}{'missed':>8}{'held more, B':>14}{'slowest, us/B':>15}")
    for name in chosen:
        r = fuzz(PROTOCOLS[name], size, seed)
        print(f"{name:<18}{r.fed:>9}{r.good:>8}{r.missed:>8}{r.grown:>14}{r.slowest_us:>15.1f}", flush=True)


def print_packets(names: Sequence[str], count: int, seed: int) -> bool:
    """Print a table of damaged packets with right checksums; return whether anything is wrong."""
    print(f"{'format':<18}{'packets':>9}{'samples':>9}{'slowest batch, s':>18}{'wrong':>7}")
    failed = False
    for name in names:
        r = fuzz_packets(PROTOCOLS[name], Sender(PROTOCOLS[name]).round(), count, seed)
        print(f"{name:<18}{r.packets:>9}{r.samples:>9}{r.slowest_s:>18.3f}{len(r.problems):>7}", flush=True)
        for problem in r.problems[:5]:
            print(f"    {problem}", flush=True)
        failed = failed or bool(r.problems)
    return failed


if __name__ == "__main__":
    main()
