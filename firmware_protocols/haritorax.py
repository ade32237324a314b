"""HaritoraX full-body trackers on a serial port: text lines of the GX dongle and of the wired model.

Layouts and the origin of the scales are in docs/haritorax.md. There is no time, no angular rate and no
checksum.
"""

from __future__ import annotations

import re
import struct
from base64 import b64decode, b64encode
from collections.abc import Iterable

from firmware_protocols._stream import Receiver
from firmware_protocols.base import Protocol, uncounted
from firmware_protocols.sample import STANDARD_G, Sample, unit_quaternion

MAX_LINE = 512
"""Length limit of a line, bytes; eight wired sensors need 155."""

SLOTS = 8
"""Tracker slots on one port of a dongle; the second sensor of tracker n has id n + SLOTS."""

_BLOCK = struct.Struct("<7h")
_QUAT_STEPS = 16384
# The norm of all captured quaternions is 16384 within 0.02 %: this detects most corrupted lines.
_TOLERANCE = 0.005
_DONGLE_STEP = STANDARD_G / 2048
_WIRED_STEP = 1 / 256  # m/s^2
_LINE = re.compile(rb"(?:X([0-7])|P):([A-Za-z0-9+/]+={0,2})\r*\Z")
_OTHER = re.compile(rb"[a-z][0-9]?:[ -~]*\r*\Z")

# Sizes in bytes of a dongle's line: one sensor and two bytes of ankle distance; or two sensors with two bytes
# of state between them. Neither is a whole number of blocks.
_DONGLE_BLOCKS = {16: (0,), 30: (0, 16)}
_WIRED_LENGTHS = range(_BLOCK.size, 8 * _BLOCK.size + 1, _BLOCK.size)


class HaritoraxDecoder(Receiver):
    """Decoder for a byte stream that may be split anywhere, start anywhere and contain noise.

    `sensor` is the slot of the tracker on this port of the dongle (0 to 7; 8 more for the second sensor of a
    leg tracker), or the position in the line of the wired model.

    Attributes:
        counters: counts of everything decoded so far.
    """

    WRAP_US = 1 << 64

    def __init__(self) -> None:
        """Create the decoder."""
        super().__init__()
        self._rest = b""

    def feed(self, data: bytes) -> list[Sample]:
        """Return the samples completed by the next bytes of the stream, in order of arrival."""
        self.counters.bytes += len(data)
        *lines, rest = (self._rest + data).split(b"\n")
        # One byte above the limit is kept, so that a line that is too long cannot pass for a whole one.
        self._rest = rest[-MAX_LINE - 1 :]
        samples: list[Sample] = []
        for line in lines:
            if line.strip(b"\r"):
                samples += self._line(line[-MAX_LINE - 1 :])
        return samples

    def _line(self, line: bytes) -> list[Sample]:
        match = _LINE.search(line)
        if match is None and len(line) <= MAX_LINE and _OTHER.match(line):
            self.counters.skipped += 1  # buttons, battery, settings
            return []
        samples = _samples(match) if match is not None else []
        # A good line may directly follow a corrupted one whose end is missing.
        if match is None or match.start() or not samples:
            self._count_bad()
        if samples:
            self._count_good()
            self.counters.packets += len(samples)
        return samples


def _samples(match: re.Match[bytes]) -> list[Sample]:
    """Return the samples of a line; none if its content is impossible."""
    slot, text = match.groups()
    if len(text) % 4:
        return []
    data = b64decode(text)
    if slot is not None:
        first, step, id_step = int(slot), _DONGLE_STEP, SLOTS
        starts: Iterable[int] = _DONGLE_BLOCKS.get(len(data), ())
    elif len(data) in _WIRED_LENGTHS:
        first, step, id_step = 0, _WIRED_STEP, 1
        starts = range(0, len(data), _BLOCK.size)
    else:
        return []
    samples = []
    for i, start in enumerate(starts):
        x, y, z, w, a, b, c = _BLOCK.unpack_from(data, start)
        quat = unit_quaternion(w / _QUAT_STEPS, x / _QUAT_STEPS, y / _QUAT_STEPS, z / _QUAT_STEPS, _TOLERANCE)
        if quat is None:
            return []
        samples.append(Sample(first + i * id_step, None, quat, (a * step, b * step, c * step)))
    return samples


def encode(sample: Sample) -> bytes:
    """Return a dongle's line for tracker `sample.sensor`, which has one sensor.

    Raises:
        ValueError: there is no such slot, or the sample has no orientation or no specific force.
    """
    if not 0 <= sample.sensor < SLOTS:
        raise ValueError(f"slots of a dongle are 0 to {SLOTS - 1}, not {sample.sensor}")
    return b"X%d:%s\n" % (sample.sensor, b64encode(_block(sample, _DONGLE_STEP) + b"\0\0"))


def encode_wired(samples: Iterable[Sample]) -> bytes:
    """Return the line of the wired model with all its sensors, in the order of `samples`."""
    return b"P:" + b64encode(b"".join(_block(sample, _WIRED_STEP) for sample in samples)) + b"\n"


def _block(sample: Sample, step: float) -> bytes:
    if sample.quat is None or sample.acc is None:
        raise ValueError("a block needs both orientation and specific force")
    w, *xyz = (round(value * _QUAT_STEPS) for value in sample.quat)
    return _BLOCK.pack(*xyz, w, *(max(-32768, min(32767, round(value / step))) for value in sample.acc))


PROTOCOL = Protocol(
    name="haritorax",
    transport="bytes",
    default_bitrate=500_000,
    description="HaritoraX trackers, by a GX dongle or wired; ids are slots of the dongle",
    decoder=HaritoraxDecoder,
    encoder=uncounted(encode),
    ids=range(6),
    common_heading=False,
    lacks=("time",),
)
