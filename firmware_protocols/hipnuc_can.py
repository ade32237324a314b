"""HiPNUC on CAN: CANopen process data, and J1939 groups on CAN 2.0 and CAN FD.

Layouts are in docs/hipnuc.md. Everything is little-endian.
"""

from __future__ import annotations

import struct

from firmware_protocols._hipnuc_fields import (
    DEG,
    QUAT_I,
    VECTOR_I,
    WRAP_US,
    fields_at,
    quat_i,
    scaled,
    vector_i,
    write_fields,
)
from firmware_protocols._sequence import count_byte
from firmware_protocols._stream import Receiver
from firmware_protocols.base import Protocol, uncounted_can
from firmware_protocols.pairing import CycleDetector
from firmware_protocols.sample import STANDARD_G, CanFrame, Sample, Vector3, unit_quaternion

_MASK_FD = 0x17F


class _CanDecoder(Receiver):
    """Assembles samples from frames that hold one quantity each, by their order.

    A node sends its quantities in a fixed order with the quaternion last. A quaternion completes a sample
    with everything received since the node's previous quaternion. The sample is dropped if it has no
    acceleration, or lacks a quantity that both previous cycles had. If a quantity arrives twice, the
    quaternion between them is missing, and everything before the second is dropped. Every drop counts as
    lost.
    """

    def __init__(self) -> None:
        super().__init__()
        self._parts: dict[int, dict[str, Vector3 | float]] = {}
        self._completeness: dict[int, CycleDetector] = {}

    def _add(self, node: int, kind: str, value: Vector3 | float) -> list[Sample]:
        self._count_good()
        parts = self._parts.setdefault(node, {})
        if kind in parts:
            self.counters.lost += 1
            parts.clear()
        parts[kind] = value
        return []

    def _close(self, node: int, values: tuple[int, ...]) -> list[Sample]:
        parts = self._parts.pop(node, {})
        known = node in self._completeness
        whole = self._completeness.setdefault(node, CycleDetector()).is_complete(parts)
        quat = unit_quaternion(*(value / 10000 for value in values))
        if quat is None:
            return self._count_bad()
        self._count_good()
        if "acc" not in parts or not whole:
            self.counters.lost += known
            return []
        self.counters.packets += 1
        return [Sample(node, None, quat, **parts)]  # type: ignore[arg-type]


class HipnucCanopenDecoder(_CanDecoder):
    """Decoder for the CANopen process data of any number of nodes; `sensor` is the node id (1..64).

    All nodes must send acceleration and quaternion (TPDO1 and TPDO4) at the same rate, and nothing faster.
    The frames have neither counter nor time. If one or more whole cycles of consecutive frames of a node are
    lost, quantities of different cycles are combined, which cannot be detected.

    Attributes:
        counters: counts of everything decoded so far; `lost` counts incomplete cycles.
    """

    WRAP_US = WRAP_US

    def feed(self, can_id: int, data: bytes, extended: bool = False) -> list[Sample]:
        """Return the sample that this frame completes, if any."""
        self.counters.bytes += len(data)
        node = can_id & 0x7F
        kind = can_id - node
        if extended or not 1 <= node <= 64 or kind not in (0x180, 0x280, 0x480):
            self.counters.skipped += 1
            return []
        if kind == 0x480:
            return self._close(node, QUAT_I.unpack(data)) if len(data) == 8 else self._count_bad()
        if not 6 <= len(data) <= 8:
            return self._count_bad()
        values = VECTOR_I.unpack_from(data)
        if kind == 0x180:
            return self._add(node, "acc", scaled(values, STANDARD_G / 1000))
        return self._add(node, "gyr", scaled(values, DEG / 10))


_J1939_VECTORS = {
    0xFF34: ("acc", STANDARD_G / 2048),
    0xFF37: ("gyr", DEG * 2000 / 32768),
    0xFF3A: ("mag", 1000 / 32768),
}
_J1939_TEMPERATURE = 0xFF43
# One of the vendor's DBC files has the second number for the quaternion, all other sources the first.
_J1939_QUATS = (0xFF46, 0xFF42)
_J1939_FD = 0xFF5B


