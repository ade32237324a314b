"""The native packet of self-built sensors: message bodies, without checksum and framing.

Layouts are in README.md next to this file; `c/edgepose_packet.h` is the encoder for firmware. Everything is
little-endian.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from math import floor, isfinite
from typing import NamedTuple

from firmware_protocols._numbers import LARGEST, plausible
from firmware_protocols.sample import Quaternion, Sample, Vector3, unit_quaternion

DATA_TYPE = 0x11
"""First body byte of a measurement: version 1 in the high half, type 1 in the low half."""

INFO_TYPE = 0x12
"""First body byte of a description of a sensor: version 1, type 2."""

FRAMES = ("unknown", "ENU", "NWU", "NED", "Z-up")
"""Inertial frames of quaternions; the index is the code on the wire. "Z-up" has an arbitrary heading."""

MAX_FIRMWARE = 32
"""Longest firmware string of an INFO packet, bytes."""

MAX_BODY = 66
"""Longest body, bytes: header and all blocks, with vectors as floats."""

QUAT_SCALE, ACC_SCALE, GYR_SCALE, MAG_SCALE, TEMPERATURE_SCALE = 32767, 100, 900, 10, 100
"""Steps of an int16 per unit: 1, m/s^2, rad/s, uT, degC."""


class Packet(NamedTuple):
    """One measurement as it is sent: a Sample and a sequence number. Absent quantities are None.

    Attributes:
        sensor_id: 0..255.
        seq: counter of this sensor's packets, wraps at 65536.
        t_us: device clock at the measurement, microseconds, wraps at 2^32.
        quat: unit quaternion w, x, y, z, sensor to inertial frame.
        acc: specific force, m/s^2.
        gyr: angular rate, rad/s.
        mag: magnetic field, uT.
        temperature: degC.
        battery: charge in percent (0..100) and eight status bits, which the device defines.
    """

    sensor_id: int
    seq: int
    t_us: int
    quat: Quaternion | None = None
    acc: Vector3 | None = None
    gyr: Vector3 | None = None
    mag: Vector3 | None = None
    temperature: float | None = None
    battery: tuple[int, int] | None = None


def packet_of(sample: Sample, seq: int) -> Packet:
    """Return the packet of a sample with sequence number `seq`; a missing time is sent as 0."""
    time_us = (sample.time_us or 0) & 0xFFFFFFFF
    return Packet(sample.sensor, seq & 0xFFFF, time_us, *sample[2:])


class Info(NamedTuple):
    """A sensor's description of itself, sent every few seconds.

    Attributes:
        sensor_id: 0..255.
        firmware: name and version, printable ASCII, at most MAX_FIRMWARE characters.
        segment: SMPL joint (0..23) whose bone carries the sensor; None if the device does not know.
        frame: inertial frame of its quaternions, one of FRAMES.
        rate_hz: packets per second, steps of 0.1 up to 6553.5; 0 if unknown.
    """

    sensor_id: int
    firmware: str
    segment: int | None = None
    frame: str = "unknown"
    rate_hz: float = 0.0


_HEADER = "<BBHHI"
_INFO = struct.Struct("<BBBBHB")

_QUAT, _ACC, _GYR, _MAG = 0x001, 0x002, 0x004, 0x008
_TEMPERATURE = 0x010
_QUAT_F, _ACC_F, _GYR_F, _MAG_F = 0x020, 0x040, 0x080, 0x100
_BATTERY = 0x200

_NO_SEGMENT = 255

_BLOCKS = ("4h", "3h", "3h", "3h", "h", "4f", "3f", "3f", "3f", "BB")  # in the order of the mask bits

# 324 masks are legal: known bits only, and no quantity in both forms.
_LAYOUTS = {
    mask: struct.Struct(_HEADER + "".join(block for bit, block in enumerate(_BLOCKS) if mask >> bit & 1))
    for mask in range(1 << len(_BLOCKS))
    if not mask & mask >> 5 & 0xF
}


def fixed(values: Iterable[float], scale: int) -> list[int]:
    """Return values times scale as int16: rounded to nearest, halves away from zero, clamped.

    Raises:
        ValueError: a value is NaN or infinite.
    """
    result = []
    for value in values:
        if not isfinite(value):
            raise ValueError(f"cannot send {value}")
        # Firmware has binary32 floats: round to binary32 first, so that both sides round the same ties. The
        # product with the scale has at most 39 bits and is exact here; the clamp keeps huge values in range.
        (single,) = struct.unpack("<f", struct.pack("<f", min(max(value, -1e6), 1e6)))
        size = floor(abs(single) * scale + 0.5)
        result.append(min(size, 32767) if single > 0 else -min(size, 32768))
    return result


def _finite(values: Iterable[float]) -> list[float]:
    values = list(values)
    if not all(map(isfinite, values)):
        raise ValueError(f"cannot send {values}")
    return values


def encode_body(packet: Packet, *, floats: bool = False) -> bytes:
    """Return the body of a measurement, without CRC and framing.

    Args:
        packet: quantities are clamped to the range of int16, a battery charge to 0..100.
        floats: send vectors and quaternion as binary32 instead of int16.

    Raises:
        ValueError: a quantity is NaN, infinite or too large for binary32, or an integer does not fit.
    """
    mask = 0
    values: list[float] = []
    tail: list[float] = []
    for bit, scale, vector in (
        (_QUAT, QUAT_SCALE, packet.quat),
        (_ACC, ACC_SCALE, packet.acc),
        (_GYR, GYR_SCALE, packet.gyr),
        (_MAG, MAG_SCALE, packet.mag),
    ):
        if vector is None:
            continue
        if floats:
            mask |= bit << 5
            tail += _finite(vector)
        else:
            mask |= bit
            values += fixed(vector, scale)
    if packet.temperature is not None:
        mask |= _TEMPERATURE
        values += fixed([packet.temperature], TEMPERATURE_SCALE)
    if packet.battery is not None:
        percent, status = packet.battery
        mask |= _BATTERY
        tail += [min(max(percent, 0), 100), status]
    try:
        return _LAYOUTS[mask].pack(DATA_TYPE, packet.sensor_id, mask, packet.seq, packet.t_us, *values, *tail)
    except (struct.error, OverflowError) as error:
        raise ValueError(f"cannot send {packet}: {error}") from None


def encode_info_body(info: Info) -> bytes:
    """Return the body of an INFO packet, without CRC and framing.

    Raises:
        ValueError: a field is outside the range given in `Info`.
    """
    if not _is_text(info.firmware.encode("utf-8")):
        raise ValueError(
            f"firmware must be printable ASCII of at most {MAX_FIRMWARE} characters, not {info.firmware!r}"
        )
    if info.segment is not None and not 0 <= info.segment < 24:
        raise ValueError(f"segment must be an SMPL joint from 0 to 23, not {info.segment}")
    if info.frame not in FRAMES:
        raise ValueError(f"frame must be one of {', '.join(FRAMES)}, not {info.frame!r}")
    if not 0 <= info.rate_hz <= 6553.5:
        raise ValueError(f"rate_hz must be from 0 to 6553.5, not {info.rate_hz}")
    segment = _NO_SEGMENT if info.segment is None else info.segment
    firmware = info.firmware.encode("ascii")
    try:
        head = _INFO.pack(
            INFO_TYPE,
            info.sensor_id,
            segment,
            FRAMES.index(info.frame),
            floor(info.rate_hz * 10 + 0.5),
            len(firmware),
        )
    except struct.error as error:
        raise ValueError(f"cannot send {info}: {error}") from None
    return head + firmware


def body_size(data: bytes) -> int:
    """Return the length of the body at the start of data, from its own fields.

    Raises:
        ValueError: unknown version, type or mask bits, or too few bytes to tell.
    """
    if len(data) >= _INFO.size:
        if data[0] == INFO_TYPE:
            return _INFO.size + data[_INFO.size - 1]
        layout = _LAYOUTS.get(data[2] | data[3] << 8)
        if data[0] == DATA_TYPE and layout is not None:
            return layout.size
    raise ValueError("unknown version, type or field mask")


def decode_body(body: bytes) -> Packet | Info:
    """Return the message in a body without CRC and framing. Quaternions are normalised.

    Raises:
        ValueError: unknown version, type or mask bits, wrong length, or impossible values.
    """
    kind = body[0] if body else None
    if kind == DATA_TYPE:
        return _decode_packet(body)
    if kind == INFO_TYPE:
        return _decode_info(body)
    raise ValueError("unknown version or type")


def _decode_packet(body: bytes) -> Packet:
    mask = body[2] | body[3] << 8 if len(body) > 3 else -1
    layout = _LAYOUTS.get(mask)
    if layout is None:
        raise ValueError("unknown field mask")
    if layout.size != len(body):
        raise ValueError("length does not fit the field mask")
    v = layout.unpack(body)
    quat: Quaternion | None = None
    acc: Vector3 | None = None
    gyr: Vector3 | None = None
    mag: Vector3 | None = None
    temperature: float | None = None
    battery: tuple[int, int] | None = None
    i = 5  # after the header
    if mask & _QUAT:
        w, x, y, z = v[5:9]
        quat = unit_quaternion(w / QUAT_SCALE, x / QUAT_SCALE, y / QUAT_SCALE, z / QUAT_SCALE)
        i = 9
    if mask & _ACC:
        acc = (v[i] / ACC_SCALE, v[i + 1] / ACC_SCALE, v[i + 2] / ACC_SCALE)
        i += 3
    if mask & _GYR:
        gyr = (v[i] / GYR_SCALE, v[i + 1] / GYR_SCALE, v[i + 2] / GYR_SCALE)
        i += 3
    if mask & _MAG:
        mag = (v[i] / MAG_SCALE, v[i + 1] / MAG_SCALE, v[i + 2] / MAG_SCALE)
        i += 3
    if mask & _TEMPERATURE:
        temperature = v[i] / TEMPERATURE_SCALE
        i += 1
    if mask & (_QUAT_F | _ACC_F | _GYR_F | _MAG_F):
        if not plausible(v[i:]):
            raise ValueError(f"NaN, infinity, or more than {LARGEST:.0f}")
        if mask & _QUAT_F:
            quat = unit_quaternion(v[i], v[i + 1], v[i + 2], v[i + 3])
            i += 4
        if mask & _ACC_F:
            acc = v[i : i + 3]
            i += 3
        if mask & _GYR_F:
            gyr = v[i : i + 3]
            i += 3
        if mask & _MAG_F:
            mag = v[i : i + 3]
            i += 3
    if mask & _BATTERY:
        battery = v[i:]
        if v[i] > 100:
            raise ValueError("battery above 100 percent")
    if quat is None and mask & (_QUAT | _QUAT_F):
        raise ValueError("quaternion is not of unit length")
    return Packet(v[1], v[3], v[4], quat, acc, gyr, mag, temperature, battery)


def _decode_info(body: bytes) -> Info:
    if len(body) < _INFO.size:
        raise ValueError("INFO packet is too short")
    _, sensor_id, segment, frame, rate, length = _INFO.unpack_from(body)
    firmware = body[_INFO.size :]
    if len(firmware) != length or not _is_text(firmware):
        raise ValueError("bad firmware string")
    if frame >= len(FRAMES) or (segment >= 24 and segment != _NO_SEGMENT):
        raise ValueError("unknown frame or segment")
    return Info(
        sensor_id,
        firmware.decode("ascii"),
        None if segment == _NO_SEGMENT else segment,
        FRAMES[frame],
        rate / 10,
    )


def _is_text(text: bytes) -> bool:
    # Printable characters only: the string is shown on terminals and in logs.
    return len(text) <= MAX_FIRMWARE and all(0x20 <= byte <= 0x7E for byte in text)
