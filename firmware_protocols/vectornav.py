"""VectorNav VN-100, VN-200 and VN-300: binary outputs and ASCII lines, which may be mixed.

Layouts are in docs/vectornav.md. Binary numbers are little-endian, the checksum is big-endian.
"""

from __future__ import annotations

import re
import struct
from binascii import crc_hqx
from functools import reduce
from math import degrees, radians
from operator import xor
from typing import NamedTuple

from firmware_protocols._numbers import number, vector
from firmware_protocols._stream import StreamDecoder
from firmware_protocols.base import Protocol, uncounted
from firmware_protocols.rotation import from_angles, to_yaw_pitch_roll
from firmware_protocols.sample import Quaternion, Sample, Vector3, unit_quaternion, z_up

_GAUSS_UT = 100.0

# Sizes in bytes of the fields of each group, from bit 0 up. Bit 15 means that another mask follows, for bits
# 16 and up.
_GNSS = (8, 8, 2, 1, 1, 24, 24, 12, 12, 12, 4, 4, 2, 28, 0, 0, 0, 2, 8)
_SIZES: dict[int, tuple[int, ...]] = {
    0: (8, 8, 8, 12, 16, 12, 24, 12, 12, 24, 20, 28, 2, 4, 8),  # common
    1: (8, 8, 8, 2, 8, 8, 8, 4, 4, 1),  # time
    2: (2, 12, 12, 12, 4, 4, 16, 12, 12, 12, 12, 2, 40),  # IMU
    3: _GNSS,
    4: (2, 12, 16, 36, 12, 12, 12, 12, 12, 12, 28, 24, 12, 4),  # attitude
    5: (2, 24, 24, 12, 12, 12, 12, 12, 12, 4, 4, 68, 64),  # INS
    6: _GNSS,
    12: _GNSS,
}

_MAX_GROUP_BYTES = 2
_MAX_PAYLOAD = 1024
_MAX_PLANS = 64

# Fields that become quantities of a sample, in order of preference: group, bit, name, offset, format.
_FIELDS: tuple[tuple[int, int, str, int, str], ...] = (
    (0, 0, "time", 0, "<Q"),
    (1, 0, "time", 0, "<Q"),
    (0, 4, "quat", 0, "<4f"),
    (4, 2, "quat", 0, "<4f"),
    (0, 3, "ypr", 0, "<3f"),
    (4, 1, "ypr", 0, "<3f"),
    (0, 8, "acc", 0, "<3f"),
    (2, 9, "acc", 0, "<3f"),
    (0, 9, "acc", 0, "<3f"),  # uncompensated
    (2, 2, "acc", 0, "<3f"),
    (0, 5, "gyr", 0, "<3f"),
    (2, 10, "gyr", 0, "<3f"),
    (0, 9, "gyr", 12, "<3f"),
    (2, 3, "gyr", 0, "<3f"),
    (0, 10, "mag", 0, "<3f"),
    (2, 8, "mag", 0, "<3f"),
    (2, 1, "mag", 0, "<3f"),
    (0, 10, "temperature", 12, "<f"),
    (2, 4, "temperature", 0, "<f"),
)

# "-" is a quantity that a sample does not have.
ASCII_LINES: dict[str, tuple[str, ...]] = {
    "VNYPR": ("ypr",),
    "VNQTN": ("quat",),
    "VNQTM": ("quat", "mag"),
    "VNQTA": ("quat", "acc"),
    "VNQTR": ("quat", "gyr"),
    "VNQMA": ("quat", "mag", "acc"),
    "VNQAR": ("quat", "acc", "gyr"),
    "VNQMR": ("quat", "mag", "acc", "gyr"),
    "VNYMR": ("ypr", "mag", "acc", "gyr"),
    "VNYBA": ("ypr", "-", "gyr"),  # acceleration without gravity
    "VNYIA": ("ypr", "-", "gyr"),  # acceleration without gravity, in NED
    "VNMAG": ("mag",),
    "VNACC": ("acc",),
    "VNGYR": ("gyr",),
    "VNMAR": ("mag", "acc", "gyr"),
    "VNIMU": ("mag", "acc", "gyr", "temperature"),
}
"""ASCII lines that are decoded, and their quantities in order."""

