"""WitMotion standard protocol: serial packets, Modbus registers (RS-485) and CAN frames.

Layouts are in docs/witmotion.md. Serial and CAN are little-endian, Modbus registers are big-endian.
"""

from __future__ import annotations

import re
import struct
from math import pi, radians
from typing import Any

from firmware_protocols._numbers import int16
from firmware_protocols._recent import Recent
from firmware_protocols._stream import Receiver, StreamDecoder
from firmware_protocols.pairing import Usual
from firmware_protocols.rotation import from_angles, from_yaw_pitch_roll, to_yaw_pitch_roll
from firmware_protocols.sample import (
    GRAVITY,
    CanFrame,
    Counters,
    Quaternion,
    Sample,
    Vector3,
    unit_quaternion,
)

FIRST_REGISTER, ANGLE_REGISTERS, ALL_REGISTERS = 0x34, 12, 33
"""Modbus registers: acceleration, rate, field and angles; with temperature and quaternion in addition."""

_TIME, _ACC, _GYR, _ANGLES, _MAG, _QUAT, _REGISTERS = 0x50, 0x51, 0x52, 0x53, 0x54, 0x59, 0x5F
_SIZE = 11

_ACC_STEP = 16 * GRAVITY / 32768
_GYR_STEP = radians(2000) / 32768
_ANGLE_STEP = pi / 32768
_QUAT_STEP = 1 / 32768
_DAY_US = 86_400_000_000
_ANGLE_NAMES = ("roll", "pitch", "yaw")

_WORDS = struct.Struct("<4h")
_VECTOR = struct.Struct("<3h")
_CAN = struct.Struct("<BB3h")
_CAN_ANGLE = struct.Struct("<BBBxi")


class _Cycle:
    """Samples out of packets that hold one quantity each and have no count.

    A device sends the packets of a cycle in the order of their types. One whose type is not above that of the
    packet before begins a new cycle. The sample goes out with the last type of the earlier cycles, or else
    when the next cycle begins. It is dropped without an acceleration or an orientation, or without a quantity
    that both cycles before had; this counts as lost.
    """

    def __init__(self, sensor: int, counters: Counters) -> None:
        self._sensor = sensor
        self._counters = counters
        self._values: dict[str, Any] = {}
        self._open = False  # a packet has come that is part of no sample yet
        self._top = -1  # type of the packet before
        self._end: int | None = None  # the last type of a cycle
        self._other_end = -1  # where the cycle before ended, if not there
        self._usual = Usual()
        self._counted = True  # a stream that begins in the middle of a cycle has lost nothing

    def add(self, order: int, values: dict[str, Any]) -> list[Sample]:
        """Take the next packet; `order` is its type."""
        samples: list[Sample] = []
        if order <= self._top:
            if self._open and (self._end is None or self._top == self._other_end):
                self._end = self._top
            elif self._open:
                self._other_end = self._top
            samples = self._close()
            self._counted = False
        self._top = order
        if not self._open and self._end is not None and order > self._end:
            # What was taken for the end is none; the sample that this belongs to is gone.
            self._end = order
            return samples
        self._open = True
        self._values |= values
        if order == self._end:
            self._other_end = -1
            samples += self._close()
        return samples

    def cut(self) -> list[Sample]:
        """Something unreadable came: what follows can be of another cycle."""
        was_open = self._open
        samples = self._close()
        self._counted = was_open or self._end is None
        self._top = -1
        return samples

    def drop(self, order: int) -> None:
        """Take a packet that spoils its cycle."""
        self._values.clear()
        self._open = False
        self._counted = True
        self._top = order

    def _close(self) -> list[Sample]:
        if not self._open:
            return []
        values, self._values = self._values, {}
        self._open = False
        roll, pitch, yaw = (values.pop(name, None) for name in _ANGLE_NAMES)
        if "quat" not in values and roll is not None and pitch is not None and yaw is not None:
            quat = from_angles(yaw, pitch, roll)
            if quat is not None:
                values["quat"] = quat
        counted, self._counted = self._counted, True
        whole = self._usual.whole(values)
        if "quat" not in values or "acc" not in values or not whole:
            self._counters.lost += not counted
            return []
        self._counters.packets += 1
        return [Sample(self._sensor, **values)]


def _scaled(vector: tuple[int, ...], step: float) -> Vector3:
    x, y, z = vector
    return (x * step, y * step, z * step)


