"""MicroStrain MIP (3DM-GX, CV and CX series): packets of the sensor (0x80) and filter (0x82) data sets.

Layouts are in docs/mip.md. Numbers are big-endian.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Iterator
from itertools import accumulate

from firmware_protocols._numbers import number, vector
from firmware_protocols._sequence import MAX_PAUSE_US
from firmware_protocols._stream import StreamDecoder
from firmware_protocols.base import Protocol, uncounted
from firmware_protocols.rotation import from_angles, from_matrix, to_yaw_pitch_roll
from firmware_protocols.sample import STANDARD_G, Sample, unit_quaternion, z_up

SENSOR_SET = 0x80
"""Descriptor set of the IMU, with an attitude of its own."""

FILTER_SET = 0x82
"""Descriptor set of the estimation filter."""

_GAUSS_UT = 100.0
_WEEK_US = 604_800_000_000
_MIN_PERIOD_NS = 100_000  # no device measures faster

_VECTOR = struct.Struct(">3f")
_QUATERNION = struct.Struct(">4f")
_MATRIX = struct.Struct(">9f")
_VECTOR_VALID = struct.Struct(">3fH")
_QUATERNION_VALID = struct.Struct(">4fH")
_MATRIX_VALID = struct.Struct(">9fH")
_NANOSECONDS = struct.Struct(">Q")
_GPS_TIME = struct.Struct(">dHH")

# Quantity and layout of a field, by descriptor set << 8 | field descriptor.
_FIELDS = {
    0x8004: ("acc g", _VECTOR),
    0x8005: ("gyr", _VECTOR),
    0x8006: ("mag", _VECTOR),
    0x8009: ("matrix", _MATRIX),
    0x800A: ("quat", _QUATERNION),
    0x800C: ("euler", _VECTOR),
    0x8012: ("gps time", _GPS_TIME),
    0x8014: ("temperature", _VECTOR),
    0x80D5: ("time", _NANOSECONDS),
    0x80D6: ("period", _NANOSECONDS),
    0x8203: ("quat", _QUATERNION_VALID),
    0x8204: ("matrix", _MATRIX_VALID),
    0x8205: ("euler", _VECTOR_VALID),
    0x820E: ("gyr", _VECTOR_VALID),
    0x8211: ("gps time", _GPS_TIME),
    0x821C: ("acc", _VECTOR_VALID),
    0x8227: ("mag", _VECTOR_VALID),
    0x82D5: ("time", _NANOSECONDS),
    0x82D6: ("period", _NANOSECONDS),
}


def checksum(data: bytes) -> bytes:
    """Return the Fletcher checksum with 8 bit sums that ends every packet."""
    sums = list(accumulate(data))
    return bytes([sums[-1] & 0xFF, sum(sums) & 0xFF]) if sums else b"\0\0"


def fields(packet: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield descriptor and data of each field of a complete packet.

    Raises:
        ValueError: the fields do not fill the payload.
    """
    at, end = 4, len(packet) - 2
    while at < end:
        size = packet[at]
        if size < 2 or at + size > end:
            raise ValueError("fields do not fill the payload")
        yield packet[at + 1], packet[at + 2 : at + size]
        at += size


class MipDecoder(StreamDecoder):
    """Decoder for the MIP stream of one device.

    Each packet with at least one quantity becomes a sample. The device's attitude maps its frame to north,
    east, down; samples have it with Z up.
    """

    # 64 bits of nanoseconds: 584 years.
    WRAP_US = (1 << 64) // 1000

    _START = re.compile(rb"u(?:e|\Z)")

    def __init__(self, sets: Iterable[int] = (SENSOR_SET, FILTER_SET)) -> None:
        """Create the decoder.

        Args:
            sets: descriptor sets to read. A device may send an attitude in both, from two filters that can
                disagree: choose one then.

        Raises:
            ValueError: unknown descriptor set.
        """
        super().__init__()
        self._sets = frozenset(sets)
        if not self._sets <= {SENSOR_SET, FILTER_SET}:
            raise ValueError("sets may contain 0x80 and 0x82 only")
        self._last_ns: dict[int, int] = {}

    def _length(self, buffer: bytes, at: int) -> int:
        return buffer[at + 3] + 6 if at + 3 < len(buffer) else 0

    def _possible(self, buffer: bytes, at: int, length: int) -> bool:
        # The fields of a false packet rarely fit, which shows before the packet is complete.
        offset, end = at + 4, at + length - 2
        while length and offset < len(buffer) and offset < end:
            if buffer[offset] < 2:
                return False
            offset += buffer[offset]
        return not length or offset <= end

    def _intact(self, buffer: bytes, at: int, length: int) -> bool | None:
        offset, end = at + 4, at + length - 2
        while offset < end:
            if buffer[offset] < 2:
                return None
            offset += buffer[offset]
        return checksum(buffer[at:end]) == buffer[end : end + 2] if offset == end else None

    def _message(self, frame: bytes, samples: list[Sample]) -> None:
        descriptor = frame[2]
        if descriptor not in self._sets:
            self.counters.skipped += 1
            return
        sample = self._sample(frame, descriptor)
        if sample is None:
            self.counters.bad += 1
        else:
            self._emit(sample, samples)

    def _sample(self, frame: bytes, descriptor: int) -> Sample | None:
        """Return the sample of a packet; None if a field has the wrong length."""
        time_ns = period_ns = gps_us = temperature = quat = matrix = euler = acc = gyr = mag = None
        at, end = 4, len(frame) - 2
        set_bits = descriptor << 8
        while at < end:
            start = at + 2
            name, layout = _FIELDS.get(set_bits | frame[at + 1], ("", None))
            at += frame[at]
            if layout is None:
                continue
            if layout.size != at - start:
                return None
            values = layout.unpack_from(frame, start)
            if descriptor == FILTER_SET and layout in _WITH_FLAGS:
                if not values[-1]:  # the filter has no estimate yet
                    continue
                values = values[:-1]
            if name == "acc g":
                acc = vector(values, STANDARD_G)
            elif name == "acc":
                acc = vector(values)
            elif name == "gyr":
                gyr = vector(values)
            elif name == "mag":
                mag = vector(values, _GAUSS_UT)
            elif name == "quat":
                quat = unit_quaternion(*values)
            elif name == "euler":
                euler = from_angles(*values[::-1])
            elif name == "matrix":
                # The packet has NED -> device, row by row.
                matrix = from_matrix(values[0::3] + values[1::3] + values[2::3])
            elif name == "time":
                time_ns = values[0]
            elif name == "period":
                period_ns = values[0]
            elif name == "gps time":
                gps_us = _gps_us(values[0], values[1])
            else:
                temperature = number(values[2])  # minimum, maximum, mean
        time_us = gps_us
        if time_ns is not None:
            self._count(descriptor, time_ns, period_ns)
            time_us = time_ns // 1000
        quat = quat or matrix or euler
        return Sample(0, time_us, None if quat is None else z_up(quat), acc, gyr, mag, temperature)

    def _count(self, descriptor: int, time_ns: int, period_ns: int | None) -> None:
        # There is no counter, but packets can hold the time since the previous packet.
        pause = time_ns - self._last_ns.get(descriptor, time_ns)
        self._last_ns[descriptor] = time_ns
        if not 0 <= pause <= MAX_PAUSE_US * 1000:
            self.counters.restarts += 1
        elif period_ns is not None and period_ns >= _MIN_PERIOD_NS and pause > 1.5 * period_ns:
            self.counters.lost += round(pause / period_ns) - 1


