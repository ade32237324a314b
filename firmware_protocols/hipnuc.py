"""HiPNUC (HI2xx, CH0x0, CH10x, HI221 wireless kit): serial frames.

Layouts are in docs/hipnuc.md. Everything is little-endian.
"""

from __future__ import annotations

import re
import struct
from binascii import crc_hqx
from collections.abc import Iterable
from math import radians

from firmware_protocols._hipnuc_fields import (
    DEG,
    MASK_83,
    NODE_BIT,
    QUAT_F,
    VECTOR_F,
    VECTOR_I,
    WRAP_US,
    field_or_none,
    fields_at,
    scaled,
    temperature_at,
    unit,
    vector_i,
    write_fields,
)
from firmware_protocols._stream import StreamDecoder
from firmware_protocols.base import Protocol, uncounted
from firmware_protocols.rotation import from_angles, from_yaw_pitch_roll
from firmware_protocols.sample import STANDARD_G, Quaternion, Sample, Vector3, unit_quaternion

_SYNC = b"\x5a\xa5"

MAX_NODES = 16
"""Number of nodes that one wireless receiver can serve."""

_HEADER = 6
_BLOCK = 76  # bytes of a 0x91 item
_MAX_PAYLOAD = 8 + MAX_NODES * _BLOCK
_MAX_OTHER = 512  # limit for payloads that do not begin with 0x62

_HI91 = struct.Struct("<xBxbxxxxI9f12x4f")
_HI91_WRITE = struct.Struct("<BBBbfI9f12x4f")
_HI83 = struct.Struct("<BHBI")

# Sizes in bytes of single items, without their tag.
_ITEMS = {
    0x90: 1,  # id
    0xA0: 6,  # acceleration
    0xA1: 6,  # acceleration, calibrated
    0xA5: 6,  # acceleration without gravity
    0xB0: 6,  # angular rate
    0xB1: 6,  # angular rate, calibrated
    0xC0: 6,  # magnetic field
    0xD0: 6,  # angles, integer
    0xD9: 12,  # angles
    0xD1: 16,  # quaternion
    0xE0: 4,  # temperature
    0xF0: 4,  # pressure
}

# Bytes per node of the items of the old wireless receiver.
_NODE_ITEMS = {0x71: 16, 0x72: 6, 0x75: 6, 0x78: 6, 0x7A: 6}


class _Unknown(Exception):
    """An intact payload of unknown content."""


def _integer_angles(data: bytes, start: int) -> Quaternion:
    # These old devices all use the order yaw, pitch, roll.
    pitch, roll, yaw = VECTOR_I.unpack_from(data, start)
    return from_yaw_pitch_roll(radians(yaw / 10), radians(pitch / 100), radians(roll / 100))


def _block(data: bytes, start: int, sensor: int | None) -> Sample:
    """Return the sample of a 0x91 item; without `sensor`, byte 1 is its node id and time 0 means no time."""
    node, degrees, ms, ax, ay, az, gx, gy, gz, mx, my, mz, w, x, y, z = _HI91.unpack_from(data, start)
    mag = scaled((mx, my, mz), 1.0)
    return Sample(
        node if sensor is None else sensor,
        None if sensor is None and not ms else ms * 1000,
        unit(w, x, y, z),
        scaled((ax, ay, az), STANDARD_G),
        scaled((gx, gy, gz), DEG),
        mag if mx or my or mz else None,
        None if sensor is None else float(degrees),  # the layout with a node id has none
    )


