"""HiPNUC (HI2xx, CH0x0, CH10x, HI221 wireless kit): serial frames, CANopen PDOs and J1939 groups.

Layouts are in docs/hipnuc.md. Everything is little-endian.
"""

from __future__ import annotations

import re
import struct
from binascii import crc_hqx
from collections.abc import Iterable
from math import radians

from firmware_protocols._numbers import int16, number, plausible, vector
from firmware_protocols._sequence import count_byte
from firmware_protocols._stream import Receiver, StreamDecoder
from firmware_protocols.pairing import Usual
from firmware_protocols.rotation import from_angles, from_yaw_pitch_roll
from firmware_protocols.sample import GRAVITY, CanFrame, Quaternion, Sample, Vector3, unit_quaternion

_SYNC = b"\x5a\xa5"

MAX_NODES = 16
"""Most nodes that one wireless receiver serves."""

_HEADER = 6
_BLOCK = 76  # bytes of an 0x91 item
_MAX_PAYLOAD = 8 + MAX_NODES * _BLOCK
_MAX_OTHER = 512  # payloads that do not begin with 0x62
_WRAP_US = (1 << 32) * 1000
_DEG = radians(1.0)

_HI91 = struct.Struct("<xBxbxxxxI9f12x4f")
_HI91_WRITE = struct.Struct("<BBBbfI9f12x4f")
_HI83 = struct.Struct("<BHBI")
_VECTOR_I = struct.Struct("<3h")
_VECTOR_F = struct.Struct("<3f")
_QUAT_I = struct.Struct("<4h")
_QUAT_F = struct.Struct("<4f")

# Bytes of the fields of an 0x83 item by bit of its mask. Other bits have no known length.
_FIELDS = dict(
    enumerate((12, 12, 12, 12, 16, 8, 8, 4, 4, 12, 12, 12, 12, 12, 24, 4, 4, 4, 4, 4))
) | {30: 24, 31: 12}  # fmt: skip
_TIME_BIT, _TEMPERATURE_BIT, _NODE_BIT = 5, 8, 19
_MASK_83 = sum(1 << bit for bit in _FIELDS)
_MASK_FD = 0x17F

# Bytes of single items after their tag.
_ITEMS = {
    0x90: 1,  # id
    0xA0: 6,  # acceleration
    0xA1: 6,  # acceleration, calibrated
    0xA5: 6,  # acceleration of the motion, without gravity
    0xB0: 6,  # angular rate
    0xB1: 6,  # angular rate, calibrated
    0xC0: 6,  # magnetic field
    0xD0: 6,  # angles, integer
    0xD9: 12,  # angles
    0xD1: 16,  # quaternion
    0xE0: 4,  # temperature
    0xF0: 4,  # pressure
}

# Bytes a node of items of the old wireless receiver.
_NODE_ITEMS = {0x71: 16, 0x72: 6, 0x75: 6, 0x78: 6, 0x7A: 6}


class _Unknown(Exception):
    """An intact payload whose content is not known here."""


# --- values ---------------------------------------------------------------------------------------


def _unit(w: float, x: float, y: float, z: float) -> Quaternion:
    quat = unit_quaternion(w, x, y, z)
    if quat is None:
        raise ValueError("quaternion is not of unit length")
    return quat


def _scaled(values: tuple[float, ...], scale: float) -> Vector3:
    result = vector(values, scale)
    if result is None:
        raise ValueError("NaN, infinity, or too large")
    return result


def _temperature(data: bytes, at: int) -> float:
    value = number(struct.unpack_from("<f", data, at)[0])
    if value is None:
        raise ValueError("NaN, infinity, or too large")
    return value


def _field(values: tuple[float, ...], scale: float) -> Vector3 | None:
    """A magnetic field; devices without a magnetometer send zeros."""
    field = _scaled(values, scale)
    return field if any(field) else None


def _integer_angles(data: bytes, start: int) -> Quaternion:
    # These old devices all turn in the order yaw, pitch, roll.
    pitch, roll, yaw = _VECTOR_I.unpack_from(data, start)
    return from_yaw_pitch_roll(radians(yaw / 10), radians(pitch / 100), radians(roll / 100))