_LINE = re.compile(rb"\$VN[A-Z0-9]{3}[ -#%-)+-~]{0,250}\*(?:[0-9A-Fa-f]{2}){1,2}\r")
_PART_OF_LINE = re.compile(rb"\$(?:V(?:N(?:[ -#%-~]{0,260}\r?)?)?)?\Z")


class _Plan(NamedTuple):
    """Offsets of the quantities in binary outputs with the same header."""

    length: int
    parts: tuple[tuple[str, int, struct.Struct], ...]


class _Forms:
    """Quantities of the newest output in each form, to choose one of two that repeat each other."""

    _FORGOTTEN = 100
    """Outputs in one form after which the other one has been switched off."""

    def __init__(self) -> None:
        """Start without outputs."""
        self._names: dict[bool, frozenset[str]] = {}
        self._since = {False: 0, True: 0}

    def is_better(self, sample: Sample, binary: bool) -> bool:
        """Return whether the other form does not have all that a sample has."""
        own = frozenset(name for name in ("quat", "acc", "gyr") if getattr(sample, name) is not None)
        if not own:
            return True
        self._names[binary] = own
        self._since[binary] = 0
        self._since[not binary] += 1
        if self._since[not binary] > self._FORGOTTEN:
            self._names.pop(not binary, None)
        other = self._names.get(not binary, frozenset())
        return not (own < other or (own == other and not binary))


class VectorNavDecoder(StreamDecoder):
    """Decoder for the serial line of one device.

    Only samples of binary outputs with the time since start-up have a time. A device that sends both forms
    measures once: the form with fewer quantities, or the lines if both have the same, is skipped.
    """

    # 64 bits of nanoseconds: 584 years.
    WRAP_US = (1 << 64) // 1000

    _START = re.compile(rb"[\xfa$]")
    _PADDING = b"\r\n"

    def __init__(self) -> None:
        """Create the decoder."""
        super().__init__()
        self._plans: dict[bytes, _Plan | None] = {}  # by header; None: not an output
        self._current: _Plan | None = None  # of the output whose length was asked for last
        self._forms = _Forms()

    def _length(self, buffer: bytes, at: int) -> int:
        if buffer[at] == 0xFA:
            size = header_size(buffer, at)
            if size <= 0:
                return size
            self._current = self._plan(buffer[at : at + size])
            return self._current.length if self._current else -1
        line = _LINE.match(buffer, at)
        return line.end() - at if line else 0

    def _possible(self, buffer: bytes, at: int, length: int) -> bool:
        return buffer[at] == 0xFA or _PART_OF_LINE.match(buffer, at) is not None

    def _plan(self, header: bytes) -> _Plan | None:
        if header not in self._plans:
            # A device has a few outputs only: noise must not fill the memory.
            if len(self._plans) >= _MAX_PLANS:
                self._plans.clear()
            self._plans[header] = _make_plan(header)
        return self._plans[header]

    def _intact(self, buffer: bytes, at: int, length: int) -> bool:
        if buffer[at] == 0xFA:
            return not crc_hqx(buffer[at + 1 : at + length], 0)
        text, _, check = buffer[at + 1 : at + length - 1].rpartition(b"*")
        return int(check, 16) == (crc_hqx(text, 0) if len(check) == 4 else reduce(xor, text))

    def _message(self, frame: bytes, samples: list[Sample]) -> None:
        values = self._binary(frame) if frame[0] == 0xFA else self._ascii(frame)
        if values is None:
            return
        quat: Quaternion | None = None
        if "quat" in values:
            x, y, z, w = values["quat"]
            quat = unit_quaternion(w, x, y, z)
        if quat is None and "ypr" in values:
            quat = from_angles(*map(radians, values["ypr"]))
        acc = vector(values["acc"]) if "acc" in values else None
        gyr = vector(values["gyr"]) if "gyr" in values else None
        mag = vector(values["mag"], _GAUSS_UT) if "mag" in values else None
        temperature = number(*values["temperature"]) if "temperature" in values else None
        time_us = values["time"][0] // 1000 if "time" in values else None
        sample = Sample(0, time_us, None if quat is None else z_up(quat), acc, gyr, mag, temperature)
        if self._forms.is_better(sample, frame[0] == 0xFA):
            self._emit(sample, samples)
        else:
            self.counters.skipped += 1

    def _binary(self, frame: bytes) -> dict[str, tuple]:
        parts = self._current.parts if self._current else ()
        return {name: layout.unpack_from(frame, offset) for name, offset, layout in parts}

    def _ascii(self, frame: bytes) -> dict[str, tuple] | None:
        text, _, _ = frame[1:].rpartition(b"*")
        name, *numbers = text.decode("ascii").split(",")
        kinds = ASCII_LINES.get(name)
        if kinds is None:
            self.counters.skipped += 1
            return None
        values: dict[str, tuple] = {}
        at = 0
        try:
            for kind in kinds:
                count = _COUNTS.get(kind, 3)
                # The device can be set to append counters and states.
                values[kind] = tuple(map(float, numbers[at : at + count]))
                at += count
        except ValueError:
            at = len(numbers) + 1
        if at > len(numbers):
            self.counters.bad += 1
            return None
        return values


