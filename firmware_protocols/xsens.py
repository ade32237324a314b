"""Xsens / Movella MTi: Xbus frames with MTData2 on a serial line.

Layouts are in docs/xsens.md. Numbers are big-endian.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator
from math import degrees, floor, radians
from typing import Any

from firmware_protocols._numbers import number, vector
from firmware_protocols._sequence import Sequence
from firmware_protocols._stream import StreamDecoder
from firmware_protocols.base import Protocol
from firmware_protocols.pairing import InstantMerger
from firmware_protocols.rotation import from_angles, from_matrix, rotate, to_yaw_pitch_roll
from firmware_protocols.sample import Quaternion, Sample, unit_quaternion, z_up

MTDATA2 = 0x36
"""Id of messages with measurements."""

MAX_PAYLOAD = 2048
"""Length limit of a payload, bytes."""

NUMBER_FORMATS = ("f32", "fp12.20", "fp16.32", "f64")
"""Formats of real numbers; the index is the code in the lowest two bits of an item's id."""

FRAMES = ("ENU", "NED", "NWU")
"""Local frames of orientations; the index is the code in the next two bits."""

TICK_US = 100
"""Step of the sample time (SampleTimeFine), microseconds."""

_BROADCAST = 0xFF  # bus id of a single device on its line
_MAX_BUS_ID = 0x20

_REALS = {
    0x0810: 1,  # temperature
    0x2010: 4,  # quaternion w, x, y, z
    0x2020: 9,  # rotation matrix, column by column
    0x2030: 3,  # roll, pitch, yaw
    0x4010: 3,  # velocity increment
    0x4020: 3,  # acceleration
    0x4030: 3,  # free acceleration
    0x4040: 3,  # acceleration, high rate
    0x5010: 1,  # altitude above mean sea level
    0x5020: 1,  # altitude above the ellipsoid
    0x5030: 3,  # ECEF position
    0x5040: 2,  # latitude, longitude
    0x8020: 3,  # rate of turn
    0x8030: 4,  # orientation increment
    0x8040: 3,  # rate of turn, high rate
    0xC020: 3,  # magnetic field
    0xD010: 3,  # velocity
}
_INTEGERS = {
    0x1010: ">IH6B",  # UTC: ns, year, month, day, hour, minute, second, flags
    0x1020: ">H",  # packet counter
    0x1030: ">I",  # GPS time of week, ms
    0x1040: ">B",
    0x1050: ">B",
    0x1060: ">I",  # SampleTimeFine
    0x1070: ">I",  # SampleTimeCoarse
    0x1080: ">HH",
    0x1090: ">B",
    0x10A0: ">Q",
    0x3010: ">I",  # pressure, Pa
    0xE010: ">B",  # status byte
    0xE020: ">I",  # status word
    0xE080: ">I",  # device id
    0xE090: ">H",  # location id
}

Values = tuple[Any, ...]
_Reader = Callable[[bytes], Values]


def _reader(count: int, number_format: int) -> tuple[int, _Reader]:
    if number_format == 0:
        layout = struct.Struct(f">{count}f")
    elif number_format == 1:
        layout = struct.Struct(f">{count}i")
        return layout.size, lambda data: tuple(value / 1048576.0 for value in layout.unpack(data))
    elif number_format == 2:
        layout = struct.Struct(">" + "Ih" * count)

        def read(data: bytes) -> Values:
            raw = layout.unpack(data)
            return tuple(raw[i + 1] + raw[i] / 4294967296.0 for i in range(0, 2 * count, 2))

        return layout.size, read
    else:
        layout = struct.Struct(f">{count}d")
    return layout.size, layout.unpack


def _readers() -> dict[int, tuple[int, _Reader]]:
    result: dict[int, tuple[int, _Reader]] = {}
    for kind, count in _REALS.items():
        for low in range(12):
            result[kind | low] = _reader(count, low & 3)
    for kind, layout in _INTEGERS.items():
        reader = struct.Struct(layout)
        for low in range(16):
            # The format bits do not apply to integers.
            result[kind | low] = (reader.size, reader.unpack)
    return result


_READERS = _readers()
_NEEDED = {0x0810, 0x1020, 0x1060, 0x2010, 0x2020, 0x2030, 0x4020, 0x4040, 0x8020, 0x8040, 0xC020}
_SAMPLE_READERS = {item: reader for item, reader in _READERS.items() if item & 0xFFF0 in _NEEDED}


