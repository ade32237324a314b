"""SAE J1939 Slope Sensor Information 2 (PGN 61481): pitch and roll of a machine's inclinometer.

The layout is in docs/j1939.md. The message has no heading, and without one there is no orientation. So this
module has no decoder of samples: it returns the angles only.
"""

from __future__ import annotations

from math import degrees, radians
from typing import NamedTuple

SSI2 = 61481
"""Parameter group number of the message."""

_STEPS = 32768  # steps of an angle per degree
_OFFSET_DEG = 250.0
_LATENCY_STEP_S = 0.0005
_MAX_ANGLE, _MAX_LATENCY = 0xFAFFFF, 0xFA  # larger numbers mean an error or no value


class Tilt(NamedTuple):
    """Angles of one source address.

    Attributes:
        source: address of the sensor, 0 to 253.
        pitch: rad; None if the sensor reports an error or no value.
        roll: rad; None likewise.
        latency_s: age of the angles when they were sent, seconds; None likewise.
    """

    source: int
    pitch: float | None
    roll: float | None
    latency_s: float | None


def tilt(can_id: int, data: bytes, extended: bool = True) -> Tilt | None:
    """Return the angles of a CAN frame; None if it is not an SSI2 message."""
    source = can_id & 0xFF
    if not extended or can_id >> 8 & 0x3FFFF != SSI2 or source > 253 or len(data) != 8:
        return None
    latency = data[7]
    return Tilt(
        source,
        _angle(data[0:3]),
        _angle(data[3:6]),
        latency * _LATENCY_STEP_S if latency <= _MAX_LATENCY else None,
    )


def encode(message: Tilt, priority: int = 3) -> tuple[int, bytes]:
    """Return identifier (29 bits) and data of the frame; unknown values are sent as not available."""
    latency = 0xFF if message.latency_s is None else round(message.latency_s / _LATENCY_STEP_S)
    if not 0 <= message.source <= 253 or not 0 <= latency <= 0xFF or not 0 <= priority <= 7:
        raise ValueError(f"cannot send {message} with priority {priority}")
    # The seventh byte, quality of the angles, is sent as not available.
    data = _raw(message.pitch) + _raw(message.roll) + bytes([0xFF, latency])
    return priority << 26 | SSI2 << 8 | message.source, data


def _angle(data: bytes) -> float | None:
    raw = int.from_bytes(data, "little")
    return radians(raw / _STEPS - _OFFSET_DEG) if raw <= _MAX_ANGLE else None


def _raw(angle: float | None) -> bytes:
    if angle is None:
        return b"\xff\xff\xff"
    raw = round((degrees(angle) + _OFFSET_DEG) * _STEPS)
    if not 0 <= raw <= _MAX_ANGLE:
        raise ValueError(f"an angle must be from -250 to 252 degrees, not {degrees(angle):g}")
    return raw.to_bytes(3, "little")
