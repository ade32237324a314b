"""SlimeVR trackers by radio: the reports of their USB receiver, one transfer at a time.

The layout is in docs/slimevr-hid.md. A transfer is some reports of 16 bytes, each of one tracker. Numbers are
little-endian; there is no time and no angular rate.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from math import cos, pi, sin, sqrt

from firmware_protocols import rotation
from firmware_protocols._numbers import int16
from firmware_protocols._stream import Receiver
from firmware_protocols.base import Protocol, uncounted
from firmware_protocols.sample import STANDARD_G, Quaternion, Sample, Vector3, unit_quaternion

SIZE = 16
"""Length of a report, bytes."""

_INFO, _FULL, _REDUCED, _STATUS, _MAGNETIC, _RUNTIME, _DATA, _BUTTON, _REGISTER = 0, 1, 2, 3, 4, 5, 6, 7, 255
_SKIPPED = frozenset({_INFO, _STATUS, _RUNTIME, _DATA, _REGISTER})

_SHORTS = struct.Struct("<7h")
_EXPONENTIAL = struct.Struct("<I3h")
_EXPONENTIAL_AT = 5
_Q15, _ACC_STEP = 1.0 / 32768.0, 1.0 / 128.0
_UT_STEP = 100.0 / 1024.0  # 1024 to a gauss


class SlimevrHidDecoder(Receiver):
    """Decoder for the transfers of one receiver; `sensor` is the number that it gave to a tracker.

    Samples have the orientation, and the acceleration with gravity added back. Now and then a
    report with a magnetic field replaces one with an acceleration; its sample repeats the tracker's last one.
    """

    WRAP_US = 1 << 64

    def __init__(self) -> None:
        """Create the decoder."""
        super().__init__()
        self._last_acc: dict[int, Vector3] = {}  # without gravity, by tracker

    def feed(self, data: bytes) -> list[Sample]:
        """Return the samples of a transfer."""
        self.counters.bytes += len(data)
        samples: list[Sample] = []
        if not data or len(data) % SIZE:
            return self._count_bad()
        for at in range(0, len(data), SIZE):
            report = data[at : at + SIZE]
            if report[0] in _SKIPPED:
                self.counters.skipped += 1
                continue
            kind, tracker = report[:2]
            quat, (a, b, c) = _quat_and_shorts(report)
            if quat is None:
                self._count_bad()
                continue
            self._count_good()
            mag: Vector3 | None = None
            if kind == _MAGNETIC:
                mag = (a * _UT_STEP, b * _UT_STEP, c * _UT_STEP)
            else:
                self._last_acc[tracker] = (a * _ACC_STEP, b * _ACC_STEP, c * _ACC_STEP)
            acc = self._last_acc.get(tracker)
            if acc is None:
                self.counters.skipped += 1
            else:
                self._emit(Sample(tracker, None, quat, _force(quat, acc), mag=mag), samples)
        return samples


def _quat_and_shorts(report: bytes) -> tuple[Quaternion | None, Sequence[int]]:
    """Return the orientation in a report, None if it is bad, and the three numbers after it."""
    kind = report[0]
    if kind in (_FULL, _MAGNETIC):
        x, y, z, w, *shorts = _SHORTS.unpack_from(report, 2)
        return unit_quaternion(w * _Q15, x * _Q15, y * _Q15, z * _Q15), shorts
    if kind in (_REDUCED, _BUTTON):
        bits, *shorts = _EXPONENTIAL.unpack_from(report, _EXPONENTIAL_AT)
        return _from_exponential(bits), shorts
    return None, (0, 0, 0)


def _force(quat: Quaternion, acc: Vector3) -> Vector3:
    a, b, c = rotation.rotate_back(quat, (0.0, 0.0, STANDARD_G))
    return acc[0] + a, acc[1] + b, acc[2] + c


def _from_exponential(bits: int) -> Quaternion | None:
    """Return the quaternion of an exponential map: 10 bits of x, 11 of y, 11 of z, in half turns."""
    x = 2.0 * (bits & 0x3FF) / 1024.0 - 1.0
    y = 2.0 * (bits >> 10 & 0x7FF) / 2048.0 - 1.0
    z = 2.0 * (bits >> 21) / 2048.0 - 1.0
    length = sqrt(x * x + y * y + z * z)
    if length == 0.0:
        return (1.0, 0.0, 0.0, 0.0)
    half = pi / 2.0 * length
    scale = sin(half) / length
    return unit_quaternion(cos(half), scale * x, scale * y, scale * z)


def encode(sample: Sample) -> bytes:
    """Return the full report of a sample; without acceleration it has none.

    Raises:
        ValueError: the sample has no orientation, an id above 254, or a value that cannot be sent.
    """
    if sample.quat is None or not 0 <= sample.sensor < 255:
        raise ValueError("a SlimeVR report needs an orientation and an id below 255")
    w, x, y, z = sample.quat
    gravity = rotation.rotate_back(sample.quat, (0.0, 0.0, STANDARD_G))
    acc = [f - g for f, g in zip(sample.acc or gravity, gravity, strict=True)]
    shorts = [int16(q / _Q15) for q in (x, y, z, w)] + [int16(a / _ACC_STEP) for a in acc]
    return bytes([_FULL, sample.sensor]) + _SHORTS.pack(*shorts)


PROTOCOL = Protocol(
    name="slimevr-hid",
    transport="hid",
    default_bitrate=0,
    description="SlimeVR trackers by radio, through their USB receiver; ids are the receiver's",
    decoder=SlimevrHidDecoder,
    encoder=uncounted(encode),
    ids=range(6),
    common_heading=False,
    lacks=["time"],
    setup="pair them with the receiver",
    page="slimevr-hid",
)
