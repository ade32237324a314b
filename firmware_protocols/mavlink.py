"""MAVLink 1 and 2 through pymavlink: ATTITUDE_QUATERNION with SCALED_IMU or HIGHRES_IMU.

pymavlink is an optional dependency (`pip install "edgepose[mavlink]"`), which is imported when a decoder or
an encoder is created. Layouts are in docs/mavlink.md.
"""

from __future__ import annotations

import re
from collections.abc import Container
from importlib import import_module
from typing import Any

from firmware_protocols._numbers import number, vector
from firmware_protocols._recent import BoundedDict
from firmware_protocols._sequence import count_byte
from firmware_protocols._stream import StreamDecoder
from firmware_protocols.base import Encode, Protocol
from firmware_protocols.pairing import MessagePairer
from firmware_protocols.sample import STANDARD_G, Sample, Vector3, unit_quaternion, z_up

_V1 = 0xFE
_SIGNED = 0x01
_SIGNATURE_BYTES = 13
_ATTITUDE, _SCALED, _HIGHRES = 31, 26, 105
_MG, _UT_OF_MGAUSS, _UT_OF_GAUSS = STANDARD_G / 1000, 0.1, 100.0
_WRAP_US = 1000 << 32
_HIGHRES_ACC, _HIGHRES_GYR, _HIGHRES_MAG, _HIGHRES_TEMPERATURE = 0x007, 0x038, 0x1C0, 0x1000


def _dialect() -> Any:
    try:
        return import_module("pymavlink.dialects.v20.common")
    except ImportError as error:
        raise RuntimeError(
            f'MAVLink needs pymavlink ({error}): install it with  pip install "edgepose[mavlink]"'
        ) from None


class MavlinkDecoder(StreamDecoder):
    """Decoder for a byte stream; `sensor` is sysid << 8 | compid.

    An orientation and a reading of one component whose times differ by the tolerance at most become one
    sample with the time of the orientation. If one of the two is missing, the other becomes a sample by
    itself.
    """

    WRAP_US = _WRAP_US

    _START = re.compile(rb"[\xfd\xfe]")

    def __init__(self, tolerance_us: int = 5000, imu: int | None = None) -> None:
        """Create the decoder.

        Args:
            tolerance_us: largest time difference of an orientation and a reading that belong together; keep
                it below half the sampling period.
            imu: id of the HIGHRES_IMU to use if a component has several; None if there is only one.

        Raises:
            RuntimeError: pymavlink is not installed.
        """
        super().__init__()
        dialect = _dialect()
        self._known: Container[int] = dialect.mavlink_map
        self._decode = dialect.MAVLink(None).decode
        self._decoded: Any = None
        self._imu = imu
        self._pairing = MessagePairer(self.counters, tolerance_us, _WRAP_US)
        self._sequence: BoundedDict[int, int] = BoundedDict()

    def flush(self) -> list[Sample]:
        """Return the samples that still wait for their partner, at the end of a recording."""
        return self._pairing.flush()

    def _length(self, buffer: bytes, at: int) -> int:
        head = buffer[at : at + 10]
        if head[0] == _V1:
            if len(head) < 6:
                return 0
            kind, size = head[5], head[1] + 8
        else:
            if len(head) > 2 and head[2] & ~_SIGNED:
                return -1
            if len(head) < 10:
                return 0
            kind = int.from_bytes(head[7:10], "little")
            size = head[1] + 12 + (_SIGNATURE_BYTES if head[2] else 0)
        # The checksum of an unknown message type cannot be verified.
        return size if kind in self._known else -1

    def _intact(self, buffer: bytes, at: int, length: int) -> bool:
        try:
            self._decoded = self._decode(bytearray(buffer[at : at + length]))
        except Exception:  # pymavlink's own error, and whatever else noise makes it raise
            return False
        return True

    def _message(self, frame: bytes, samples: list[Sample]) -> None:
        samples += self._take(self._decoded)

    def _take(self, message: Any) -> list[Sample]:
        sensor = message.get_srcSystem() << 8 | message.get_srcComponent()
        count = message.get_seq()
        count_byte(self.counters, self._sequence.get(sensor), count)
        self._sequence[sensor] = count

        kind = message.get_msgId()
        if kind == _ATTITUDE:
            quat = unit_quaternion(message.q1, message.q2, message.q3, message.q4)
            gyr = vector((message.rollspeed, message.pitchspeed, message.yawspeed))
            if quat is not None:
                time_us = message.time_boot_ms * 1000
                return self._pairing.add(Sample(sensor, time_us, z_up(quat), None, gyr), True)
        elif kind == _SCALED:
            return self._pairing.add(
                Sample(
                    sensor,
                    message.time_boot_ms * 1000,
                    None,
                    (message.xacc * _MG, message.yacc * _MG, message.zacc * _MG),
                    (message.xgyro / 1000, message.ygyro / 1000, message.zgyro / 1000),
                    # Without a magnetometer all are 0, a field that occurs nowhere on Earth.
                    vector((message.xmag, message.ymag, message.zmag), _UT_OF_MGAUSS)
                    if message.xmag or message.ymag or message.zmag
                    else None,
                    # 0 means no temperature; 0.00 degC is sent as 1.
                    message.temperature / 100 if message.temperature else None,
                ),
                False,
            )
        elif kind == _HIGHRES and self._imu in (None, message.id):
            has = message.fields_updated or _HIGHRES_ACC | _HIGHRES_GYR | _HIGHRES_MAG
            acc = (
                vector((message.xacc, message.yacc, message.zacc))
                if has & _HIGHRES_ACC == _HIGHRES_ACC
                else None
            )
            gyr = (
                vector((message.xgyro, message.ygyro, message.zgyro))
                if has & _HIGHRES_GYR == _HIGHRES_GYR
                else None
            )
            mag = (
                vector((message.xmag, message.ymag, message.zmag), _UT_OF_GAUSS)
                if has & _HIGHRES_MAG == _HIGHRES_MAG
                else None
            )
            temperature = number(message.temperature) if has & _HIGHRES_TEMPERATURE else None
            if acc is not None or gyr is not None:
                time_us = message.time_usec % _WRAP_US
                return self._pairing.add(Sample(sensor, time_us, None, acc, gyr, mag, temperature), False)
        self.counters.skipped += 1
        return []