def mtdata2_items(payload: bytes) -> Iterator[tuple[int, Values | bytes]]:
    """Yield all items of an MTData2 payload: id as sent and values, or bytes if the layout is unknown.

    Raises:
        ValueError: the items do not fill the payload.
    """
    at, end = 0, len(payload)
    while at < end:
        if at + 3 > end or at + 3 + payload[at + 2] > end:
            raise ValueError("items do not fill the payload")
        item = payload[at] << 8 | payload[at + 1]
        data = payload[at + 3 : at + 3 + payload[at + 2]]
        at += 3 + len(data)
        size, read = _READERS.get(item, (-1, None))
        yield item, read(data) if read is not None and size == len(data) else data


# --- the serial line ------------------------------------------------------------------------------


class XbusDecoder(StreamDecoder):
    """Decoder for the Xbus stream of one device, or of a master with several sensors.

    `sensor` is the bus id behind a master, 0 for a single device. Messages with the same sample time (or
    without one, the same packet counter) become one sample.
    """

    WRAP_US = (1 << 32) * TICK_US

    _START = re.compile(b"\xfa")

    def __init__(self) -> None:
        """Create the decoder."""
        super().__init__()
        self._sequence = Sequence(self.counters, self.WRAP_US)
        self._merger = InstantMerger()

    def flush(self) -> list[Sample]:
        """Return the samples still held back at the end of a recording."""
        samples: list[Sample] = []
        for sample in self._merger.flush():
            self._emit(sample, samples)
        return samples

    def _length(self, buffer: bytes, at: int) -> int:
        head = buffer[at : at + 6]
        if len(head) > 1 and head[1] != _BROADCAST and head[1] > _MAX_BUS_ID:
            return -1
        if len(head) < 4:
            return 0
        if head[3] != 0xFF:
            return head[3] + 5
        if head[2] != MTDATA2:  # no other message is that long
            return -1
        if len(head) < 6:
            return 0
        length = head[4] << 8 | head[5]
        return length + 7 if length <= MAX_PAYLOAD else -1

    def _possible(self, buffer: bytes, at: int, length: int) -> bool:
        # The items of a false frame rarely fit, which shows before the frame is complete.
        if not length or buffer[at + 2] != MTDATA2:
            return True
        end = at + length - 1
        offset = at + (6 if buffer[at + 3] == 0xFF else 4)
        while offset + 2 < len(buffer) and offset < end:
            offset += 3 + buffer[offset + 2]
        return offset <= end

    def _intact(self, buffer: bytes, at: int, length: int) -> bool | None:
        if buffer[at + 2] == MTDATA2:
            end = at + length - 1
            offset = at + (6 if buffer[at + 3] == 0xFF else 4)
            while offset + 2 < end:
                offset += 3 + buffer[offset + 2]
            if offset != end:
                return None
        return not sum(buffer[at + 1 : at + length]) & 0xFF

    def _message(self, frame: bytes, samples: list[Sample]) -> None:
        if frame[2] != MTDATA2:
            self.counters.skipped += 1
            return
        count = time_us = temperature = quat = euler = matrix = acc = gyr = mag = None
        offset = 6 if frame[3] == 0xFF else 4
        end = len(frame) - 1
        while offset < end:
            item = frame[offset] << 8 | frame[offset + 1]
            start = offset + 3
            offset = start + frame[offset + 2]
            size, read = _SAMPLE_READERS.get(item, (-1, None))
            if read is None:
                continue
            if size != offset - start:
                self.counters.bad += 1
                return
            values = read(frame[start:offset])
            kind = item & 0xFFF0
            if kind == 0x1020:
                count = values[0]
            elif kind == 0x1060:
                time_us = values[0] * TICK_US
            elif kind == 0x2010:
                quat = _z_up(unit_quaternion(*values), item)
            elif kind == 0x2020:
                # Column by column on the wire.
                matrix = _z_up(from_matrix(values[0::3] + values[1::3] + values[2::3]), item)
            elif kind == 0x2030:
                euler = _z_up(from_angles(*map(radians, values[::-1])), item)
            elif kind == 0x4020 or (kind == 0x4040 and acc is None):
                acc = vector(values)
            elif kind == 0x8020 or (kind == 0x8040 and gyr is None):
                gyr = vector(values)
            elif kind == 0xC020:
                mag = vector(values)
            elif kind == 0x0810:
                temperature = number(values[0])
        sensor = 0 if frame[1] == _BROADCAST else frame[1]
        sample = Sample(sensor, time_us, quat or matrix or euler, acc, gyr, mag, temperature)
        instant = count if time_us is None else time_us
        if instant is None:
            self._emit(sample, samples)
            return
        if count is not None:
            # The messages of one instant may share a count.
            shared = self._sequence.is_last(sensor, count) and self._merger.completes(sample, instant)
            if not shared and not self._sequence.is_new(sensor, count, time_us):
                return
        for complete in self._merger.add(sample, instant):
            self._emit(complete, samples)


