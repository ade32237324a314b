"""BNO08x in UART-RVC mode: 19 bytes, 100 times a second, with three angles and the specific force.

Layout, and why the angles are read as they are, in docs/bno08x.md. No time, no angular rate; the heading is
counted from power-up, so every sensor has its own zero.
"""

from __future__ import annotations

import struct
from math import cos, degrees, radians, sin
from typing import ClassVar

from firmware_protocols import rotation
from firmware_protocols.sample import GRAVITY, Counters, Quaternion, Sample

FRAME_BYTES = 19
"""Bytes of a frame, header and checksum included."""

ORDERS = ("zxy", "zyx", "zyx-swapped")
"""How the three angles make a rotation, see `Decoder`."""

_HEADER = b"\xaa\xaa"
_FRAME = struct.Struct("<xxB6h3xx")
_HALF = radians(0.01) / 2
_MG = GRAVITY / 1000
_MAX_TEXT = 256


class Decoder:
    """Samples out of a byte stream that may be cut anywhere, start anywhere and contain noise.

    Sensor is 0 and the time None.
    """

    WRAP_US: ClassVar[int] = 1 << 64

    def __init__(self, order: str = "zxy", clockwise: bool = True) -> None:
        """Start with nothing seen.

        Args:
            order: with a, b, c for the frame's first, second and third angle, the rotation is
                "zxy": Rz(a) Rx(b) Ry(c);
                "zyx": Rz(a) Ry(b) Rx(c), what the data sheet's names say;
                "zyx-swapped": Rz(a) Ry(c) Rx(b).
            clockwise: the first angle grows when the sensor is turned clockwise, seen from above, as
                a compass does.

        Raises:
            ValueError: order is not one of ORDERS.
        """
        self.counters = Counters()
        self._order = _checked(order)
        self._yaw_half = -_HALF if clockwise else _HALF
        self._rest = b""
        self._bad = False
        self._text = b""  # what stood between two frames, as long as it is text
        self._index: int | None = None

    def feed(self, data: bytes) -> list[Sample]:
        """Samples completed by the next bytes of the stream, in the order they came."""
        self.counters.bytes += len(data)
        data = self._rest + data if self._rest else data
        samples = []
        at, end = 0, len(data)
        while True:
            start = data.find(_HEADER, at)
            if start < 0:
                # The last byte may be the first half of a header.
                start = end - (data[at:].endswith(b"\xaa"))
                self._skip(data[at:start])
                break
            if start > at:
                self._skip(data[at:start])
                at = start
            if end - start < FRAME_BYTES:
                break
            sample = self._frame(data[start : start + FRAME_BYTES])
            if sample is None:
                # AA AA also occurs inside frames: go on one byte later.
                self._skip(data[start : start + 1])
                at = start + 1
            else:
                samples.append(sample)
                at = start + FRAME_BYTES
        self._rest = data[start:]
        return samples

    def _skip(self, junk: bytes) -> None:
        if junk:
            if not self._bad:
                self._bad = True
                self.counters.bad += 1
            self._text = (self._text + junk)[-_MAX_TEXT:]

    def _frame(self, frame: bytes) -> Sample | None:
        if sum(frame[2:18]) & 0xFF != frame[18]:
            return None
        index, a, b, c, x, y, z = _FRAME.unpack(frame)
        if not (-18000 <= a <= 18000 and -18000 <= b <= 18000 and -18000 <= c <= 18000):
            return None
        if self._bad:
            self._bad = False
            self.counters.resyncs += 1
        if self._index is not None:
            # The sensor greets with lines of text when it starts.
            if b"%" in self._text and self._text.isascii():
                self.counters.restarts += 1
            elif index != self._index:
                # The same index again is a device that does not count.
                self.counters.lost += (index - self._index - 1) & 0xFF
        self._index = index
        self._text = b""
        self.counters.packets += 1
        return Sample(
            0,
            None,
            _quaternion(a * self._yaw_half, b * _HALF, c * _HALF, self._order),
            (x * _MG, y * _MG, z * _MG),
        )


def _checked(order: str) -> str:
    if order not in ORDERS:
        raise ValueError(f"order must be one of {', '.join(ORDERS)}, not {order!r}")
    return order


def _quaternion(a: float, b: float, c: float, order: str) -> Quaternion:
    """Of half angles, radians."""
    ca, sa = cos(a), sin(a)
    if order == "zxy":
        cx, sx, cy, sy = cos(b), sin(b), cos(c), sin(c)
        return (
            ca * cx * cy - sa * sx * sy,
            ca * sx * cy - sa * cx * sy,
            ca * cx * sy + sa * sx * cy,
            sa * cx * cy + ca * sx * sy,
        )
    if order == "zyx":
        b, c = c, b
    return rotation.from_yaw_pitch_roll(2 * a, 2 * c, 2 * b)


def encode(sample: Sample, index: int, *, order: str = "zxy", clockwise: bool = True) -> bytes:
    """The frame of a sample; index counts frames and wraps at 256.

    Raises:
        ValueError: the sample has no orientation or no specific force, or a value cannot be sent.
    """
    if sample.quat is None or sample.acc is None:
        raise ValueError("a frame has both orientation and specific force")
    if _checked(order) == "zxy":
        # Turned by 90 degrees about Z: X becomes Y, Y becomes -X.
        w, x, y, z = sample.quat
        a, b, c = rotation.to_yaw_pitch_roll((w, -y, x, z))
        c = -c
    else:
        a, c, b = rotation.to_yaw_pitch_roll(sample.quat)
        if order == "zyx":
            b, c = c, b
    angles = [round(100 * degrees(angle)) for angle in (-a if clockwise else a, b, c)]
    try:
        force = [min(max(round(x / _MG), -32768), 32767) for x in sample.acc]
    except (ValueError, OverflowError):
        raise ValueError(f"cannot send {sample}") from None
    body = struct.pack("<B6h3x", index & 0xFF, *angles, *force)
    return _HEADER + body + bytes([sum(body) & 0xFF])