class Encoder:
    """Encodes samples as messages, for simulation, with a sequence counter for each component."""

    def __init__(self, *, highres: bool = True) -> None:
        """Create the encoder; the counters start at 0.

        Args:
            highres: send readings as HIGHRES_IMU instead of SCALED_IMU, whose steps are 1 mg, 1 mrad/s and
                0.1 uT.

        Raises:
            RuntimeError: pymavlink is not installed.
        """
        self._dialect = _dialect()
        self._highres = highres
        self._components: dict[int, Any] = {}

    def encode(self, sample: Sample) -> bytes:
        """Return the messages of a sample: a reading and an orientation, those of the two that it has.

        Raises:
            ValueError: the sample has no time, only one of acceleration and angular rate, or a value that
                cannot be sent.
        """
        if sample.time_us is None or not 0 <= sample.sensor < 1 << 16:
            raise ValueError("a MAVLink message needs a time, and a sensor id of sysid << 8 | compid")
        if (sample.acc is None) != (sample.gyr is None):
            raise ValueError("a reading needs both acceleration and angular rate")
        link = self._components.get(sample.sensor)
        if link is None:
            link = self._dialect.MAVLink(None, sample.sensor >> 8, sample.sensor & 0xFF)
            self._components[sample.sensor] = link
        time_ms = sample.time_us // 1000 & 0xFFFFFFFF
        messages = []
        try:
            if sample.acc is not None and sample.gyr is not None:
                if self._highres:
                    messages.append(self._highres_imu(sample, sample.acc, sample.gyr))
                else:
                    messages.append(
                        self._dialect.MAVLink_scaled_imu_message(
                            time_ms,
                            *(round(x / _MG) for x in sample.acc),
                            *(round(x * 1000) for x in sample.gyr),
                            *(round(x / _UT_OF_MGAUSS) for x in sample.mag or (0.0, 0.0, 0.0)),
                            0 if sample.temperature is None else round(sample.temperature * 100) or 1,
                        )
                    )
            if sample.quat is not None:
                # z_up is its own inverse, up to the sign of the quaternion.
                messages.append(
                    self._dialect.MAVLink_attitude_quaternion_message(
                        time_ms, *z_up(sample.quat), *(sample.gyr or (0.0, 0.0, 0.0))
                    )
                )
            parts = []
            for message in messages:
                parts.append(bytes(message.pack(link)))
                link.seq = (link.seq + 1) % 256
        except Exception as error:  # struct.error and others from pymavlink
            raise ValueError(f"cannot send {sample}: {error}") from None
        return b"".join(parts)

    def _highres_imu(self, sample: Sample, acc: Vector3, gyr: Vector3) -> Any:
        has = _HIGHRES_ACC | _HIGHRES_GYR
        mag = sample.mag or (0.0, 0.0, 0.0)
        if sample.mag is not None:
            has |= _HIGHRES_MAG
        if sample.temperature is not None:
            has |= _HIGHRES_TEMPERATURE
        return self._dialect.MAVLink_highres_imu_message(
            sample.time_us,
            *acc,
            *gyr,
            *(x / _UT_OF_GAUSS for x in mag),
            0.0,
            0.0,
            0.0,
            sample.temperature or 0.0,
            has,
        )


def _encoder() -> Encode:
    encoder = Encoder()  # keeps its own counters
    return lambda sample, seq: encoder.encode(sample)


PROTOCOL = Protocol(
    name="mavlink",
    transport="bytes",
    default_bitrate=57600,
    description="autopilot boards: MAVLink 1 and 2; ids are system id * 256 + component id",
    decoder=MavlinkDecoder,
    encoder=_encoder,
    ids=[system << 8 | 1 for system in range(1, 7)],
    single_device=True,
    setup='attitude quaternion and an IMU message; needs `pip install "edgepose[mavlink]"`',
)
