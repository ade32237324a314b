"""Detection of the devices on a line, by listening to it."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from typing import Any, NamedTuple

from edgepose.errors import ConfigError, EdgeposeError
from edgepose.sources.line_config import BAUD, can_line, hid_line, serial_line, tcp_line, udp_line
from edgepose.sources.line_decoder import LISTEN_S
from edgepose.sources.line_reader import LineDisconnectedError, LineSpec, discard_backlog
from edgepose.sources.protocol_detection import DecodedChunks, Detector
from edgepose.sources.sender_decoders import MOST_SENDERS

BAUDS = (BAUD, 921600, 460800, 230400, 57600, 38400, 9600)
"""Speeds to try, the most likely first, bit/s."""

CALLS_S = 2.5
"""Time to listen to a socket, seconds: trackers call once a second."""


class ProbeResult(NamedTuple):
    """Findings about a line.

    Attributes:
        protocol: name of the wire format; None if none could be decoded.
        amount: bytes, frames, datagrams or reports received.
        rates_hz: samples per second by sensor id.
        refused: input that could be understood but not used, see `Decoder.refused`; for a sender of datagrams
            also formats that fit equally well.
    """

    protocol: str | None
    amount: int
    rates_hz: dict[int, float]
    refused: str | None = None


def probe_port(name: str) -> tuple[ProbeResult, int]:
    """Probe a serial port; also return the speed at which it could be decoded, bit/s.

    Raises:
        EdgeposeError: the port cannot be opened, or formats fit equally well.
    """
    result = ProbeResult(None, 0, {})
    for baud in BAUDS:
        result = probe_line(serial_line(name, "auto", baud, lambda found: {}))
        # A wrong speed produces wrong bytes, not none.
        if result.protocol is not None or not result.amount or result.refused is not None:
            return result, baud
    return result, BAUD


def probe_bus(name: str, bitrate: int | None = None) -> ProbeResult:
    """Probe a CAN bus at one bit rate: trying others would disturb the traffic of its devices.

    Raises:
        EdgeposeError: the bus cannot be opened, or formats fit equally well.
    """
    return probe_line(can_line(name, "auto", bitrate, False, lambda found: {}))


def probe_connection(name: str) -> ProbeResult:
    """Probe a device by a TCP connection to HOST:PORT.

    Raises:
        EdgeposeError: it cannot be connected to, or formats fit equally well.
    """
    return probe_line(tcp_line(name, "auto", lambda found: {}))


def probe_receiver(name: str) -> ProbeResult:
    """Probe a USB receiver.

    Raises:
        EdgeposeError: it cannot be opened.
    """
    return probe_line(hid_line(name, "auto", lambda found: {}))


def probe_socket(name: str) -> dict[str, ProbeResult]:
    """Listen for datagrams at HOST:PORT, and return the findings about each sender.

    Anybody can send: a sender whose formats fit equally well costs only its own finding.

    Raises:
        EdgeposeError: it cannot be listened at.
    """
    spec = udp_line(name, "auto", lambda found, sender: {}, None)
    detectors: dict[str, Detector] = {}
    amounts: Counter[str] = Counter()
    for arrival_s, datagrams in _listen(spec, CALLS_S):
        for datagram in datagrams:
            if datagram.sender not in detectors:
                if len(detectors) == MOST_SENDERS:
                    continue
                detectors[datagram.sender] = Detector(datagram.sender, spec.protocols)
            amounts[datagram.sender] += 1
            detectors[datagram.sender].feed([datagram], arrival_s)
    results: dict[str, ProbeResult] = {}
    for sender, detector in sorted(detectors.items()):
        try:
            results[sender] = _result(detector, amounts[sender])
        except ConfigError as error:
            refused = str(error).removeprefix(f"{sender}: ")
            results[sender] = ProbeResult(None, amounts[sender], {}, refused)
    return results


def probe_line(spec: LineSpec) -> ProbeResult:
    """Listen to a line for a little more than a second.

    Raises:
        EdgeposeError: the line cannot be opened, or formats fit equally well.
    """
    detector = Detector(spec.name, spec.protocols)
    amount = 0
    for arrival_s, chunk in _listen(spec):
        amount += len(chunk)
        detector.feed(chunk, arrival_s)
    return _result(detector, amount)


def _listen(spec: LineSpec, seconds: float | None = None) -> Iterator[tuple[float, Any]]:
    """Yield arrival, seconds, and data of what comes over a line, from the first of it on for some time."""
    seconds = LISTEN_S if seconds is None else seconds
    transport = spec.open()
    heard = False
    try:
        discard_backlog(transport)
        end_s = time.monotonic() + seconds
        while (now_s := time.monotonic()) < end_s:
            chunk, _ = transport.read()
            if not chunk:
                continue
            if not heard:
                heard, end_s = True, now_s + seconds
            yield time.monotonic(), chunk
    except LineDisconnectedError:
        raise EdgeposeError(f"{spec.name}: disconnected while it was being probed") from None
    finally:
        transport.close()


def _result(detector: Detector, amount: int) -> ProbeResult:
    found = detector.best(True)
    if found is None:
        return ProbeResult(None, amount, {}, detector.refused)
    protocol, _, decoded = found
    rates = {sensor: _rate_hz(arrivals) for sensor, arrivals in sorted(_arrivals(decoded).items())}
    return ProbeResult(protocol.name, amount, rates)


def _arrivals(decoded: DecodedChunks) -> dict[int, list[tuple[float, int]]]:
    """Return the arrival time of each chunk, seconds, and its number of samples, by sensor id."""
    result: dict[int, list[tuple[float, int]]] = {}
    for arrival_s, samples in decoded:
        for sensor, count in Counter(sample.sensor for sample in samples).items():
            result.setdefault(sensor, []).append((arrival_s, count))
    return result


def _rate_hz(arrivals: list[tuple[float, int]]) -> float:
    """Return the samples per second after the first chunk: n samples span n - 1 periods."""
    span_s = arrivals[-1][0] - arrivals[0][0]
    return sum(count for _, count in arrivals[1:]) / span_s if span_s > 0.0 else 0.0