class HipnucJ1939Decoder(_CanDecoder):
    """Decoder for the J1939 groups of any number of devices; `sensor` is the source address.

    All devices must send acceleration and quaternion (FF34 and FF46) at the same rate, and nothing faster;
    see `HipnucCanopenDecoder` for losses that cannot be detected. A CAN FD frame (FF5B) is a complete sample
    with a counter.

    Attributes:
        counters: counts of everything decoded so far; `lost` counts incomplete cycles, and gaps in the
            counter of CAN FD frames.
    """

    WRAP_US = WRAP_US

    def __init__(self) -> None:
        """Create the decoder."""
        super().__init__()
        self._counts: dict[int, int] = {}

    def feed(self, can_id: int, data: bytes, extended: bool = True) -> list[Sample]:
        """Return the sample that this frame completes, if any."""
        self.counters.bytes += len(data)
        node = can_id & 0xFF
        group = can_id >> 8 & 0x3FFFF
        if not extended or node > 253:
            self.counters.skipped += 1
            return []
        if group in _J1939_VECTORS:
            if not 6 <= len(data) <= 8:
                return self._count_bad()
            kind, scale = _J1939_VECTORS[group]
            return self._add(node, kind, scaled(VECTOR_I.unpack_from(data), scale))
        if group in _J1939_QUATS:
            return self._close(node, QUAT_I.unpack(data)) if len(data) == 8 else self._count_bad()
        if group == _J1939_TEMPERATURE:
            if not 2 <= len(data) <= 8:
                return self._count_bad()
            return self._add(node, "temperature", int.from_bytes(data[:2], "little", signed=True) / 100)
        if group == _J1939_FD:
            return self._fd(node, data)
        self.counters.skipped += 1
        return []

    def _fd(self, node: int, data: bytes) -> list[Sample]:
        if not 8 <= len(data) <= 64:
            return self._count_bad()
        mask = int.from_bytes(data[:4], "little")
        if mask & ~_MASK_FD:
            self.counters.skipped += 1
            return []
        try:
            sample, _ = fields_at(data, 8, mask, node)
        except ValueError:
            return self._count_bad()
        self._count_good()
        count_byte(self.counters, self._counts.get(node), data[7])
        self._counts[node] = data[7]
        if sample.quat is None and sample.acc is None:
            self.counters.skipped += 1
            return []
        self.counters.packets += 1
        return [sample]


# --- encoders -------------------------------------------------------------------------------------


def encode_canopen(sample: Sample) -> list[CanFrame]:
    """Return the CAN frames of one cycle of a CANopen node: acceleration, angular rate, quaternion."""
    frames = []
    if sample.acc is not None:
        frames.append((0x180 + sample.sensor, vector_i(sample.acc, 1000 / STANDARD_G), False))
    if sample.gyr is not None:
        frames.append((0x280 + sample.sensor, vector_i(sample.gyr, 10 / DEG), False))
    if sample.quat is not None:
        frames.append((0x480 + sample.sensor, quat_i(sample.quat), False))
    return frames


def encode_j1939(sample: Sample) -> list[CanFrame]:
    """Return the CAN frames of one cycle of a J1939 device.

    Their order is acceleration, angular rate, magnetic field, temperature, quaternion.
    """
    parts: list[tuple[int, bytes]] = []
    for group, (kind, scale) in _J1939_VECTORS.items():
        values = getattr(sample, kind)
        if values is not None:
            parts.append((group, vector_i(values, 1 / scale) + b"\0\0"))
    if sample.temperature is not None:
        parts.append((_J1939_TEMPERATURE, struct.pack("<h6x", round(sample.temperature * 100))))
    if sample.quat is not None:
        parts.append((_J1939_QUATS[0], quat_i(sample.quat)))
    return [(_j1939_id(group, sample.sensor), data, True) for group, data in parts]


def encode_j1939_fd(sample: Sample, count: int = 0) -> CanFrame:
    """Return a CAN FD frame with the quantities that the sample has, padded to a legal length.

    Raises:
        ValueError: they do not fit into 64 bytes.
    """
    mask, fields = write_fields(sample)
    data = struct.pack("<IHBB", mask, 0, 0, count & 0xFF) + fields
    for length in (8, 12, 16, 20, 24, 32, 48, 64):
        if len(data) <= length:
            return _j1939_id(_J1939_FD, sample.sensor), data.ljust(length, b"\0"), True
    raise ValueError("too much data for one CAN FD frame")


def _j1939_id(group: int, node: int) -> int:
    return 3 << 26 | group << 8 | node


PROTOCOL_CANOPEN = Protocol(
    name="hipnuc-canopen",
    transport="can",
    default_bitrate=500_000,
    description="HiPNUC on CANopen; ids are node ids",
    decoder=HipnucCanopenDecoder,
    encoder=uncounted_can(encode_canopen),
    ids=range(1, 7),
    lacks=("time",),
    setup="acceleration and quaternion at one rate, and nothing faster",
    page="hipnuc",
)

PROTOCOL_J1939 = Protocol(
    name="hipnuc-j1939",
    transport="can",
    default_bitrate=500_000,
    description="HiPNUC on J1939, CAN 2.0 and CAN FD; ids are source addresses",
    decoder=HipnucJ1939Decoder,
    encoder=uncounted_can(encode_j1939),
    ids=range(1, 7),
    lacks=("time",),
    setup="acceleration and quaternion at one rate, and nothing faster",
    page="hipnuc",
)
