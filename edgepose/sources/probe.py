"""Listens to ports and buses to find out what is on them."""

from __future__ import annotations

import time
from collections import Counter
from typing import NamedTuple

from edgepose.errors import EdgeposeError
from edgepose.sources.line_config import BAUD, can_link, serial_link
from edgepose.sources.line_decoder import LISTEN_S
from edgepose.sources.live import LineDisconnectedError, LineSpec
from edgepose.sources.protocol_detection import Detector

BAUDS = (BAUD, 921600, 460800, 230400, 57600, 38400, 9600)
"""Speeds that are tried, the most likely first, bit/s."""


class ProbeResult(NamedTuple):
    """What a line says.

    Attributes:
        protocol: name of the wire format; None if nothing was understood.
        amount: bytes or frames that came.
        rates_hz: samples a second by sensor id.
    """

    protocol: str | None
    amount: int
    rates_hz: dict[int, float]


def probe_port(name: str) -> tuple[ProbeResult, int]:
    """What is on a serial port, and the speed at which it was understood, bit/s.

    Raises:
        EdgeposeError: it cannot be opened, or formats fit equally well.
    """
    finding = ProbeResult(None, 0, {})
    for baud in BAUDS:
        finding = probe_line(serial_link(name, "auto", baud, lambda spoken: {}))
        # A wrong speed gives wrong bytes, not none.
        if finding.protocol is not None or not finding.amount:
            return finding, baud
    return finding, BAUD


def probe_bus(name: str, bitrate: int | None = None) -> ProbeResult:
    """What is on a CAN bus. Other bit rates are not tried: that would disturb those who talk on it.

    Raises:
        EdgeposeError: it cannot be opened, or formats fit equally well.
    """
    return probe_line(can_link(name, "auto", bitrate, False, lambda spoken: {}))


def probe_line(link: LineSpec) -> ProbeResult:
    """What comes over a line within a little more than a second.

    Raises:
        EdgeposeError: it cannot be opened, or formats fit equally well.
    """
    handle = link.open()
    detector = Detector(link.name, link.protocols)
    amount = 0
    start_s = time.monotonic()
    end_s = start_s + LISTEN_S
    try:
        while (now_s := time.monotonic()) < end_s:
            chunk, _ = handle.read()
            if chunk and not amount:
                end_s = now_s + LISTEN_S
            amount += len(chunk)
            if chunk:
                detector.feed(chunk, time.monotonic())
    except LineDisconnectedError:
        raise EdgeposeError(f"{link.name}: gone while it was listened to") from None
    finally:
        handle.close()
    found = detector.best(True)
    if found is None:
        return ProbeResult(None, amount, {})
    protocol, _, heard = found
    counts = Counter(sample.sensor for _, samples in heard for sample in samples)
    # A sample less than came has passed between the first and the last.
    span_s = heard[-1][0] - heard[0][0]
    rates = {sensor: max(n - 1, 0) / span_s if span_s else 0.0 for sensor, n in sorted(counts.items())}
    return ProbeResult(protocol.name, amount, rates)