def _z_up(quat: Quaternion | None, item: int) -> Quaternion | None:
    # ENU and NWU already have Z up.
    return z_up(quat) if quat is not None and item & 0xC == 4 else quat


def encode_xbus(message_id: int, payload: bytes = b"", bus_id: int = _BROADCAST) -> bytes:
    """Return the bytes on the wire for an Xbus message.

    Raises:
        ValueError: the payload is longer than 2048 bytes, or an id does not fit a byte.
    """
    if len(payload) > MAX_PAYLOAD:
        raise ValueError(f"payload of {len(payload)} bytes, at most {MAX_PAYLOAD} are allowed")
    length = bytes([len(payload)]) if len(payload) < 0xFF else b"\xff" + len(payload).to_bytes(2, "big")
    body = bytes([bus_id, message_id]) + length + payload
    return b"\xfa" + body + bytes([-sum(body) & 0xFF])


def encode_mtdata2(
    sample: Sample,
    counter: int | None,
    *,
    number_format: str = "f32",
    frame: str = "ENU",
    orientation: str = "quaternion",
) -> bytes:
    """Return the bytes on the wire for a sample.

    Args:
        sample: sensor 0 is sent as a single device, others with their bus id.
        counter: packet counter, wraps at 65536; None leaves it out.
        number_format: one of NUMBER_FORMATS; numbers have to fit into the fixed-point formats.
        frame: local frame of the orientation on the wire, one of FRAMES. With "NWU" the quaternion is sent
            unchanged, as NWU.
        orientation: "quaternion", "matrix" or "euler".

    Raises:
        ValueError: unknown options, or a number that does not fit.
    """
    if number_format not in NUMBER_FORMATS or frame not in FRAMES:
        raise ValueError(f"unknown number format {number_format!r} or frame {frame!r}")
    low = NUMBER_FORMATS.index(number_format)
    if not 0 <= sample.sensor <= _MAX_BUS_ID:
        raise ValueError(f"sensor must be from 0 to {_MAX_BUS_ID}, not {sample.sensor}")
    payload = b""
    if sample.temperature is not None:
        payload += _item(0x0810 | low, (sample.temperature,))
    if counter is not None:
        payload += b"\x10\x20\x02" + (counter & 0xFFFF).to_bytes(2, "big")
    if sample.time_us is not None:
        payload += b"\x10\x60\x04" + (sample.time_us // TICK_US & 0xFFFFFFFF).to_bytes(4, "big")
    if sample.quat is not None:
        code = low | FRAMES.index(frame) << 2
        quat = z_up(sample.quat) if frame == "NED" else sample.quat
        if orientation == "quaternion":
            payload += _item(0x2010 | code, quat)
        elif orientation == "matrix":
            columns = [rotate(quat, axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]
            payload += _item(0x2020 | code, columns[0] + columns[1] + columns[2])
        elif orientation == "euler":
            payload += _item(0x2030 | code, tuple(map(degrees, to_yaw_pitch_roll(quat)[::-1])))
        else:
            raise ValueError(f"unknown orientation {orientation!r}")
    for kind, values in ((0x4020, sample.acc), (0x8020, sample.gyr), (0xC020, sample.mag)):
        if values is not None:
            payload += _item(kind | low, values)
    return encode_xbus(MTDATA2, payload, sample.sensor or _BROADCAST)


def _item(item: int, values: tuple[float, ...]) -> bytes:
    data = b""
    try:
        for value in values:
            if item & 3 == 0:
                data += struct.pack(">f", value)
            elif item & 3 == 1:
                data += struct.pack(">i", floor(value * 1048576.0 + 0.5))
            elif item & 3 == 2:
                raw = floor(value * 4294967296.0 + 0.5)
                data += struct.pack(">Ih", raw & 0xFFFFFFFF, raw >> 32)
            else:
                data += struct.pack(">d", value)
    except (struct.error, OverflowError, ValueError) as error:
        raise ValueError(f"cannot send {values}: {error}") from None
    return struct.pack(">HB", item, len(data)) + data


PROTOCOL = Protocol(
    name="xsens",
    transport="bytes",
    default_bitrate=115200,
    description="Xsens / Movella MTi; ids are bus ids behind an Xbus master",
    decoder=XbusDecoder,
    encoder=lambda: encode_mtdata2,
    ids=range(1, 7),
    single_device=True,
    setup="MTData2: quaternion, acceleration, rate of turn, sample time, packet counter",
)