def _turned(vector: tuple[int, ...]) -> dict[str, Any]:
    return {name: value * _ANGLE_STEP for name, value in zip(_ANGLE_NAMES, vector, strict=True)}


# --- serial ---------------------------------------------------------------------------------------


class WitDecoder(StreamDecoder):
    """Samples out of a serial stream of the standard protocol: one sensor, always `sensor` 0.

    The orientation is that of the quaternion packet, or else the angles as Rz(yaw) Ry(pitch) Rx(roll). The
    time is the time of day on the device's clock.

    Attributes:
        counters: what has been seen so far; `lost` are incomplete cycles.
    """

    WRAP_US = _DAY_US
    _START = re.compile(rb"\x55(?:[\x50-\x5a\x5f]|\Z)")

    def __init__(self, *, mag_ut: float = 1.0) -> None:
        """Start with nothing seen.

        Args:
            mag_ut: microtesla of one step of the magnetic field, which differs between models. With 1 the
                field comes in steps.
        """
        super().__init__()
        self._cycle = _Cycle(0, self.counters)
        self._mag_ut = mag_ut
        self._due: list[Sample] = []

    def feed(self, data: bytes) -> list[Sample]:
        """Samples completed by the next bytes of the stream, in the order they came."""
        samples = super().feed(data)
        samples += self._due
        self._due = []
        return samples

    def _length(self, buffer: bytes, at: int) -> int:
        return _SIZE

    def _intact(self, buffer: bytes, at: int, length: int) -> bool:
        return sum(buffer[at : at + _SIZE - 1]) & 0xFF == buffer[at + _SIZE - 1]

    def _message(self, frame: bytes, samples: list[Sample]) -> None:
        samples += self._due
        self._due = []
        kind = frame[1]
        if kind == _REGISTERS:  # an answer, at any place
            self.counters.skipped += 1
            return
        w, x, y, z = words = _WORDS.unpack_from(frame, 2)
        values: dict[str, Any]
        if kind == _ACC:
            values = {"acc": _scaled((w, x, y), _ACC_STEP), "temperature": z / 100}
        elif kind == _GYR:
            values = {"gyr": _scaled((w, x, y), _GYR_STEP)}
        elif kind == _ANGLES:
            values = _turned((w, x, y))
        elif kind == _MAG:
            values = {"mag": _scaled((w, x, y), self._mag_ut)}
        elif kind == _QUAT:
            quat = unit_quaternion(*(value * _QUAT_STEP for value in words))
            if quat is None:
                self.counters.bad += 1
                self._cycle.drop(kind)
                return
            values = {"quat": quat}
        elif kind == _TIME:
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
            self._due += self._cycle.cut()


def _time_of_day(frame: bytes) -> int | None:
    hours, minutes, seconds, ms = struct.unpack_from("<BBBH", frame, 5)
    if hours > 23 or minutes > 59 or seconds > 59 or ms > 999:
        return None
    return (((hours * 60 + minutes) * 60 + seconds) * 1000 + ms) * 1000


# --- RS-485 ---------------------------------------------------------------------------------------


def _crc_table() -> tuple[int, ...]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = value >> 1 ^ (0xA001 if value & 1 else 0)
        table.append(value)
    return tuple(table)


_CRC_TABLE = _crc_table()