def _block(data: bytes, start: int, sensor: int | None) -> Sample:
    """Sample of an 0x91 item. Without a given sensor its second byte is the node id, and time 0 is none."""
    node, degrees, ms, ax, ay, az, gx, gy, gz, mx, my, mz, w, x, y, z = _HI91.unpack_from(data, start)
    if not plausible((ax, ay, az, gx, gy, gz, mx, my, mz)):
        raise ValueError("NaN, infinity, or too large")
    return Sample(
        node if sensor is None else sensor,
        None if sensor is None and not ms else ms * 1000,
        _unit(w, x, y, z),
        (ax * GRAVITY, ay * GRAVITY, az * GRAVITY),
        (gx * _DEG, gy * _DEG, gz * _DEG),
        (mx, my, mz) if mx or my or mz else None,
        None if sensor is None else float(degrees),  # not in the layout that has a node id
    )


def _fields(data: bytes, start: int, mask: int, sensor: int) -> tuple[Sample, int]:
    """Sample of the fields of an 0x83 item, and where they end."""
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
            acc = _scaled(_VECTOR_F.unpack_from(data, at), 1.0)
        elif bit == 1:
            gyr = _scaled(_VECTOR_F.unpack_from(data, at), 1.0)
        elif bit == 2:
            mag = _field(_VECTOR_F.unpack_from(data, at), 1.0)
        elif bit == 4:
            quat = _unit(*_QUAT_F.unpack_from(data, at))
        elif bit == _TIME_BIT:
            time_us = int.from_bytes(data[at : at + 8], "little") % _WRAP_US
        elif bit == _TEMPERATURE_BIT:
            temperature = _temperature(data, at)
        elif bit == _NODE_BIT:
            sensor = data[at]
        at += size
    return Sample(sensor, time_us, quat, acc, gyr, mag, temperature), at


# --- serial ---------------------------------------------------------------------------------------