_COUNTS = {"quat": 4, "temperature": 1}


def header_size(buffer: bytes, at: int = 0) -> int:
    """Return the size of a binary output's header; 0 if more bytes are needed; negative if it is none."""
    groups = 1
    while True:
        if at + groups >= len(buffer):
            return 0
        if not buffer[at + groups] & 0x80:
            break
        groups += 1
        if groups > _MAX_GROUP_BYTES:
            return -1
    masks = sum(bin(buffer[at + i] & 0x7F).count("1") for i in range(1, groups + 1))
    offset = at + 1 + groups
    while masks:
        if offset + 1 >= len(buffer):
            return 0
        masks -= not buffer[offset + 1] & 0x80
        offset += 2
    return offset - at


def _make_plan(header: bytes) -> _Plan | None:
    """Return the plan for a header; None if a group or field has an unknown size, or if there is no field."""
    groups = [header[1]] if not header[1] & 0x80 else [header[1], header[2]]
    numbers = [8 * i + bit for i, byte in enumerate(groups) for bit in range(7) if byte >> bit & 1]
    at = 1 + len(groups)
    offset = len(header)
    offsets: dict[tuple[int, int], int] = {}
    for group in numbers:
        sizes = _SIZES.get(group)
        if sizes is None:
            return None
        first = 0
        more = True
        while more:
            mask = header[at] | header[at + 1] << 8
            at += 2
            more = mask >> 15 == 1
            if more and first + 16 >= len(sizes):
                return None
            for bit in range(15):
                if mask >> bit & 1:
                    field = first + bit
                    if field >= len(sizes) or not sizes[field]:
                        return None
                    offsets[group, field] = offset
                    offset += sizes[field]
            first += 16
    if offset == len(header) or offset - len(header) > _MAX_PAYLOAD:
        return None
    parts: dict[str, tuple[str, int, struct.Struct]] = {}
    for group, bit, name, shift, layout in _FIELDS:
        if (group, bit) in offsets and name not in parts:
            parts[name] = (name, offsets[group, bit] + shift, struct.Struct(layout))
    return _Plan(offset + 2, tuple(parts.values()))


# --- encoders -------------------------------------------------------------------------------------


