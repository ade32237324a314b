"""Xsens / Movella MTi-600 on CAN: one message per quantity.

Layouts are in docs/xsens.md.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from math import radians
from typing import Any

from firmware_protocols._numbers import int16
from firmware_protocols._sequence import Sequence
from firmware_protocols._stream import Receiver
from firmware_protocols.base import Encode, Frame, Protocol
from firmware_protocols.rotation import from_angles, to_yaw_pitch_roll
from firmware_protocols.sample import Sample, unit_quaternion, z_up
from firmware_protocols.xsens import FRAMES, TICK_US

MTI600_IDS: Mapping[str, int] = {
    "time": 0x005,
    "counter": 0x006,
    "quat": 0x021,
    "euler": 0x022,
    "gyr": 0x032,
    "acc": 0x034,
    "mag": 0x041,
    "temperature": 0x051,
}
"""CAN ids of an MTi-600 as delivered."""

_CAN_LAYOUTS = {
    "time": ("I", 1.0),
    "counter": ("H", 1.0),
    "quat": ("4h", 1 / 32767),
    "euler": ("3h", radians(2**-7)),
    "gyr": ("3h", 2**-9),
    "acc": ("3h", 2**-8),
    "mag": ("3h", 2**-10),
    "temperature": ("h", 2**-8),
}

# A sample is complete when it has all of these that its predecessors had.
_AWAITED = ("time", "counter", "quat", "euler", "gyr", "acc")
_MEMORY = 8  # samples without a message after which it is not waited for any more


class _Group:
    """The messages of one sensor that belong to one sample."""

    def __init__(self) -> None:
        self.items: dict[str, Any] = {}
        self.late: dict[str, Any] = {}
        self.emitted = False  # whether the sample has been returned; further messages are late
        self.number = 0  # of the sample
        self.seen: dict[str, int] = {}  # number of the last sample that had the message
        self.opener: tuple[str, ...] = ()

    def opens(self, kind: str) -> bool:
        """Return whether a message is the first of the next sample."""
        if kind in self.items:
            return True
        return kind in self.opener and any(other not in self.opener for other in self.items)

    def record(self, kind: str) -> None:
        """Note that the sensor sends a message, and update which ones open a sample."""
        if kind not in self.seen:
            kinds = (*self.seen, kind)
            # Time and counter come first. Without them, the message with the lowest id does.
            self.opener = tuple(k for k in ("time", "counter") if k in kinds) or next(
                ((k,) for k in _AWAITED if k in kinds), ()
            )
        self.seen[kind] = self.number

    def complete(self) -> bool:
        """Return whether the sample has all messages that recent ones had."""
        # The first samples only show which messages the sensor sends.
        return self.number >= 2 and all(
            kind in self.items
            for kind, number in self.seen.items()
            if kind in _AWAITED and self.number - number <= _MEMORY
        )


class Mti600CanDecoder(Receiver):
    """Decoder for the CAN messages of MTi-600 sensors on one bus. Experimental: no capture was available.

    A sample extends from one sample time or group counter to the next. It is returned as soon as it has all
    messages that the previous samples had. Without time and counter, the quaternion (or the lowest id that is
    sent) opens a sample.
    """

    WRAP_US = (1 << 32) * TICK_US

    def __init__(
        self,
        byte_order: str = "big",
        time_unit_us: int = TICK_US,
        ids: Mapping[int, Mapping[str, int]] | None = None,
        *,
        extended: bool = False,
        frame: str = "ENU",
    ) -> None:
        """Create the decoder.

        Args:
            byte_order: "big" or "little"; the sources of this format are inconclusive.
            time_unit_us: one tick of the sample time, microseconds.
            ids: the CAN ids of each sensor, named as in MTI600_IDS; None means one sensor, 0, with those.
            extended: whether all ids have 29 bits; ids above 0x7FF always do.
            frame: local frame of the orientations, one of FRAMES.

        Raises:
            ValueError: unknown options, or two messages with one id.
        """
        if byte_order not in ("big", "little") or frame not in FRAMES:
            raise ValueError(f"unknown byte order {byte_order!r} or frame {frame!r}")
        order = ">" if byte_order == "big" else "<"
        layouts = {kind: (struct.Struct(order + f), scale) for kind, (f, scale) in _CAN_LAYOUTS.items()}
        super().__init__()
        self.WRAP_US = (1 << 32) * time_unit_us
        self._tick_us = time_unit_us
        self._ned = frame == "NED"
        self._sequence = Sequence(self.counters, self.WRAP_US)
        self._groups: dict[int, _Group] = {}
        self._ids: dict[tuple[int, bool], tuple[int, str, struct.Struct, float]] = {}
        for sensor, kinds in ({0: MTI600_IDS} if ids is None else ids).items():
            self._groups[sensor] = _Group()
            for kind, can_id in kinds.items():
                if kind not in layouts:
                    raise ValueError(f"message must be one of {', '.join(layouts)}, not {kind!r}")
                key = (can_id, extended or can_id > 0x7FF)
                if key in self._ids:
                    raise ValueError(f"CAN id 0x{can_id:X} is used twice")
                self._ids[key] = (sensor, kind, *layouts[kind])

    def feed(self, can_id: int, data: bytes, extended: bool = False) -> list[Sample]:
        """Return the samples completed by one CAN message; messages with other ids are skipped."""
        self.counters.bytes += len(data)
        entry = self._ids.get((can_id, extended))
        if entry is None:
            self.counters.skipped += 1
            return []
        sensor, kind, layout, scale = entry
        value: Any = None
        if len(data) == layout.size:
            raw = layout.unpack(data)
            if kind == "quat":
                value = unit_quaternion(*[x * scale for x in raw])
            elif kind == "euler":
                value = from_angles(*[x * scale for x in raw[::-1]])
            elif kind == "time":
                value = raw[0] * self._tick_us
            elif kind == "counter":
                value = raw[0]
            elif kind == "temperature":
                value = raw[0] * scale
            else:
                value = (raw[0] * scale, raw[1] * scale, raw[2] * scale)
        if value is None:
            return self._count_bad()
        self._count_good()
        group = self._groups[sensor]
        samples: list[Sample] = []
        if group.opens(kind):
            if not group.emitted:
                self._close(sensor, group, samples)
            group.items = {}
            group.emitted = False
            group.number += 1
        group.record(kind)
        if group.emitted:
            # Too late for its sample. Later samples wait for it, or take along a slow quantity.
            if kind not in _AWAITED:
                group.late[kind] = value
            return samples
        group.items[kind] = value
        if group.complete():
            self._close(sensor, group, samples)
            group.emitted = True
        return samples

    def _close(self, sensor: int, group: _Group, samples: list[Sample]) -> None:
        items = group.late | group.items
        group.late = {}
        quat = items.get("quat") or items.get("euler")
        if quat is not None and self._ned:
            quat = z_up(quat)
        time_us, count = items.get("time"), items.get("counter")
        if count is not None and not self._sequence.is_new(sensor, count, time_us):
            return
        sample = Sample(
            sensor, time_us, quat, *(items.get(kind) for kind in ("acc", "gyr", "mag", "temperature"))
        )
        self._emit(sample, samples)


def encode_mti600(
    sample: Sample,
    counter: int | None,
    *,
    byte_order: str = "big",
    time_unit_us: int = TICK_US,
    ids: Mapping[str, int] = MTI600_IDS,
    euler: bool = False,
    frame: str = "ENU",
) -> list[tuple[int, bytes]]:
    """Return CAN ids and data of the messages of a sample, in the order in which a device sends them.

    Args:
        sample: its quantities are clamped to the range of int16.
        counter: group counter, wraps at 65536; None leaves it out.
        byte_order: "big" or "little".
        time_unit_us: one tick of the sample time, microseconds.
        ids: the sensor's CAN ids; quantities without one are not sent.
        euler: send angles instead of a quaternion.
        frame: local frame of the orientation on the wire, one of FRAMES.

    Raises:
        ValueError: unknown options, NaN or infinity.
    """
    if byte_order not in ("big", "little") or frame not in FRAMES:
        raise ValueError(f"unknown byte order {byte_order!r} or frame {frame!r}")
    order = ">" if byte_order == "big" else "<"
    quat = z_up(sample.quat) if sample.quat is not None and frame == "NED" else sample.quat
    values: dict[str, tuple[float, ...] | None] = {
        "time": None if sample.time_us is None else (sample.time_us // time_unit_us & 0xFFFFFFFF,),
        "counter": None if counter is None else (counter & 0xFFFF,),
        "quat": None if euler else quat,
        "euler": to_yaw_pitch_roll(quat)[::-1] if euler and quat is not None else None,
        "gyr": sample.gyr,
        "acc": sample.acc,
        "mag": sample.mag,
        "temperature": None if sample.temperature is None else (sample.temperature,),
    }
    messages = []
    for kind, numbers in values.items():
        if numbers is None or kind not in ids:
            continue
        layout, scale = _CAN_LAYOUTS[kind]
        raw = numbers if kind in ("time", "counter") else [int16(value / scale) for value in numbers]
        messages.append((ids[kind], struct.pack(order + layout, *raw)))
    return messages


_ID_STEP = 0x100


def _six_ids() -> dict[int, dict[str, int]]:
    """Return the CAN ids of six devices: those as delivered, plus 0x100 times the sensor id.

    All fit in 11 bits and avoid CANopen's process data of low node ids.
    """
    return {
        sensor: {kind: can_id + _ID_STEP * sensor for kind, can_id in MTI600_IDS.items()}
        for sensor in range(6)
    }


def _decoder() -> Mti600CanDecoder:
    return Mti600CanDecoder(ids=_six_ids())


def _encoder() -> Encode:
    ids = _six_ids()

    def encode(sample: Sample, seq: int) -> list[Frame]:
        messages = encode_mti600(sample, seq & 0xFFFF, ids=ids[sample.sensor])
        return [(can_id, data, False, False) for can_id, data in messages]

    return encode


PROTOCOL = Protocol(
    name="xsens-can",
    transport="can",
    default_bitrate=250_000,
    description="Xsens / Movella MTi-600 on CAN; sensor n has the ids as delivered plus n times 0x100",
    decoder=_decoder,
    encoder=_encoder,
    ids=range(6),
    setup="quaternion, acceleration, rate of turn, sample time, packet counter",
    page="xsens",
)
