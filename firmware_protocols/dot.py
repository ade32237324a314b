"""Movella DOT (Xsens DOT): measurements as their Bluetooth service sends them, one notification at a time.

The layouts are in docs/dot.md. Everything is little-endian. A notification does not name its payload; lengths
and the unit quaternion tell those apart that have an orientation.
"""

from __future__ import annotations

import struct
from math import degrees, isfinite, radians

from firmware_protocols import rotation
from firmware_protocols._numbers import vector
from firmware_protocols._stream import Receiver
from firmware_protocols.base import Protocol, uncounted
from firmware_protocols.sample import STANDARD_G, Sample, unit_quaternion

SHORT, MEDIUM, LONG = 20, 32, 44
"""Least lengths of notifications with a quaternion; with free acceleration; with acceleration and rate."""

MEDIUM_MOST, LONG_MOST = 40, 63
"""Lengths of the characteristics, which pad shorter payloads with zeros."""

_TIME_AND_QUAT = struct.Struct("<I4f")
_VECTOR = struct.Struct("<3f")
_FORCE_AT, _RATE_AT = 20, 32


class DotDecoder(Receiver):
    """Decoder for the notifications of one sensor, one `feed` for each; `sensor` is always 0.

    The headings of several sensors have nothing in common until they are reset together.
    """

    WRAP_US = 1 << 32

    def __init__(self) -> None:
        """Create the decoder."""
        super().__init__()
        self._no_quat = 0

    @property
    def refused(self) -> str | None:
        """See `Decoder.refused`: payloads without a quaternion."""
        if self.counters.packets or not self._no_quat:
            return None
        return "its payload has no quaternion: choose Custom Mode 5 (quaternion, acceleration, rate)"

    def feed(self, data: bytes) -> list[Sample]:
        """Return the sample of a notification."""
        self.counters.bytes += len(data)
        size = len(data)
        if size != SHORT and not MEDIUM <= size <= MEDIUM_MOST and not LONG <= size <= LONG_MOST:
            return self._count_bad()
        time_us, *wxyz = _TIME_AND_QUAT.unpack_from(data)
        quat = unit_quaternion(*wxyz)
        if quat is None:
            self._no_quat += 1
            return self._count_bad()
        acc = gyr = None
        if size >= MEDIUM:
            acc = vector(_VECTOR.unpack_from(data, _FORCE_AT))
            if acc is not None and size < LONG:  # free acceleration, in the inertial frame
                acc = rotation.rotate_back(quat, (acc[0], acc[1], acc[2] + STANDARD_G))
        if size >= LONG:
            gyr = vector(_VECTOR.unpack_from(data, _RATE_AT), radians(1.0))
        if (size >= MEDIUM and acc is None) or (size >= LONG and gyr is None):
            return self._count_bad()
        self._count_good()
        samples: list[Sample] = []
        self._emit(Sample(0, time_us, quat, acc, gyr), samples)
        return samples


def encode(sample: Sample) -> bytes:
    """Return the notification of a sample: in Custom Mode 5 with acceleration and rate, otherwise shorter.

    Raises:
        ValueError: the sample has no orientation, a rate alone, or a value that cannot be sent.
    """
    if sample.quat is None:
        raise ValueError("a DOT notification needs an orientation")
    values = [*sample.quat, *(sample.acc or ()), *map(degrees, sample.gyr or ())]
    if not all(map(isfinite, values)) or (sample.gyr is not None and sample.acc is None):
        raise ValueError(f"cannot send {sample}")
    if sample.acc is not None and sample.gyr is None:
        x, y, z = rotation.rotate(sample.quat, sample.acc)
        values[4:] = x, y, z - STANDARD_G
    try:
        data = struct.pack(f"<I{len(values)}f", (sample.time_us or 0) % DotDecoder.WRAP_US, *values)
    except OverflowError as error:
        raise ValueError(f"cannot send {sample}: {error}") from None
    return data + bytes({SHORT: 0, MEDIUM: MEDIUM_MOST - MEDIUM, LONG: LONG_MOST - LONG}[len(data)])


PROTOCOL = Protocol(
    name="dot",
    transport="udp",
    default_bitrate=0,
    description="Movella DOT (Xsens DOT): its Bluetooth notifications, with --ble or as datagrams",
    decoder=DotDecoder,
    encoder=uncounted(encode),
    single_device=True,
    common_heading=False,
    setup="payload Custom Mode 5 at 60 Hz",
)