class HipnucDecoder(StreamDecoder):
    """Decoder for a HiPNUC serial stream.

    Attributes:
        counters: counts of everything decoded so far.
    """

    WRAP_US = WRAP_US
    _START = re.compile(rb"\x5a(?:\xa5|\Z)")

    def __init__(self, *, node_ids: bool = False) -> None:
        """Create the decoder.

        Args:
            node_ids: whether the second byte of a 0x91 item outside of a wireless frame is the device id, as
                in older and wireless models. Newer ones have status bits there; their sensor id is 0.
        """
        super().__init__()
        self._single = None if node_ids else 0

    def _length(self, buffer: bytes, at: int) -> int:
        known = len(buffer) - at
        if known < 4:
            return 0
        length = buffer[at + 2] | buffer[at + 3] << 8
        if not 0 < length <= _MAX_PAYLOAD:
            return -1
        if known < _HEADER + min(length, 3):
            return 0
        # Check the tag, too: a false start with a large length would hold up the stream.
        tag = buffer[at + _HEADER]
        if tag == 0x62:
            nodes = buffer[at + _HEADER + 2] if length > 2 else 0
            good = nodes <= MAX_NODES and length == 8 + nodes * _BLOCK
        else:
            good = (_BLOCK if tag == 0x91 else 1) <= length <= _MAX_OTHER
        return _HEADER + length if good else -1

    def _intact(self, buffer: bytes, at: int, length: int) -> bool:
        crc = crc_hqx(buffer[at + _HEADER : at + length], crc_hqx(buffer[at : at + 4], 0))
        return crc == buffer[at + 4] | buffer[at + 5] << 8

    def _message(self, frame: bytes, samples: list[Sample]) -> None:
        for sample in self._payload(frame[_HEADER:]):
            self._emit(sample, samples)

    def _payload(self, payload: bytes) -> list[Sample]:
        samples: list[Sample] = []
        try:
            if payload[0] == 0x62:
                return self._nodes(payload)
            if payload[0] in _NODE_ITEMS or payload[0] == 0x61:
                return _dongle(payload)
            self._items(payload, samples)
        except _Unknown:
            self.counters.skipped += not samples
        except ValueError:
            self.counters.bad += 1
        return samples

    def _nodes(self, payload: bytes) -> list[Sample]:
        samples = []
        for start in range(8, len(payload), _BLOCK):
            try:
                if payload[start] != 0x91:
                    raise ValueError("no measurement")
                samples.append(_block(payload, start, None))
            except ValueError:  # the other nodes are still read
                self.counters.bad += 1
        if not payload[2]:
            self.counters.skipped += 1
        return samples

    def _items(self, payload: bytes, samples: list[Sample]) -> None:
        single: dict[int, int] = {}  # offsets of the data of single items
        at = 0
        while at < len(payload):
            tag = payload[at]
            if tag == 0x91:
                if len(payload) < at + _BLOCK:
                    raise ValueError("too short")
                samples.append(_block(payload, at, self._single))
                at += _BLOCK
            elif tag == 0x83:
                if len(payload) < at + _HI83.size:
                    raise ValueError("too short")
                mask = _HI83.unpack_from(payload, at)[3]
                if mask & ~MASK_83:
                    raise _Unknown
                sample, at = fields_at(payload, at + _HI83.size, mask, 0)
                if sample.quat is None and sample.acc is None:
                    raise _Unknown
                samples.append(sample)
            elif tag in _ITEMS:
                single[tag] = at + 1
                at += 1 + _ITEMS[tag]
                if at > len(payload):
                    raise ValueError("too short")
            else:
                break
        sample = _single_items(payload, single)
        if sample.quat is not None or sample.acc is not None:
            samples.append(sample)
        if not samples:
            raise _Unknown


def _single_items(data: bytes, at: dict[int, int]) -> Sample:
    quat: Quaternion | None = None
    acc: Vector3 | None = None
    gyr: Vector3 | None = None
    mag: Vector3 | None = None
    temperature: float | None = None
    if 0xD1 in at:
        quat = unit(*QUAT_F.unpack_from(data, at[0xD1]))
    elif 0xD9 in at:
        pitch, roll, yaw = scaled(VECTOR_F.unpack_from(data, at[0xD9]), DEG)
        quat = from_angles(yaw, pitch, roll)
        if quat is None:
            raise ValueError("angles beyond a full turn")
    elif 0xD0 in at:
        quat = _integer_angles(data, at[0xD0])
    for tag in (0xA0, 0xA1):
        if tag in at:
            acc = scaled(VECTOR_I.unpack_from(data, at[tag]), STANDARD_G / 1000)
    for tag in (0xB0, 0xB1):
        if tag in at:
            gyr = scaled(VECTOR_I.unpack_from(data, at[tag]), DEG / 10)
    if 0xC0 in at:
        mag = field_or_none(VECTOR_I.unpack_from(data, at[0xC0]), 0.1)
    if 0xE0 in at:
        temperature = temperature_at(data, at[0xE0])
    return Sample(data[at[0x90]] if 0x90 in at else 0, None, quat, acc, gyr, mag, temperature)


def _dongle(payload: bytes) -> list[Sample]:
    """Return the samples of the old wireless receiver: a table per quantity, a row per node in id order."""
    at, counts = 0, range(1, MAX_NODES + 1)
    if payload[0] == 0x61:
        if len(payload) < 4 or payload[3] not in counts:
            raise ValueError("no number of nodes")
        at, counts = 4, range(payload[3], payload[3] + 1)
    # Without 0x61 the number of nodes follows from the length only.
    fits = [(n, tables) for n in counts if (tables := _tables(payload, at, n))]
    if len(fits) != 1:
        raise _Unknown
    n, tables = fits[0]
    samples = []
    for node in range(n):
        rows = {tag: start + node * _NODE_ITEMS[tag] for tag, start in tables.items()}
        if not any(any(payload[row : row + _NODE_ITEMS[tag]]) for tag, row in rows.items()):
            continue  # no such node
        quat: Quaternion | None = None
        acc: Vector3 | None = None
        gyr: Vector3 | None = None
        mag: Vector3 | None = None
        if 0x71 in rows:
            quat = unit_quaternion(*QUAT_F.unpack_from(payload, rows[0x71]))
            if quat is None:
                continue
        elif 0x72 in rows:
            quat = _integer_angles(payload, rows[0x72])
        if 0x75 in rows:
            acc = scaled(VECTOR_I.unpack_from(payload, rows[0x75]), STANDARD_G / 1000)
        if 0x78 in rows:
            gyr = scaled(VECTOR_I.unpack_from(payload, rows[0x78]), DEG / 10)
        if 0x7A in rows:
            mag = field_or_none(VECTOR_I.unpack_from(payload, rows[0x7A]), 0.1)
        samples.append(Sample(node, None, quat, acc, gyr, mag))
    return samples