def encode_binary(sample: Sample, *, euler: bool = False) -> bytes:
    """Return the bytes of a binary output for a sample, with fields of the common and the IMU group.

    Args:
        sample: its sensor id is not sent.
        euler: send angles instead of a quaternion.

    Raises:
        ValueError: a number does not fit.
    """
    common = imu = 0
    common_data = imu_data = b""
    quat = None if sample.quat is None else z_up(sample.quat)
    try:
        if sample.time_us is not None:
            common |= 1 << 0
            common_data += struct.pack("<Q", sample.time_us * 1000)
        if quat is not None and euler:
            common |= 1 << 3
            common_data += struct.pack("<3f", *_ypr(quat))
        elif quat is not None:
            common |= 1 << 4
            common_data += struct.pack("<4f", *quat[1:], quat[0])
        if sample.gyr is not None:
            common |= 1 << 5
            common_data += struct.pack("<3f", *sample.gyr)
        if sample.acc is not None:
            common |= 1 << 8
            common_data += struct.pack("<3f", *sample.acc)
        if sample.temperature is not None:
            imu |= 1 << 4
            imu_data += struct.pack("<f", sample.temperature)
        if sample.mag is not None:
            imu |= 1 << 8
            imu_data += struct.pack("<3f", *(m / _GAUSS_UT for m in sample.mag))
    except (struct.error, OverflowError) as error:
        raise ValueError(f"cannot send {sample}: {error}") from None
    masks = b"".join(mask.to_bytes(2, "little") for mask in (common, imu) if mask)
    body = bytes([bool(common) | bool(imu) << 2]) + masks + common_data + imu_data
    return b"\xfa" + body + crc_hqx(body, 0).to_bytes(2, "big")


def encode_ascii(sample: Sample, name: str = "VNQMR", *, crc: bool = False) -> bytes:
    """Return an ASCII line with quantities of a sample, line end included.

    Args:
        sample: must have the quantities of the line; its sensor id and time are not sent.
        name: one of ASCII_LINES.
        crc: send the 16 bit checksum instead of the 8 bit one.

    Raises:
        ValueError: unknown line, or the sample lacks a quantity.
    """
    if name not in ASCII_LINES:
        raise ValueError(f"line must be one of {', '.join(ASCII_LINES)}, not {name!r}")
    text = name
    quat = None if sample.quat is None else z_up(sample.quat)
    for kind in ASCII_LINES[name]:
        numbers: tuple[float, ...] | None
        if kind == "-":
            numbers, form = (0.0, 0.0, 0.0), "+07.3f"
        elif kind == "quat":
            numbers, form = None if quat is None else (*quat[1:], quat[0]), "+09.6f"
        elif kind == "ypr":
            numbers, form = None if quat is None else _ypr(quat), "+08.3f"
        elif kind == "mag":
            numbers = None if sample.mag is None else tuple(m / _GAUSS_UT for m in sample.mag)
            form = "+08.4f"
        elif kind == "acc":
            numbers, form = sample.acc, "+07.3f"
        elif kind == "gyr":
            numbers, form = sample.gyr, "+010.6f"
        else:
            numbers = None if sample.temperature is None else (sample.temperature,)
            form = "+05.1f"
        if numbers is None:
            raise ValueError(f"a {name} line needs a sample with {kind}")
        text += "".join("," + format(number, form) for number in numbers)
    if name == "VNIMU":
        text += ",+00101.325"  # the line ends with a pressure, which samples do not have
    body = text.encode("ascii")
    check = f"{crc_hqx(body, 0):04X}" if crc else f"{reduce(xor, body):02X}"
    return b"$" + body + b"*" + check.encode("ascii") + b"\r\n"


def _ypr(quat: Quaternion) -> Vector3:
    yaw, pitch, roll = to_yaw_pitch_roll(quat)
    return (degrees(yaw), degrees(pitch), degrees(roll))


PROTOCOL = Protocol(
    name="vectornav",
    transport="bytes",
    default_bitrate=115200,
    description="VectorNav VN-100 and relatives, binary outputs",
    decoder=VectorNavDecoder,
    encoder=uncounted(encode_binary),
    single_device=True,
    setup="binary output with time, quaternion, acceleration, rate",
)

PROTOCOL_ASCII = Protocol(
    name="vectornav-ascii",
    transport="bytes",
    default_bitrate=115200,
    description="VectorNav VN-100 and relatives, ASCII lines",
    decoder=VectorNavDecoder,
    encoder=uncounted(encode_ascii),
    single_device=True,
    lacks=("time",),
    setup="lines with quaternion, acceleration and rate",
    page="vectornav",
)
