"""WitMotion on RS-485: Modbus registers, which the host polls device by device.

Layouts are in docs/witmotion.md. Registers are big-endian.
"""

from __future__ import annotations

import re
import struct

from firmware_protocols._numbers import int16
from firmware_protocols._stream import StreamDecoder
from firmware_protocols._witmotion_cycle import (
    ACC_STEP,
    ANGLE_STEP,
    DAY_US,
    GYR_STEP,
    QUAT_STEP,
    scaled,
    steps_of,
)
from firmware_protocols.base import Protocol, uncounted
from firmware_protocols.rotation import from_yaw_pitch_roll, to_yaw_pitch_roll
from firmware_protocols.sample import Quaternion, Sample, unit_quaternion

FIRST_REGISTER, ANGLE_REGISTERS, ALL_REGISTERS = 0x34, 12, 33
"""Register of the acceleration; number of registers up to the angles (acceleration, rate, field, angles), and
up to the quaternion (also temperature and quaternion)."""


def _crc_table() -> tuple[int, ...]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = value >> 1 ^ (0xA001 if value & 1 else 0)
        table.append(value)
    return tuple(table)


_CRC_TABLE = _crc_table()


def crc16(data: bytes) -> int:
    """Return the CRC-16 of Modbus: polynomial 0x8005 reflected, initial value 0xFFFF; sent low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _CRC_TABLE[(crc ^ byte) & 0xFF]
    return crc


def _with_crc(data: bytes) -> bytes:
    return data + crc16(data).to_bytes(2, "little")


def poll(address: int, first: int = FIRST_REGISTER, count: int = ANGLE_REGISTERS) -> bytes:
    """Return the request to an RS-485 device for one sample; `count` must be that of the decoder.

    Raises:
        ValueError: invalid address or registers.
    """
    if not 1 <= address <= 247 or not 0 <= first <= 0xFFFF or not 1 <= count <= 125:
        raise ValueError(f"cannot ask {address} for {count} registers from {first}")
    return _with_crc(struct.pack(">BBHH", address, 3, first, count))


class WitModbusDecoder(StreamDecoder):
    """Decoder for the answers to `poll` on an RS-485 line; `sensor` is the address of the device.

    An answer does not say which registers it holds, so all requests must be for the same ones. Echoed
    requests and error responses are skipped.

    Attributes:
        counters: counts of everything decoded so far.
    """

    WRAP_US = DAY_US
    _START = re.compile(rb"[\x01-\xf7](?:[\x03\x83]|\Z)")

    def __init__(self, *, count: int = ANGLE_REGISTERS, mag_ut: float = 1.0) -> None:
        """Create the decoder.

        Args:
            count: number of registers requested, from FIRST_REGISTER on: ANGLE_REGISTERS or ALL_REGISTERS.
            mag_ut: microtesla per step of the magnetic field, which depends on the model. With 1 the field
                is in steps.

        Raises:
            ValueError: any other count.
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
            quat = unit_quaternion(w * QUAT_STEP, x * QUAT_STEP, y * QUAT_STEP, z * QUAT_STEP)
            temperature = words[12] / 100
            if quat is None:
                self.counters.bad += 1
                return
        else:
            roll, pitch, yaw = words[9:12]
            quat = from_yaw_pitch_roll(yaw * ANGLE_STEP, pitch * ANGLE_STEP, roll * ANGLE_STEP)
            temperature = None
        sample = Sample(
            frame[0],
            None,
            quat,
            scaled(words[0:3], ACC_STEP),
            scaled(words[3:6], GYR_STEP),
            scaled(words[6:9], self._mag_ut),
            temperature,
        )
        self._emit(sample, samples)


def encode_modbus(sample: Sample, *, count: int = ANGLE_REGISTERS, mag_ut: float = 1.0) -> bytes:
    """Return the answer of device `sample.sensor` to a request for `count` registers.

    Raises:
        ValueError: a required quantity is missing.
    """
    if sample.acc is None or sample.gyr is None or sample.quat is None:
        raise ValueError("quaternion, acceleration and angular rate are required")
    words = steps_of(sample.acc, ACC_STEP) + steps_of(sample.gyr, GYR_STEP)
    words += steps_of(sample.mag or (0.0, 0.0, 0.0), mag_ut) + steps_of(
        to_yaw_pitch_roll(sample.quat)[::-1], ANGLE_STEP
    )
    words += [int16((sample.temperature or 0) * 100), *[0] * 16, *steps_of(sample.quat, QUAT_STEP)]
    return _with_crc(struct.pack(f">BBB{count}h", sample.sensor, 3, 2 * count, *words[:count]))


def _request(sensor: int) -> tuple[bytes, int]:
    return poll(sensor), 5 + 2 * ANGLE_REGISTERS


PROTOCOL = Protocol(
    name="witmotion-modbus",
    transport="bytes",
    default_bitrate=9600,
    description="WitMotion on RS-485; ids are Modbus addresses, which are polled in turn",
    decoder=WitModbusDecoder,
    encoder=uncounted(encode_modbus),
    ids=range(0x50, 0x56),
    request=_request,
    lacks=("time",),
    setup="an address each",
    page="witmotion",
)
