"""WitMotion standard protocol on a serial line: packets of 11 bytes that hold one quantity each.

Layouts are in docs/witmotion.md. Everything is little-endian.
"""

from __future__ import annotations

import re
import struct
from typing import Any

from firmware_protocols._numbers import int16
from firmware_protocols._stream import StreamDecoder
from firmware_protocols._witmotion_cycle import (
    ACC,
    ACC_STEP,
    ANGLES,
    DAY_US,
    GYR,
    GYR_STEP,
    MAG,
    QUAT,
    QUAT_STEP,
    REGISTERS,
    TIME,
    Cycle,
    angles_of,
    scaled,
    steps_of,
    vectors_of,
)
from firmware_protocols.base import Protocol, uncounted
from firmware_protocols.sample import Sample, unit_quaternion

_SIZE = 11
_WORDS = struct.Struct("<4h")


class WitDecoder(StreamDecoder):
    """Decoder for a serial stream of the standard protocol: one sensor, `sensor` is always 0.

    The orientation is that of the quaternion packet, or else the angles as Rz(yaw) Ry(pitch) Rx(roll). The
    time is the time of day on the device's clock.

    Attributes:
        counters: counts of everything decoded so far; `lost` counts incomplete cycles.
    """

    WRAP_US = DAY_US
    _START = re.compile(rb"\x55(?:[\x50-\x5a\x5f]|\Z)")

    def __init__(self, *, mag_ut: float = 1.0) -> None:
        """Create the decoder.

        Args:
            mag_ut: microtesla per step of the magnetic field, which depends on the model. With 1 the field
                is in steps.
        """
        super().__init__()
        self._cycle = Cycle(0, self.counters)
        self._mag_ut = mag_ut
        self._pending: list[Sample] = []

    def feed(self, data: bytes) -> list[Sample]:
        """Return the samples completed by the next bytes of the stream, in order of arrival."""
        samples = super().feed(data)
        samples += self._pending
        self._pending = []
        return samples

    def _length(self, buffer: bytes, at: int) -> int:
        return _SIZE

    def _intact(self, buffer: bytes, at: int, length: int) -> bool:
        return sum(buffer[at : at + _SIZE - 1]) & 0xFF == buffer[at + _SIZE - 1]

    def _message(self, frame: bytes, samples: list[Sample]) -> None:
        samples += self._pending
        self._pending = []
        kind = frame[1]
        if kind == REGISTERS:  # an answer can come anywhere in the cycle
            self.counters.skipped += 1
            return
        w, x, y, z = words = _WORDS.unpack_from(frame, 2)
        values: dict[str, Any]
        if kind == ACC:
            values = {"acc": scaled((w, x, y), ACC_STEP), "temperature": z / 100}
        elif kind == GYR:
            values = {"gyr": scaled((w, x, y), GYR_STEP)}
        elif kind == ANGLES:
            values = angles_of((w, x, y))
        elif kind == MAG:
            values = {"mag": scaled((w, x, y), self._mag_ut)}
        elif kind == QUAT:
            quat = unit_quaternion(*(value * QUAT_STEP for value in words))
            if quat is None:
                self.counters.bad += 1
                self._cycle.drop(kind)
                return
            values = {"quat": quat}
        elif kind == TIME:
            values = {"time_us": _time_of_day(frame)}
        else:
            values = {}
        samples += self._cycle.add(kind, values)

    def _bad_frame(self, start: int, end: int) -> None:
        self._cut()
        super()._bad_frame(start, end)

    def _noise(self, data: bytes, start: int) -> None:
        self._cut()
        super()._noise(data, start)

    def _cut(self) -> None:
        if self._in_sync:
            self._pending += self._cycle.cut()


def _time_of_day(frame: bytes) -> int | None:
    hours, minutes, seconds, ms = struct.unpack_from("<BBBH", frame, 5)
    if hours > 23 or minutes > 59 or seconds > 59 or ms > 999:
        return None
    return (((hours * 60 + minutes) * 60 + seconds) * 1000 + ms) * 1000


def encode(sample: Sample, *, angles: bool = False, mag_ut: float = 1.0) -> bytes:
    """Return the serial packets of one cycle, with the quantities that the sample has.

    Args:
        sample: its time is sent as a time of day.
        angles: send Euler angles, as new devices do, instead of the quaternion.
        mag_ut: microtesla per step of the magnetic field.
    """
    out = b""
    if sample.time_us is not None:
        seconds, us = divmod(sample.time_us % DAY_US, 1_000_000)
        hours, minutes = seconds // 3600, seconds // 60 % 60
        out += _packet(TIME, struct.pack("<6BH", 26, 1, 1, hours, minutes, seconds % 60, us // 1000))
    temperature = int16((sample.temperature or 0) * 100)
    for kind, values, step in vectors_of(sample, mag_ut, angles):
        out += _packet(kind, _WORDS.pack(*steps_of(values, step), temperature if kind == ACC else 0))
    if sample.quat is not None and not angles:
        out += _packet(QUAT, _WORDS.pack(*steps_of(sample.quat, QUAT_STEP)))
    return out


def _packet(kind: int, data: bytes) -> bytes:
    body = bytes([0x55, kind]) + data
    return body + bytes([sum(body) & 0xFF])


PROTOCOL = Protocol(
    name="witmotion",
    transport="bytes",
    default_bitrate=9600,
    description="WitMotion standard protocol: WT61, WT901, HWT901B, HWT905",
    decoder=WitDecoder,
    encoder=uncounted(encode),
    single_device=True,
    setup="quaternion and time as well, at 100 Hz and 115200 baud or more",
)