def _tables(payload: bytes, at: int, n: int) -> dict[int, int]:
    """Return the offset of each table for n nodes; an empty dict if the payload does not fit n nodes."""
    tables: dict[int, int] = {}
    while at < len(payload):
        tag = payload[at]
        if tag not in _NODE_ITEMS or tag in tables:
            return {}
        tables[tag] = at + 1
        at += 1 + n * _NODE_ITEMS[tag]
    return tables if at == len(payload) else {}


# --- encoders -------------------------------------------------------------------------------------


def encode_frame(payload: bytes) -> bytes:
    """Return the bytes on the wire for a payload."""
    head = _SYNC + len(payload).to_bytes(2, "little")
    return head + crc_hqx(payload, crc_hqx(head, 0)).to_bytes(2, "little") + payload


def encode(sample: Sample, *, node_ids: bool = False) -> bytes:
    """Return a serial frame with one 0x91 item. Its Euler angles and pressure are zeros.

    Args:
        sample: must have quaternion, acceleration and angular rate; its time is cut to whole milliseconds.
        node_ids: send the sensor id instead of status bits.

    Raises:
        ValueError: a required quantity is missing.
    """
    return encode_frame(_write_block(sample, node_ids))


def encode_nodes(samples: Iterable[Sample], *, gateway: int = 0) -> bytes:
    """Return the serial frame of a wireless receiver (0x62) with one block per sample; see `encode`."""
    blocks = [_write_block(sample, True) for sample in samples]
    return encode_frame(bytes([0x62, gateway, len(blocks), 0, 0, 0, 0, 0]) + b"".join(blocks))


def encode_fields(sample: Sample, *, node_ids: bool = False) -> bytes:
    """Return a serial frame with one 0x83 item of the quantities that the sample has."""
    mask, fields = write_fields(sample)
    if node_ids:
        mask |= 1 << NODE_BIT
        fields += bytes([sample.sensor, 0, 0, 0])
    return encode_frame(_HI83.pack(0x83, 0, 0, mask) + fields)


def encode_items(sample: Sample) -> bytes:
    """Return a serial frame with single items, as older models send them; the time is left out."""
    out = bytes([0x90, sample.sensor])
    if sample.acc is not None:
        out += b"\xa0" + vector_i(sample.acc, 1000 / STANDARD_G)
    if sample.gyr is not None:
        out += b"\xb0" + vector_i(sample.gyr, 10 / DEG)
    if sample.mag is not None:
        out += b"\xc0" + vector_i(sample.mag, 10)
    if sample.quat is not None:
        out += b"\xd1" + QUAT_F.pack(*sample.quat)
    if sample.temperature is not None:
        out += b"\xe0" + struct.pack("<f", sample.temperature)
    return encode_frame(out)


def encode_tables(samples: Iterable[Sample], *, gateway: int = 0) -> bytes:
    """Return the serial frame of the old wireless receiver (0x61, 0x71, 0x75, 0x78) for sensors 0..15."""
    by_id = {sample.sensor: sample for sample in samples}
    nodes = [by_id.get(sensor, Sample(sensor)) for sensor in range(max(by_id) + 1)]
    zero = (0.0, 0.0, 0.0)
    return encode_frame(
        bytes([0x61, 0, gateway, len(nodes), 0x71])
        + b"".join(QUAT_F.pack(*(node.quat or (0.0, *zero))) for node in nodes)
        + b"\x75"
        + b"".join(vector_i(node.acc or zero, 1000 / STANDARD_G) for node in nodes)
        + b"\x78"
        + b"".join(vector_i(node.gyr or zero, 10 / DEG) for node in nodes)
    )


def _write_block(sample: Sample, node_ids: bool) -> bytes:
    if sample.quat is None or sample.acc is None or sample.gyr is None:
        raise ValueError("quaternion, acceleration and angular rate are required")
    return _HI91_WRITE.pack(
        0x91,
        sample.sensor if node_ids else 0,
        0,
        0 if node_ids else round(sample.temperature or 0),
        0.0,
        (sample.time_us or 0) // 1000 & 0xFFFFFFFF,
        *(value / STANDARD_G for value in sample.acc),
        *(value / DEG for value in sample.gyr),
        *(sample.mag or (0.0, 0.0, 0.0)),
        *sample.quat,
    )


PROTOCOL = Protocol(
    name="hipnuc",
    transport="bytes",
    default_bitrate=115200,
    description="HiPNUC HI2xx, CH0x0, CH10x; ids are those of the wireless receiver",
    decoder=HipnucDecoder,
    encoder=uncounted(encode),
    ids=range(6),
    single_device=True,
    setup="frame 0x91",
)
