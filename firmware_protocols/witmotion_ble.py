"""WitMotion's Bluetooth sensors (WT901BLECL and relatives): frames of 20 bytes, as they come over USB too.

The layout is in docs/witmotion.md. Everything is little-endian. The frames have no checksum, so each is
accepted only when the next one follows directly.
"""

from __future__ import annotations

import re
import struct

from firmware_protocols._stream import StreamDecoder
from firmware_protocols._witmotion_cycle import (
    ACC,
    ACC_STEP,
    ANGLES,
    GYR,
    GYR_STEP,
    angles_of,
    scaled,
    steps_of,
    vectors_of,
)
from firmware_protocols.base import Protocol, uncounted
from firmware_protocols.rotation import from_angles
from firmware_protocols.sample import Sample

_SIZE = 20
_WORDS = struct.Struct("<9h")
_START_BYTE, _MEASUREMENT, _REGISTERS = 0x55, 0x61, 0x71


class WitBleDecoder(StreamDecoder):
    """Decoder for the stream of one sensor; `sensor` is always 0.

    The orientation is that of the angles, Rz(yaw) Ry(pitch) Rx(roll). The frames have no time.
    """

    WRAP_US = 1 << 64
    _START = re.compile(rb"\x55(?:[\x61\x71]|\Z)")

    def _length(self, buffer: bytes, at: int) -> int:
        if not self._possible(buffer, at, 0):
            return -1
        return _SIZE if len(buffer) >= at + _SIZE + 2 else 0

    def _possible(self, buffer: bytes, at: int, length: int) -> bool:
        return at + _SIZE >= len(buffer) or self._START.match(buffer, at + _SIZE) is not None

    def _intact(self, buffer: bytes, at: int, length: int) -> bool | None:
        return True

    def _message(self, frame: bytes, samples: list[Sample]) -> None:
        if frame[1] == _REGISTERS:  # the answer to a request
            self.counters.skipped += 1
            return
        v = _WORDS.unpack_from(frame, 2)
        angles = angles_of(v[6:9])
        quat = from_angles(angles["yaw"], angles["pitch"], angles["roll"])
        self._emit(Sample(0, None, quat, scaled(v[:3], ACC_STEP), scaled(v[3:6], GYR_STEP)), samples)

    def flush(self) -> list[Sample]:
        """Return the sample of the last frame, if it is whole."""
        samples: list[Sample] = []
        if len(self._rest) == _SIZE and self._START.match(self._rest):
            self._count_good()
            self._message(self._rest, samples)
            self._rest = b""
        return samples


def encode(sample: Sample) -> bytes:
    """Return the frame of a sample, with zeros for missing quantities."""
    words = {kind: steps_of(values, step) for kind, values, step in vectors_of(sample, 1.0, True)}
    values = [value for kind in (ACC, GYR, ANGLES) for value in words.get(kind, [0, 0, 0])]
    return bytes([_START_BYTE, _MEASUREMENT]) + _WORDS.pack(*values)


PROTOCOL = Protocol(
    name="witmotion-ble",
    transport="bytes",
    default_bitrate=115200,
    description="WitMotion's Bluetooth sensors over USB or SPP: WT901BLE, WT9011DCL",
    decoder=WitBleDecoder,
    encoder=uncounted(encode),
    single_device=True,
    lacks=("time",),
    setup="50 Hz or more",
    page="witmotion",
)
