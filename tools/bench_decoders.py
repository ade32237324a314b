"""Prints the cost of decoding for every format of the registry, with six sensors and one sample at a time.

Only the decoder is measured: no port, no bus, no mapping of clocks. The best of several runs counts, because
other programs can only add to the time.
"""

from __future__ import annotations

import platform
import time
from itertools import chain
from math import cos, sin
from pathlib import Path
from typing import Any

import click

from firmware_protocols.registry import PROTOCOLS, Protocol
from firmware_protocols.sample import Sample

SENSORS, RATE = 6, 200
SAMPLES = 2400
RUNS = 7

# Bits of a CAN 2.0 frame without its data, by extended id, including three bits of silence, before stuffing.
CAN_BITS = {False: 47, True: 67}


def wires(protocol: Protocol) -> list[Any]:
    """Return the packets of all samples, in order of arrival."""
    ids = [0] if protocol.single_device else list(protocol.ids)
    encode = protocol.encoder()
    result = []
    for number in range(SAMPLES):
        seq, which = divmod(number, len(ids))
        turn = 0.01 * seq
        sample = Sample(
            ids[which],
            1_000_000 + 5000 * seq,
            (cos(turn), 0.6 * sin(turn), 0.0, 0.8 * sin(turn)),
            (1.0 + 0.01 * which, -2.0, 9.0),
            (0.1, -0.2, 0.3),
            (20.0, 1.0, -40.0),
        )
        result.append(encode(sample, seq))
    return result


def microseconds(protocol: Protocol, packets: list[Any]) -> float:
    """Return microseconds per sample, the best of several runs.

    Raises:
        AssertionError: samples are missing.
    """
    best = float("inf")
    for _ in range(RUNS):
        decoder = protocol.decoder()
        feed = decoder.feed
        count = 0
        start = time.perf_counter()
        if protocol.transport != "can":
            for wire in packets:
                count += len(feed(wire))
        else:
            for frames in packets:
                for can_id, data, extended, _ in frames:
                    count += len(feed(can_id, data, extended))
        best = min(best, time.perf_counter() - start)
        assert count > SAMPLES - 50, f"{protocol.name}: {count} of {SAMPLES} samples"
    return best / SAMPLES * 1e6


def line_bits(protocol: Protocol, packets: list[Any]) -> float:
    """Return the bits per sample on the line: 8N1, or CAN frames before stuffing."""
    if protocol.transport != "can":
        return 10 * sum(map(len, packets)) / SAMPLES
    return sum(CAN_BITS[extended] + 8 * len(data) for _, data, extended, _ in chain(*packets)) / SAMPLES


def processor() -> str:
    """Return the name of the processor, if the system provides it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


@click.command(help=__doc__)
def main() -> None:
    """Run the command line."""
    print(f"Python {platform.python_version()}, {processor()}; {SENSORS} sensors at {RATE} Hz\n")
    print("| format | line | kbit/s for six | us a sample | share of one core |")
    print("|---|---|---|---|---|")
    for name, protocol in PROTOCOLS.items():
        packets = wires(protocol)
        cost = microseconds(protocol, packets)
        per_s = SENSORS * RATE
        kbit = line_bits(protocol, packets) * per_s / 1000
        line = "CAN" if protocol.transport == "can" else "six ports" if protocol.single_device else "one port"
        print(f"| {name} | {line} | {kbit:.0f} | {cost:.1f} | {cost * per_s / 1e4:.2f} % |", flush=True)


if __name__ == "__main__":
    main()
