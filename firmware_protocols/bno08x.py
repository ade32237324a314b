"""BNO08x in UART-RVC mode: 19 bytes, 100 times a second, with three angles and the specific force.

The layout, and the reasons for reading the angles as they are read here, are in docs/bno08x.md. There is no
time and no angular rate. The heading starts at 0 at power-up, so every sensor has its own zero.
"""

from __future__ import annotations

import re
import struct
from math import degrees, radians

from firmware_protocols import rotation
from firmware_protocols._numbers import int16
from firmware_protocols._sequence import count_byte
from firmware_protocols._stream import StreamDecoder
from firmware_protocols.base import Protocol
from firmware_protocols.sample import STANDARD_G, Quaternion, Sample

FRAME_BYTES = 19
"""Bytes of a frame, header and checksum included."""

ORDERS = ("zxy", "zyx", "zyx-swapped")
"""Orders in which the three angles combine into a rotation, see `Bno08xDecoder`."""

_HEADER = b"\xaa\xaa"
_FRAME = struct.Struct("<xxB6h3xx")
_STEP = radians(0.01)
_MG = STANDARD_G / 1000
_MAX_TEXT = 256


class Bno08xDecoder(StreamDecoder):
    """Decoder for the byte stream of one device; sensor is 0, the time None."""

    WRAP_US = 1 << 64

    _START = re.compile(rb"\xaa(?:\xaa|\Z)")

    def __init__(self, order: str = "zxy", clockwise: bool = True) -> None:
        """Create the decoder.

        Args:
            order: the rotation, where a, b and c are the first, second and third angle of a frame:
                "zxy": Rz(a) Rx(b) Ry(c);
                "zyx": Rz(a) Ry(b) Rx(c), as the names in the data sheet suggest;
                "zyx-swapped": Rz(a) Ry(c) Rx(b).
            clockwise: whether the first angle grows clockwise, seen from above, like that of a compass.

        Raises:
            ValueError: order is not one of ORDERS.
        """
        super().__init__()
        self._order = _checked(order)
        self._yaw_step = -_STEP if clockwise else _STEP
        self._text = b""  # text between two frames
        self._index: int | None = None

    def _length(self, buffer: bytes, at: int) -> int:
        return FRAME_BYTES

    def _intact(self, buffer: bytes, at: int, length: int) -> bool:
        _, a, b, c, *_ = _FRAME.unpack_from(buffer, at)
        return (
            sum(buffer[at + 2 : at + 18]) & 0xFF == buffer[at + 18]
            and -18000 <= a <= 18000
            and -18000 <= b <= 18000
            and -18000 <= c <= 18000
        )

    def _message(self, frame: bytes, samples: list[Sample]) -> None:
        index, a, b, c, x, y, z = _FRAME.unpack(frame)
        # The sensor sends lines of text when it starts.
        if self._index is not None and b"%" in self._text and self._text.isascii():
            self.counters.restarts += 1
        else:
            count_byte(self.counters, self._index, index)
        self._index = index
        self._text = b""
        quat = _quaternion(a * self._yaw_step, b * _STEP, c * _STEP, self._order)
        self._emit(Sample(0, None, quat, (x * _MG, y * _MG, z * _MG)), samples)

    def _bad_frame(self, start: int, end: int) -> None:
        self._text = _HEADER  # not ASCII, hence no restart message
        super()._bad_frame(start, end)

    def _noise(self, data: bytes, start: int) -> None:
        self._text = (self._text + data)[-_MAX_TEXT:]
        super()._noise(data, start)


def _checked(order: str) -> str:
    if order not in ORDERS:
        raise ValueError(f"order must be one of {', '.join(ORDERS)}, not {order!r}")
    return order


def _quaternion(a: float, b: float, c: float, order: str) -> Quaternion:
    """Return the quaternion of three angles, radians."""
    if order == "zxy":
        # Rotated by 90 degrees about Z: Y becomes X, X becomes -Y.
        w, x, y, z = rotation.from_yaw_pitch_roll(a, -b, c)
        return (w, -y, x, z)
    if order == "zyx":
        b, c = c, b
    return rotation.from_yaw_pitch_roll(a, c, b)


def encode(sample: Sample, index: int, *, order: str = "zxy", clockwise: bool = True) -> bytes:
    """Return the frame of a sample; index counts frames and wraps at 256.

    Raises:
        ValueError: the sample has no orientation or no specific force, or a value cannot be sent.
    """
    if sample.quat is None or sample.acc is None:
        raise ValueError("a frame needs both orientation and specific force")
    if _checked(order) == "zxy":
        # Rotated by 90 degrees about Z: X becomes Y, Y becomes -X.
        w, x, y, z = sample.quat
        a, b, c = rotation.to_yaw_pitch_roll((w, -y, x, z))
        c = -c
    else:
        a, c, b = rotation.to_yaw_pitch_roll(sample.quat)
        if order == "zyx":
            b, c = c, b
    angles = [round(100 * degrees(angle)) for angle in (-a if clockwise else a, b, c)]
    force = [int16(x / _MG) for x in sample.acc]
    body = struct.pack("<B6h3x", index & 0xFF, *angles, *force)
    return _HEADER + body + bytes([sum(body) & 0xFF])


PROTOCOL = Protocol(
    name="bno08x-rvc",
    transport="bytes",
    default_bitrate=115200,
    description="BNO08x in UART-RVC mode",
    decoder=Bno08xDecoder,
    encoder=lambda: encode,
    single_device=True,
    common_heading=False,
    lacks=("time",),
    page="bno08x",
)