class HipnucDecoder(StreamDecoder):
    """Samples out of a HiPNUC serial stream.

    Attributes:
        counters: what has been seen so far.
    """

    WRAP_US = _WRAP_US
    _START = re.compile(rb"\x5a(?:\xa5|\Z)")

    def __init__(self, *, node_ids: bool = False) -> None:
        """Start with nothing seen.

        Args:
            node_ids: the second byte of an 0x91 item that comes on its own is the id of the device, as older
                and wireless models have it. Newer ones have status bits there; their samples are of sensor 0.
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
        # The tag tells more than the length alone: a false start must not hold up the stream for long.
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
            self._give(sample, samples)

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
            except ValueError:  # costs the other nodes nothing
                self.counters.bad += 1
        if not payload[2]:
            self.counters.skipped += 1
        return samples

    def _items(self, payload: bytes, samples: list[Sample]) -> None:
        single: dict[int, int] = {}  # where the data of single items are
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
                if mask & ~_MASK_83:
                    raise _Unknown
                sample, at = _fields(payload, at + _HI83.size, mask, 0)
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
        quat = _unit(*_QUAT_F.unpack_from(data, at[0xD1]))
    elif 0xD9 in at:
        pitch, roll, yaw = _scaled(_VECTOR_F.unpack_from(data, at[0xD9]), _DEG)
        quat = from_angles(yaw, pitch, roll)
        if quat is None:
            raise ValueError("angles beyond a turn")
    elif 0xD0 in at:
        quat = _integer_angles(data, at[0xD0])
    for tag in (0xA0, 0xA1):
        if tag in at:
            acc = _scaled(_VECTOR_I.unpack_from(data, at[tag]), GRAVITY / 1000)
    for tag in (0xB0, 0xB1):
        if tag in at:
            gyr = _scaled(_VECTOR_I.unpack_from(data, at[tag]), _DEG / 10)
    if 0xC0 in at:
        mag = _field(_VECTOR_I.unpack_from(data, at[0xC0]), 0.1)
    if 0xE0 in at:
        temperature = _temperature(data, at[0xE0])
    return Sample(data[at[0x90]] if 0x90 in at else 0, None, quat, acc, gyr, mag, temperature)


def _dongle(payload: bytes) -> list[Sample]:
    """Samples of the old wireless receiver: one table a quantity, one row a node in the order of the ids."""
    at, counts = 0, range(1, MAX_NODES + 1)
    if payload[0] == 0x61:
        if len(payload) < 4 or payload[3] not in counts:
            raise ValueError("no number of nodes")
        at, counts = 4, range(payload[3], payload[3] + 1)
    # Without 0x61 the number of nodes shows in the length only.
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
            quat = unit_quaternion(*_QUAT_F.unpack_from(payload, rows[0x71]))
            if quat is None:
                continue
        elif 0x72 in rows:
            quat = _integer_angles(payload, rows[0x72])
        if 0x75 in rows:
            acc = _scaled(_VECTOR_I.unpack_from(payload, rows[0x75]), GRAVITY / 1000)
        if 0x78 in rows:
            gyr = _scaled(_VECTOR_I.unpack_from(payload, rows[0x78]), _DEG / 10)
        if 0x7A in rows:
            mag = _field(_VECTOR_I.unpack_from(payload, rows[0x7A]), 0.1)
        samples.append(Sample(node, None, quat, acc, gyr, mag))
    return samples


def _tables(payload: bytes, at: int, n: int) -> dict[int, int]:
    """Where each table begins if there are n nodes, or nothing if that does not fit."""
    tables: dict[int, int] = {}
    while at < len(payload):
        tag = payload[at]
        if tag not in _NODE_ITEMS or tag in tables:
            return {}
        tables[tag] = at + 1
        at += 1 + n * _NODE_ITEMS[tag]
    return tables if at == len(payload) else {}


# --- CAN ------------------------------------------------------------------------------------------


class _CanDecoder(Receiver):
    """Samples out of frames that hold one quantity each, by the order in which a node's frames come.

    A node sends its quantities in a fixed order with the quaternion last. A sample is what came since the
    node's last quaternion, and goes out with this one. It is dropped without an acceleration, or without a
    quantity that both cycles before had; and so is all that came before a quantity that comes again, as a
    quaternion is missing there. Every drop counts as lost.
    """

    def __init__(self) -> None:
        super().__init__()
        self._parts: dict[int, dict[str, Vector3 | float]] = {}
        self._usual: dict[int, Usual] = {}

    def _add(self, node: int, kind: str, value: Vector3 | float) -> list[Sample]:
        self._good()
        parts = self._parts.setdefault(node, {})
        if kind in parts:
            self.counters.lost += 1
            parts.clear()
        parts[kind] = value
        return []

    def _close(self, node: int, values: tuple[int, ...]) -> list[Sample]:
        parts = self._parts.pop(node, {})
        known = node in self._usual
        whole = self._usual.setdefault(node, Usual()).whole(parts)
        quat = unit_quaternion(*(value / 10000 for value in values))
        if quat is None:
            return self._bad()
        self._good()
        if "acc" not in parts or not whole:
            self.counters.lost += known
            return []
        self.counters.packets += 1
        return [Sample(node, None, quat, **parts)]  # type: ignore[arg-type]


class HipnucCanopenDecoder(_CanDecoder):
    """Samples out of the CANopen process data of any number of nodes; `sensor` is the node id (1..64).

    All nodes must send acceleration and quaternion (TPDO1 and TPDO4) at one rate, and nothing faster. The
    frames have neither count nor time: if just as many frames of a node as make whole cycles are lost in a
    row, quantities of different cycles meet unnoticed.

    Attributes:
        counters: what has been seen so far; `lost` are incomplete cycles.
    """

    WRAP_US = _WRAP_US

    def feed(self, can_id: int, data: bytes, extended: bool = False) -> list[Sample]:
        """The sample that this frame completes, if any."""
        self.counters.bytes += len(data)
        node = can_id & 0x7F
        kind = can_id - node
        if extended or not 1 <= node <= 64 or kind not in (0x180, 0x280, 0x480):
            self.counters.skipped += 1
            return []
        if kind == 0x480:
            return self._close(node, _QUAT_I.unpack(data)) if len(data) == 8 else self._bad()
        if not 6 <= len(data) <= 8:
            return self._bad()
        values = _VECTOR_I.unpack_from(data)
        if kind == 0x180:
            return self._add(node, "acc", _scaled(values, GRAVITY / 1000))
        return self._add(node, "gyr", _scaled(values, _DEG / 10))


_J1939_VECTORS = {
    0xFF34: ("acc", GRAVITY / 2048),
    0xFF37: ("gyr", _DEG * 2000 / 32768),
    0xFF3A: ("mag", 1000 / 32768),
}
_J1939_TEMPERATURE = 0xFF43
# One of the maker's DBC files has the second number for the quaternion, all else the first.
_J1939_QUATS = (0xFF46, 0xFF42)
_J1939_FD = 0xFF5B


class HipnucJ1939Decoder(_CanDecoder):
    """Samples out of the J1939 groups of any number of devices; `sensor` is the source address.

    All must send acceleration and quaternion (FF34 and FF46) at one rate, and nothing faster; see
    `HipnucCanopenDecoder` for what cannot be noticed. A CAN FD frame (FF5B) is a whole sample with a count.

    Attributes:
        counters: what has been seen so far; `lost` are incomplete cycles, and gaps in the CAN FD count.
    """

    WRAP_US = _WRAP_US

    def __init__(self) -> None:
        """Start with nothing seen."""
        super().__init__()
        self._counts: dict[int, int] = {}

    def feed(self, can_id: int, data: bytes, extended: bool = True) -> list[Sample]:
        """The sample that this frame completes, if any."""
        self.counters.bytes += len(data)
        node = can_id & 0xFF
        group = can_id >> 8 & 0x3FFFF
        if not extended or node > 253:
            self.counters.skipped += 1
            return []
        if group in _J1939_VECTORS:
            if not 6 <= len(data) <= 8:
                return self._bad()
            kind, scale = _J1939_VECTORS[group]
            return self._add(node, kind, _scaled(_VECTOR_I.unpack_from(data), scale))
        if group in _J1939_QUATS:
            return self._close(node, _QUAT_I.unpack(data)) if len(data) == 8 else self._bad()
        if group == _J1939_TEMPERATURE:
            if not 2 <= len(data) <= 8:
                return self._bad()
            return self._add(node, "temperature", int.from_bytes(data[:2], "little", signed=True) / 100)
        if group == _J1939_FD:
            return self._whole(node, data)
        self.counters.skipped += 1
        return []

    def _whole(self, node: int, data: bytes) -> list[Sample]:
        if not 8 <= len(data) <= 64:
            return self._bad()
        mask = int.from_bytes(data[:4], "little")
        if mask & ~_MASK_FD:
            self.counters.skipped += 1
            return []
        try:
            sample, _ = _fields(data, 8, mask, node)
        except ValueError:
            return self._bad()
        self._good()
        count_byte(self.counters, self._counts.get(node), data[7])
        self._counts[node] = data[7]
        if sample.quat is None and sample.acc is None:
            self.counters.skipped += 1
            return []
        self.counters.packets += 1
        return [sample]


# --- encoders -------------------------------------------------------------------------------------


def encode_frame(payload: bytes) -> bytes:
    """The bytes that go over the line for a payload."""
    head = _SYNC + len(payload).to_bytes(2, "little")
    return head + crc_hqx(payload, crc_hqx(head, 0)).to_bytes(2, "little") + payload


def encode(sample: Sample, *, node_ids: bool = False) -> bytes:
    """Serial frame with one 0x91 item. Its Euler angles and pressure are zeros.

    Args:
        sample: with quaternion, acceleration and angular rate; time in whole milliseconds.
        node_ids: send the sensor id in place of status bits.

    Raises:
        ValueError: a needed quantity is missing.
    """
    return encode_frame(_write_block(sample, node_ids))


def encode_nodes(samples: Iterable[Sample], *, gateway: int = 0) -> bytes:
    """Serial frame of a wireless receiver with one block (0x62) for each sample; see `encode`."""
    blocks = [_write_block(sample, True) for sample in samples]
    return encode_frame(bytes([0x62, gateway, len(blocks), 0, 0, 0, 0, 0]) + b"".join(blocks))


def encode_fields(sample: Sample, *, node_ids: bool = False) -> bytes:
    """Serial frame with one 0x83 item of what the sample has."""
    mask, fields = _write_fields(sample)
    if node_ids:
        mask |= 1 << _NODE_BIT
        fields += bytes([sample.sensor, 0, 0, 0])
    return encode_frame(_HI83.pack(0x83, 0, 0, mask) + fields)


def encode_items(sample: Sample) -> bytes:
    """Serial frame with the single items of older models of what the sample has, no time."""
    out = bytes([0x90, sample.sensor])
    if sample.acc is not None:
        out += b"\xa0" + _vector_i(sample.acc, 1000 / GRAVITY)
    if sample.gyr is not None:
        out += b"\xb0" + _vector_i(sample.gyr, 10 / _DEG)
    if sample.mag is not None:
        out += b"\xc0" + _vector_i(sample.mag, 10)
    if sample.quat is not None:
        out += b"\xd1" + _QUAT_F.pack(*sample.quat)
    if sample.temperature is not None:
        out += b"\xe0" + struct.pack("<f", sample.temperature)
    return encode_frame(out)


def encode_tables(samples: Iterable[Sample], *, gateway: int = 0) -> bytes:
    """Serial frame of the old wireless receiver (0x61, 0x71, 0x75, 0x78) of sensors 0..15."""
    by_id = {sample.sensor: sample for sample in samples}
    nodes = [by_id.get(sensor, Sample(sensor)) for sensor in range(max(by_id) + 1)]
    zero = (0.0, 0.0, 0.0)
    return encode_frame(
        bytes([0x61, 0, gateway, len(nodes), 0x71])
        + b"".join(_QUAT_F.pack(*(node.quat or (0.0, *zero))) for node in nodes)
        + b"\x75"
        + b"".join(_vector_i(node.acc or zero, 1000 / GRAVITY) for node in nodes)
        + b"\x78"
        + b"".join(_vector_i(node.gyr or zero, 10 / _DEG) for node in nodes)
    )


def encode_canopen(sample: Sample) -> list[CanFrame]:
    """CAN frames of one cycle of a CANopen node: acceleration, angular rate, quaternion."""
    frames = []
    if sample.acc is not None:
        frames.append((0x180 + sample.sensor, _vector_i(sample.acc, 1000 / GRAVITY), False))
    if sample.gyr is not None:
        frames.append((0x280 + sample.sensor, _vector_i(sample.gyr, 10 / _DEG), False))
    if sample.quat is not None:
        frames.append((0x480 + sample.sensor, _quat_i(sample.quat), False))
    return frames


def encode_j1939(sample: Sample) -> list[CanFrame]:
    """CAN frames of one cycle of a J1939 device: acceleration, rate, field, temperature, quaternion."""
    parts: list[tuple[int, bytes]] = []
    for group, (kind, scale) in _J1939_VECTORS.items():
        values = getattr(sample, kind)
        if values is not None:
            parts.append((group, _vector_i(values, 1 / scale) + b"\0\0"))
    if sample.temperature is not None:
        parts.append((_J1939_TEMPERATURE, struct.pack("<h6x", round(sample.temperature * 100))))
    if sample.quat is not None:
        parts.append((_J1939_QUATS[0], _quat_i(sample.quat)))
    return [(_j1939_id(group, sample.sensor), data, True) for group, data in parts]


def encode_j1939_fd(sample: Sample, count: int = 0) -> CanFrame:
    """CAN FD frame with what the sample has, padded to a length that CAN FD knows.

    Raises:
        ValueError: more than fits into 64 bytes.
    """
    mask, fields = _write_fields(sample)
    data = struct.pack("<IHBB", mask, 0, 0, count & 0xFF) + fields
    for length in (8, 12, 16, 20, 24, 32, 48, 64):
        if len(data) <= length:
            return _j1939_id(_J1939_FD, sample.sensor), data.ljust(length, b"\0"), True
    raise ValueError("too much for one frame")


def _j1939_id(group: int, node: int) -> int:
    return 3 << 26 | group << 8 | node


def _write_block(sample: Sample, node_ids: bool) -> bytes:
    if sample.quat is None or sample.acc is None or sample.gyr is None:
        raise ValueError("needs quaternion, acceleration and angular rate")
    return _HI91_WRITE.pack(
        0x91,
        sample.sensor if node_ids else 0,
        0,
        0 if node_ids else round(sample.temperature or 0),
        0.0,
        (sample.time_us or 0) // 1000 & 0xFFFFFFFF,
        *(value / GRAVITY for value in sample.acc),
        *(value / _DEG for value in sample.gyr),
        *(sample.mag or (0.0, 0.0, 0.0)),
        *sample.quat,
    )


def _write_fields(sample: Sample) -> tuple[int, bytes]:
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


def _vector_i(values: Vector3, scale: float) -> bytes:
    return _VECTOR_I.pack(*(int16(value * scale) for value in values))


def _quat_i(quat: Quaternion) -> bytes:
    return _QUAT_I.pack(*(int16(value * 10000) for value in quat))
