"""HiPNUC: fields and conversions shared by the serial and the CAN formats.

Layouts are in docs/hipnuc.md. Everything is little-endian.
"""

from __future__ import annotations

import struct
from math import radians

from firmware_protocols._numbers import int16, number, vector
from firmware_protocols.sample import Quaternion, Sample, Vector3, unit_quaternion

WRAP_US = (1 << 32) * 1000
"""Sample times wrap here, microseconds: devices count milliseconds in 32 bits."""

DEG = radians(1.0)
"""One degree, rad."""

VECTOR_I = struct.Struct("<3h")
VECTOR_F = struct.Struct("<3f")
QUAT_I = struct.Struct("<4h")
QUAT_F = struct.Struct("<4f")

# Sizes in bytes of the fields of a 0x83 item, by bit of its mask. The sizes of other bits are unknown.
_FIELDS = dict(
    enumerate((12, 12, 12, 12, 16, 8, 8, 4, 4, 12, 12, 12, 12, 12, 24, 4, 4, 4, 4, 4))
) | {30: 24, 31: 12}  # fmt: skip
_TIME_BIT, _TEMPERATURE_BIT = 5, 8

NODE_BIT = 19
"""Mask bit of the field with the node id."""

MASK_83 = sum(1 << bit for bit in _FIELDS)
"""Mask bits whose fields have a known size."""


def unit(w: float, x: float, y: float, z: float) -> Quaternion:
    """Return the quaternion normalised to norm 1.

    Raises:
        ValueError: its norm is too far from 1.
    """
    quat = unit_quaternion(w, x, y, z)
    if quat is None:
        raise ValueError("quaternion is not of unit length")
    return quat


def scaled(values: tuple[float, ...], scale: float) -> Vector3:
    """Return a vector times a scale.

    Raises:
        ValueError: a value is not finite, or too large.
    """
    result = vector(values, scale)
    if result is None:
        raise ValueError("NaN, infinity, or too large")
    return result


def temperature_at(data: bytes, at: int) -> float:
    """Return the binary32 temperature at an offset, degC.

    Raises:
        ValueError: it is not finite, or too large.
    """
    value = number(struct.unpack_from("<f", data, at)[0])
    if value is None:
        raise ValueError("NaN, infinity, or too large")
    return value


def field_or_none(values: tuple[float, ...], scale: float) -> Vector3 | None:
    """Return a magnetic field times a scale; None for zeros, which devices without a magnetometer send."""
    field = scaled(values, scale)
    return field if any(field) else None


def fields_at(data: bytes, start: int, mask: int, sensor: int) -> tuple[Sample, int]:
    """Return the sample in the fields of a 0x83 item, and the offset of their end.

    Args:
        data: the item and what follows.
        start: offset of its first field.
        mask: which fields are present.
        sensor: sensor id of the sample, unless a field holds one.

    Raises:
        ValueError: too short for its mask, or an implausible value.
    """
    quat: Quaternion | None = None
    acc: Vector3 | None = None
    gyr: Vector3 | None = None
    mag: Vector3 | None = None
    time_us: int | None = None
    temperature: float | None = None
    at = start
    for bit, size in _FIELDS.items():
        if not mask >> bit & 1:
            continue
        if at + size > len(data):
            raise ValueError("too short for its mask")
        if bit == 0:
            acc = scaled(VECTOR_F.unpack_from(data, at), 1.0)
        elif bit == 1:
            gyr = scaled(VECTOR_F.unpack_from(data, at), 1.0)
        elif bit == 2:
            mag = field_or_none(VECTOR_F.unpack_from(data, at), 1.0)
        elif bit == 4:
            quat = unit(*QUAT_F.unpack_from(data, at))
        elif bit == _TIME_BIT:
            time_us = int.from_bytes(data[at : at + 8], "little") % WRAP_US
        elif bit == _TEMPERATURE_BIT:
            temperature = temperature_at(data, at)
        elif bit == NODE_BIT:
            sensor = data[at]
        at += size
    return Sample(sensor, time_us, quat, acc, gyr, mag, temperature), at


def write_fields(sample: Sample) -> tuple[int, bytes]:
    """Return mask and fields of a 0x83 item with the quantities that the sample has."""
    mask, out = 0, b""
    for bit, layout, values in (
        (0, "<3f", sample.acc),
        (1, "<3f", sample.gyr),
        (2, "<3f", sample.mag),
        (4, "<4f", sample.quat),
        (_TIME_BIT, "<Q", None if sample.time_us is None else (sample.time_us,)),
        (_TEMPERATURE_BIT, "<f", None if sample.temperature is None else (sample.temperature,)),
    ):
        if values is not None:
            mask |= 1 << bit
            out += struct.pack(layout, *values)
    return mask, out


def vector_i(values: Vector3, scale: float) -> bytes:
    """Return a vector times a scale as three int16."""
    return VECTOR_I.pack(*(int16(value * scale) for value in values))


def quat_i(quat: Quaternion) -> bytes:
    """Return a quaternion as four int16, steps of 0.0001."""
    return QUAT_I.pack(*(int16(value * 10000) for value in quat))