def crc16(data: bytes) -> int:
    """CRC-16 of Modbus: polynomial 0x8005 reflected, initial value 0xFFFF; sent low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _CRC_TABLE[(crc ^ byte) & 0xFF]
    return crc


def _with_crc(data: bytes) -> bytes:
    return data + crc16(data).to_bytes(2, "little")


def poll(address: int, first: int = FIRST_REGISTER, count: int = ANGLE_REGISTERS) -> bytes:
    """The request to send to a device on RS-485 for one sample; `count` is that of the decoder.

    Raises:
        ValueError: no such address or registers.
    """
    if not 1 <= address <= 247 or not 0 <= first <= 0xFFFF or not 1 <= count <= 125:
        raise ValueError(f"cannot ask {address} for {count} registers from {first}")
    return _with_crc(struct.pack(">BBHH", address, 3, first, count))


class WitModbusDecoder(StreamDecoder):
    """Samples out of the answers to `poll` on an RS-485 line; `sensor` is the address of the device.

    An answer does not say which registers it holds: all requests must be for the same. Requests that come
    back as an echo, and refusals, are skipped.

    Attributes:
        counters: what has been seen so far.
    """

    WRAP_US = _DAY_US
    _START = re.compile(rb"[\x01-\xf7](?:[\x03\x83]|\Z)")

    def __init__(self, *, count: int = ANGLE_REGISTERS, mag_ut: float = 1.0) -> None:
        """Start with nothing seen.

        Args:
            count: registers asked for, from FIRST_REGISTER on: ANGLE_REGISTERS or ALL_REGISTERS.
            mag_ut: microtesla of one step of the magnetic field, which differs between models. With 1 the
                field comes in steps.

        Raises:
            ValueError: another count.
        """
        if count not in (ANGLE_REGISTERS, ALL_REGISTERS):
            raise ValueError(f"count must be {ANGLE_REGISTERS} or {ALL_REGISTERS}, not {count}")
        super().__init__()
        self._mag_ut = mag_ut
        self._answer = 2 * count
        self._request = struct.pack(">HH", FIRST_REGISTER, count)
        self._words = struct.Struct(f">{count}h")

    def _length(self, buffer: bytes, at: int) -> int:
        if len(buffer) < at + 2:
            return 0
        if buffer[at + 1] == 0x83:
            return 5
        if len(buffer) < at + 3:
            return 0
        if buffer[at + 2] == self._answer:
            return 5 + self._answer
        head = buffer[at + 2 : at + 6]
        if head != self._request[: len(head)]:
            return -1
        return 8 if len(head) == 4 else 0

    def _intact(self, buffer: bytes, at: int, length: int) -> bool:
        end = at + length
        return crc16(buffer[at : end - 2]) == buffer[end - 2] | buffer[end - 1] << 8

    def _message(self, frame: bytes, samples: list[Sample]) -> None:
        if len(frame) != self._answer + 5:
            self.counters.skipped += 1
            return
        words = self._words.unpack_from(frame, 3)
        quat: Quaternion | None
        if len(words) == ALL_REGISTERS:
            w, x, y, z = words[29:33]
            quat = unit_quaternion(w * _QUAT_STEP, x * _QUAT_STEP, y * _QUAT_STEP, z * _QUAT_STEP)
            temperature = words[12] / 100
            if quat is None:
                self.counters.bad += 1
                return
        else:
            roll, pitch, yaw = words[9:12]
            quat = from_yaw_pitch_roll(yaw * _ANGLE_STEP, pitch * _ANGLE_STEP, roll * _ANGLE_STEP)
            temperature = None
        sample = Sample(
            frame[0],
            None,
            quat,
            _scaled(words[0:3], _ACC_STEP),
            _scaled(words[3:6], _GYR_STEP),
            _scaled(words[6:9], self._mag_ut),
            temperature,
        )
        self._give(sample, samples)


# --- CAN ------------------------------------------------------------------------------------------


class WitCanDecoder(Receiver):
    """Samples out of CAN frames; `sensor` is the identifier of the device.

    The orientation is that of the angles: a quaternion does not fit into a frame and comes without its last
    component. The frames have neither count nor time: if just as many frames of a device as make whole cycles
    are lost in a row, quantities of different cycles meet unnoticed.

    Attributes:
        counters: what has been seen so far; `lost` are incomplete cycles.
    """

    WRAP_US = _DAY_US

    def __init__(self, *, fine_angles: bool = False, mag_ut: float = 1.0) -> None:
        """Start with nothing seen.

        Args:
            fine_angles: devices of high precision (HWT9073) send each angle in a frame of its own.
            mag_ut: microtesla of one step of the magnetic field, which differs between models. With 1 the
                field comes in steps.
        """
        super().__init__()
        self._fine = fine_angles
        self._mag_ut = mag_ut
        self._cycles: Recent[tuple[int, bool], _Cycle] = Recent()

    def feed(self, can_id: int, data: bytes, extended: bool = False) -> list[Sample]:
        """The samples that this frame completes."""
        self.counters.bytes += len(data)
        if len(data) != 8 or data[0] != 0x55 or not (_TIME <= data[1] <= 0x5A):
            self.counters.skipped += 1
            return []
        cycle = self._cycles.get((can_id, extended)) or _Cycle(can_id, self.counters)
        self._cycles[can_id, extended] = cycle
        _, kind, x, y, z = _CAN.unpack(data)
        order = kind * 4
        values: dict[str, Any]
        if kind == _ACC:
            values = {"acc": _scaled((x, y, z), _ACC_STEP)}
        elif kind == _GYR:
            values = {"gyr": _scaled((x, y, z), _GYR_STEP)}
        elif kind == _MAG:
            values = {"mag": _scaled((x, y, z), self._mag_ut)}
        elif kind != _ANGLES:
            values = {}
        elif not self._fine:
            values = _turned((x, y, z))
        else:
            _, _, axis, angle = _CAN_ANGLE.unpack(data)
            if not 1 <= axis <= 3:
                return self._bad()
            order += axis
            values = {_ANGLE_NAMES[axis - 1]: radians(angle / 1000)}
        self._good()
        return cycle.add(order, values)


# --- encoders -------------------------------------------------------------------------------------


def encode(sample: Sample, *, angles: bool = False, mag_ut: float = 1.0) -> bytes:
    """Serial packets of one cycle of what the sample has.

    Args:
        sample: its time becomes that of a day.
        angles: send Euler angles, as new devices do, and not the quaternion.
        mag_ut: microtesla of one step of the magnetic field.
    """
    out = b""
    if sample.time_us is not None:
        seconds, us = divmod(sample.time_us % _DAY_US, 1_000_000)
        hours, minutes = seconds // 3600, seconds // 60 % 60
        out += _packet(_TIME, struct.pack("<6BH", 26, 1, 1, hours, minutes, seconds % 60, us // 1000))
    temperature = int16((sample.temperature or 0) * 100)
    for kind, values, step in _vectors(sample, mag_ut, angles):
        out += _packet(kind, _WORDS.pack(*_steps(values, step), temperature if kind == _ACC else 0))
    if sample.quat is not None and not angles:
        out += _packet(_QUAT, _WORDS.pack(*_steps(sample.quat, _QUAT_STEP)))
    return out


def encode_modbus(sample: Sample, *, count: int = ANGLE_REGISTERS, mag_ut: float = 1.0) -> bytes:
    """Answer of the device `sample.sensor` to a request for `count` registers.

    Raises:
        ValueError: a needed quantity is missing.
    """
    if sample.acc is None or sample.gyr is None or sample.quat is None:
        raise ValueError("needs quaternion, acceleration and angular rate")
    words = _steps(sample.acc, _ACC_STEP) + _steps(sample.gyr, _GYR_STEP)
    words += _steps(sample.mag or (0.0, 0.0, 0.0), mag_ut) + _steps(
        to_yaw_pitch_roll(sample.quat)[::-1], _ANGLE_STEP
    )
    words += [int16((sample.temperature or 0) * 100), *[0] * 16, *_steps(sample.quat, _QUAT_STEP)]
    return _with_crc(struct.pack(f">BBB{count}h", sample.sensor, 3, 2 * count, *words[:count]))


def encode_can(sample: Sample, *, fine_angles: bool = False, mag_ut: float = 1.0) -> list[CanFrame]:
    """CAN frames of one cycle of what the sample has; identifiers above 0x7FF are extended."""
    frames = []
    for kind, values, step in _vectors(sample, mag_ut, True):
        if kind == _ANGLES and fine_angles:
            for axis, value in enumerate(values):
                frames.append(_CAN_ANGLE.pack(0x55, kind, axis + 1, round(value * 180_000 / pi)))
        else:
            frames.append(_CAN.pack(0x55, kind, *_steps(values, step)))
    return [(sample.sensor, data, sample.sensor > 0x7FF) for data in frames]


def _vectors(sample: Sample, mag_ut: float, angles: bool) -> list[tuple[int, Vector3, float]]:
    """Type, values and step of what the sample has, in the order of the types."""
    turned = to_yaw_pitch_roll(sample.quat)[::-1] if angles and sample.quat is not None else None
    return [
        (kind, values, step)
        for kind, values, step in (
            (_ACC, sample.acc, _ACC_STEP),
            (_GYR, sample.gyr, _GYR_STEP),
            (_ANGLES, turned, _ANGLE_STEP),
            (_MAG, sample.mag, mag_ut),
        )
        if values is not None
    ]


def _packet(kind: int, data: bytes) -> bytes:
    body = bytes([0x55, kind]) + data
    return body + bytes([sum(body) & 0xFF])


def _steps(values: tuple[float, ...], step: float) -> list[int]:
    return [int16(value / step) for value in values]