_WITH_FLAGS = (_VECTOR_VALID, _QUATERNION_VALID, _MATRIX_VALID)


def _gps_us(seconds: float, week: int) -> int | None:
    """Return GPS time in microseconds; None if the second of the week is impossible."""
    # Before the receiver has the time, the value is wrong but runs on: up to 1e6 is accepted.
    return week * _WEEK_US + round(seconds * 1e6) if 0 <= seconds <= 1e6 else None


def encode_packet(descriptor: int, parts: Iterable[tuple[int, bytes]]) -> bytes:
    """Return the bytes of a packet; each part is a field descriptor and its data.

    Raises:
        ValueError: the payload is longer than 255 bytes.
    """
    payload = b"".join(bytes([len(data) + 2, field]) + data for field, data in parts)
    if len(payload) > 255:
        raise ValueError(f"payload of {len(payload)} bytes, at most 255 are allowed")
    head = b"ue" + bytes([descriptor, len(payload)]) + payload
    return head + checksum(head)


def encode(
    sample: Sample,
    *,
    descriptor: int = SENSOR_SET,
    period_us: int | None = None,
    euler: bool = False,
) -> bytes:
    """Return the bytes on the wire for a sample.

    Args:
        sample: its sensor id is not sent, its temperature in the sensor set only.
        descriptor: SENSOR_SET or FILTER_SET.
        period_us: time since the previous packet, for the detection of losses; None leaves it out.
        euler: send angles instead of a quaternion.

    Raises:
        ValueError: unknown descriptor set, or a number that does not fit.
    """
    if descriptor not in (SENSOR_SET, FILTER_SET):
        raise ValueError(f"descriptor must be 0x80 or 0x82, not 0x{descriptor:X}")
    filtered = descriptor == FILTER_SET
    valid = b"\0\1" if filtered else b""
    ned = None if sample.quat is None else z_up(sample.quat)
    parts: list[tuple[int, bytes]] = []
    try:
        if sample.time_us is not None:
            parts.append((0xD5, _NANOSECONDS.pack(sample.time_us * 1000)))
            if period_us is not None:
                parts.append((0xD6, _NANOSECONDS.pack(period_us * 1000)))
        if sample.acc is not None:
            scale = 1.0 if filtered else 1 / STANDARD_G
            parts.append((0x1C if filtered else 0x04, _VECTOR.pack(*(a * scale for a in sample.acc)) + valid))
        if sample.gyr is not None:
            parts.append((0x0E if filtered else 0x05, _VECTOR.pack(*sample.gyr) + valid))
        if sample.mag is not None:
            field = _VECTOR.pack(*(m / _GAUSS_UT for m in sample.mag))
            parts.append((0x27 if filtered else 0x06, field + valid))
        if ned is not None and euler:
            parts.append((0x05 if filtered else 0x0C, _VECTOR.pack(*to_yaw_pitch_roll(ned)[::-1]) + valid))
        elif ned is not None:
            parts.append((0x03 if filtered else 0x0A, _QUATERNION.pack(*ned) + valid))
        if sample.temperature is not None and not filtered:
            parts.append((0x14, _VECTOR.pack(*[sample.temperature] * 3)))
    except (struct.error, OverflowError) as error:
        raise ValueError(f"cannot send {sample}: {error}") from None
    return encode_packet(descriptor, parts)


PROTOCOL = Protocol(
    name="mip",
    transport="bytes",
    default_bitrate=115200,
    description="MicroStrain MIP: 3DM-GX, 3DM-CV",
    decoder=MipDecoder,
    encoder=uncounted(encode),
    single_device=True,
    setup="acceleration, rate, quaternion, reference time",
)
