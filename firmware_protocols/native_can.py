"""The native packet of self-built sensors on a CAN bus: two to four frames of CAN 2.0, or one of CAN FD.

Layouts are in README.md next to this file; `c/edgepose_packet.h` is the encoder for firmware. Everything is
little-endian. Identifiers are `base + (message << 5 | sensor)`, with 11 bits if all of them fit, else 29.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from firmware_protocols.base import Encode, Frame, Protocol
from firmware_protocols.native import NativeReceiver
from firmware_protocols.native_packet import (
    ACC_SCALE,
    GYR_SCALE,
    MAG_SCALE,
    QUAT_SCALE,
    Info,
    Packet,
    body_size,
    decode_body,
    encode_body,
    encode_info_body,
    fixed,
    packet_of,
)
from firmware_protocols.sample import Sample, Vector3, unit_quaternion

BASE = 0x400
"""Default identifier of message 0 of sensor 0."""

SENSORS = 32
"""Number of sensors per base."""

SYNC_ID = 0x080
"""Identifier (11 bits) of the frame with which one node sends its time to the others."""

TICK_US = 100
"""Step of the time in CAN 2.0 frames, microseconds."""

ACC, QUAT, GYR, MAG = range(4)
"""Messages. ACC opens a sample and QUAT closes it. On CAN FD, message 0 is a complete packet."""

FD_LENGTHS = (8, 12, 16, 20, 24, 32, 48, 64)
"""Legal lengths of CAN FD data, to which bodies are padded."""

_VECTOR = struct.Struct("<3hH")
_QUATERNION = struct.Struct("<4h")
_SPAN = 4 * SENSORS


def can_id(message: int, sensor: int, base: int = BASE) -> int:
    """Return the identifier of a message of a sensor.

    Raises:
        ValueError: no such sensor or base.
    """
    _check_base(base)
    if not 0 <= sensor < SENSORS:
        raise ValueError(f"sensor ids on CAN are 0 to {SENSORS - 1}, not {sensor}")
    return base + (message << 5 | sensor)


def is_extended(base: int) -> bool:
    """Return whether the identifiers of a base have 29 bits, because not all of them fit in 11."""
    return base + _SPAN > 1 << 11


def _check_base(base: int) -> None:
    if not 0 <= base <= (1 << 29) - _SPAN or base <= SYNC_ID < base + _SPAN:
        raise ValueError(f"base {base:#x}: identifiers do not fit in 29 bits or include SYNC")


# --- sending --------------------------------------------------------------------------------------


def encode(packet: Packet, base: int = BASE) -> list[tuple[int, bytes]]:
    """Return identifiers and data of the CAN 2.0 frames of a measurement, in sending order.

    Sequence number, temperature and battery are left out. Pass the time without a wrap at 2^32 us if
    possible: that wrap would be a jump in the 16 bit time.

    Raises:
        ValueError: no acceleration, a quantity is NaN or infinite, or no such sensor or base.
    """
    if packet.acc is None:
        raise ValueError("CAN 2.0 frames need an acceleration")
    ticks = packet.t_us // TICK_US & 0xFFFF
    frames = [
        (can_id(message, packet.sensor_id, base), _VECTOR.pack(*fixed(vector, scale), ticks))
        for message, vector, scale in (
            (ACC, packet.acc, ACC_SCALE),
            (GYR, packet.gyr, GYR_SCALE),
            (MAG, packet.mag, MAG_SCALE),
        )
        if vector is not None
    ]
    closing = b"" if packet.quat is None else _QUATERNION.pack(*fixed(packet.quat, QUAT_SCALE))
    return [*frames, (can_id(QUAT, packet.sensor_id, base), closing)]


def encode_fd(message: Packet | Info, base: int = BASE, *, floats: bool = False) -> tuple[int, bytes]:
    """Return identifier and data of the CAN FD frame of a measurement or an INFO packet.

    Args:
        message: measurement or INFO; time and sequence number as on a serial line.
        base: identifier of message 0 of sensor 0.
        floats: send vectors and quaternion as binary32 instead of int16.

    Raises:
        ValueError: see `encode_body`; no such sensor or base; the body is longer than 64 bytes.
    """
    body = encode_info_body(message) if isinstance(message, Info) else encode_body(message, floats=floats)
    for length in FD_LENGTHS:
        if len(body) <= length:
            return can_id(0, message.sensor_id, base), body.ljust(length, b"\0")
    raise ValueError(f"cannot send {len(body)} bytes in one CAN FD frame; leave out a quantity")


def encode_sync(t_us: int) -> tuple[int, bytes]:
    """Return identifier and data of a SYNC frame; the time wraps at 2^32 us."""
    return SYNC_ID, (t_us & 0xFFFFFFFF).to_bytes(4, "little")


# --- receiving ------------------------------------------------------------------------------------


@dataclass
class _Open:
    """A CAN 2.0 sample that waits for its QUAT.

    Attributes:
        ticks: time, steps of TICK_US.
        acc: acceleration.
        gyr: angular rate, if it has arrived.
        mag: magnetic field, if it has arrived.
        arrival_s: arrival time of the ACC, if known.
    """

    ticks: int
    acc: Vector3
    gyr: Vector3 | None = None
    mag: Vector3 | None = None
    arrival_s: float | None = None


class NativeCanDecoder(NativeReceiver):
    """Decoder for the frames of a bus, CAN 2.0 and CAN FD in any mixture.

    In CAN 2.0 a QUAT belongs to the ACC before it only if it is the first QUAT after that ACC. If either is
    lost, the sample is dropped and counted as lost; a GYR or MAG whose time differs from that of the open ACC
    reveals such a loss, too. If only a GYR or MAG is lost, its quantity is None. CAN 2.0 has no sequence
    numbers, so a sample all of whose frames are lost is not counted. Frames of other senders count as
    skipped, like INFO packets.

    `Sample.time_us` wraps at WRAP_US, the range of the 16 bit time of CAN 2.0. The longer time of CAN FD is
    reduced to this range, without a jump at its own wrap.
    """

    WRAP_US = 65536 * TICK_US

    def __init__(self, base: int = BASE) -> None:
        """Create the decoder.

        Raises:
            ValueError: the identifiers of this base do not fit in 29 bits or include SYNC.
        """
        super().__init__()
        _check_base(base)
        self._base = base
        self._extended = is_extended(base)
        self._open: dict[int, _Open] = {}
        self._acc: dict[int, tuple[int, int]] = {}  # by sensor: ticks of the last ACC, period in ticks
        self._fd_us: dict[int, int] = {}  # by sensor: unwrapped time of CAN FD

    def feed(
        self, can_id: int, data: bytes, extended: bool = False, time_s: float | None = None
    ) -> list[Sample]:
        """Return the sample that a frame completes, if any.

        Args:
            can_id: identifier.
            data: up to 8 bytes of a CAN 2.0 frame or 64 of a CAN FD frame.
            extended: whether the identifier has 29 bits.
            time_s: when the frame was on the bus, seconds on any steady clock; pass it only if the controller
                or the kernel measured it. With it, a QUAT more than half a period after its ACC is rejected;
                without it, the loss of a QUAT and of the very next ACC of its sensor cannot be detected.
        """
        self.counters.bytes += len(data)
        offset = can_id - self._base
        if extended != self._extended or not 0 <= offset < _SPAN:
            self.counters.skipped += 1
            return []
        message, sensor = offset >> 5, offset & SENSORS - 1
        if len(data) > 8:
            return self._fd(message, sensor, bytes(data))
        if message == QUAT:
            return self._close(sensor, data, time_s)
        self._vector(message, sensor, data, time_s)
        return []

    def _vector(self, message: int, sensor: int, data: bytes, time_s: float | None) -> None:
        if len(data) != _VECTOR.size:
            self._count_bad()
            return
        x, y, z, ticks = _VECTOR.unpack(data)
        open_ = self._open.get(sensor)
        if message == ACC:
            if open_ is not None and open_.ticks != ticks:
                self.counters.lost += 1  # its QUAT
            acc = (x / ACC_SCALE, y / ACC_SCALE, z / ACC_SCALE)
            self._open[sensor] = _Open(ticks, acc, arrival_s=time_s)
            last, period = self._acc.get(sensor, (ticks, 0))
            step = ticks - last & 0xFFFF
            if step:
                # The shortest recent step, because steps across lost samples are too long.
                period = min(step, period + period // 8 + 1) if period else step
            self._acc[sensor] = ticks, period
        elif open_ is None:
            self._count_bad()
        elif open_.ticks != ticks:
            # QUAT of the open sample and ACC of this one are lost; the next QUAT counts the second loss.
            del self._open[sensor]
            self.counters.lost += 1
        elif message == GYR:
            open_.gyr = (x / GYR_SCALE, y / GYR_SCALE, z / GYR_SCALE)
        else:
            open_.mag = (x / MAG_SCALE, y / MAG_SCALE, z / MAG_SCALE)

    def _close(self, sensor: int, data: bytes, time_s: float | None) -> list[Sample]:
        open_ = self._open.pop(sensor, None)
        if open_ is None:
            # Its ACC is lost, unless decoding has just begun.
            self.counters.lost += sensor in self._acc
            return []
        quat = None
        if data:
            if len(data) == _QUATERNION.size:
                w, x, y, z = _QUATERNION.unpack(data)
                quat = unit_quaternion(w / QUAT_SCALE, x / QUAT_SCALE, y / QUAT_SCALE, z / QUAT_SCALE)
            if quat is None:
                return self._count_bad()
        if time_s is not None and open_.arrival_s is not None:
            half_us = self._acc[sensor][1] * TICK_US / 2
            if (time_s - open_.arrival_s) * 1e6 > half_us > 0:
                self.counters.lost += 2  # a QUAT and an ACC
                return []
        self._count_good()
        self.counters.packets += 1
        return [Sample(sensor, open_.ticks * TICK_US, quat, open_.acc, open_.gyr, open_.mag)]

    def _fd(self, message: int, sensor: int, data: bytes) -> list[Sample]:
        try:
            size = body_size(data)
            body = decode_body(data[:size])
        except ValueError:
            return self._count_bad()
        if message or body.sensor_id != sensor or any(data[size:]):
            return self._count_bad()
        samples = self._take(body)
        if not samples or isinstance(body, Info):
            return []
        last = self._fd_us.get(sensor, body.t_us)
        now = last + ((body.t_us - last + 0x80000000) & 0xFFFFFFFF) - 0x80000000
        self._fd_us[sensor] = now
        return [samples[0]._replace(time_us=now % self.WRAP_US)]


def _encoder() -> Encode:
    def encode_sample(sample: Sample, seq: int) -> list[Frame]:
        # Keep all bits of the time: a wrap at 2^32 us would be a jump in the 16 bit time.
        packet = packet_of(sample, seq)._replace(t_us=sample.time_us or 0)
        return [(can_id, data, False, False) for can_id, data in encode(packet)]

    return encode_sample


PROTOCOL = Protocol(
    name="native-can",
    transport="can",
    default_bitrate=500_000,
    description="self-built boards: edgepose's own packet on CAN 2.0 and CAN FD",
    decoder=NativeCanDecoder,
    encoder=_encoder,
    ids=range(6),
    page="../README",
)
