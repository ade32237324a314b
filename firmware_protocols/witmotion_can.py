"""WitMotion on CAN: frames that hold one quantity each.

Layouts are in docs/witmotion.md. Everything is little-endian.
"""

from __future__ import annotations

import struct
from math import pi, radians
from typing import Any

from firmware_protocols._recent import BoundedDict
from firmware_protocols._stream import Receiver
from firmware_protocols._witmotion_cycle import (
    ACC,
    ACC_STEP,
    ANGLE_NAMES,
    ANGLES,
    DAY_US,
    GYR,
    GYR_STEP,
    MAG,
    TIME,
    Cycle,
    angles_of,
    scaled,
    steps_of,
    vectors_of,
)
from firmware_protocols.base import Protocol, uncounted_can
from firmware_protocols.sample import CanFrame, Sample

_CAN = struct.Struct("<BB3h")
_CAN_ANGLE = struct.Struct("<BBBxi")


class WitCanDecoder(Receiver):
    """Decoder for CAN frames; `sensor` is the identifier of the device.

    The orientation is that of the angles: a quaternion does not fit into a frame and lacks its last
    component. The frames have neither counter nor time. If one or more whole cycles of consecutive frames of
    a device are lost, quantities of different cycles are combined, which cannot be detected.

    Attributes:
        counters: counts of everything decoded so far; `lost` counts incomplete cycles.
    """

    WRAP_US = DAY_US

    def __init__(self, *, fine_angles: bool = False, mag_ut: float = 1.0) -> None:
        """Create the decoder.

        Args:
            fine_angles: whether each angle comes in its own frame, as from high-precision devices (HWT9073).
            mag_ut: microtesla per step of the magnetic field, which depends on the model. With 1 the field
                is in steps.
        """
        super().__init__()
        self._fine_angles = fine_angles
        self._mag_ut = mag_ut
        self._cycles: BoundedDict[tuple[int, bool], Cycle] = BoundedDict()

    def feed(self, can_id: int, data: bytes, extended: bool = False) -> list[Sample]:
        """Return the samples that this frame completes."""
        self.counters.bytes += len(data)
        if len(data) != 8 or data[0] != 0x55 or not (TIME <= data[1] <= 0x5A):
            self.counters.skipped += 1
            return []
        cycle = self._cycles.get((can_id, extended)) or Cycle(can_id, self.counters)
        self._cycles[can_id, extended] = cycle
        _, kind, x, y, z = _CAN.unpack(data)
        order = kind * 4
        values: dict[str, Any]
        if kind == ACC:
            values = {"acc": scaled((x, y, z), ACC_STEP)}
        elif kind == GYR:
            values = {"gyr": scaled((x, y, z), GYR_STEP)}
        elif kind == MAG:
            values = {"mag": scaled((x, y, z), self._mag_ut)}
        elif kind != ANGLES:
            values = {}
        elif not self._fine_angles:
            values = angles_of((x, y, z))
        else:
            _, _, axis, angle = _CAN_ANGLE.unpack(data)
            if not 1 <= axis <= 3:
                return self._count_bad()
            order += axis
            values = {ANGLE_NAMES[axis - 1]: radians(angle / 1000)}
        self._count_good()
        return cycle.add(order, values)


def encode_can(sample: Sample, *, fine_angles: bool = False, mag_ut: float = 1.0) -> list[CanFrame]:
    """Return the CAN frames of one cycle, with the quantities that the sample has.

    Identifiers above 0x7FF are extended.
    """
    frames = []
    for kind, values, step in vectors_of(sample, mag_ut, True):
        if kind == ANGLES and fine_angles:
            for axis, value in enumerate(values):
                frames.append(_CAN_ANGLE.pack(0x55, kind, axis + 1, round(value * 180_000 / pi)))
        else:
            frames.append(_CAN.pack(0x55, kind, *steps_of(values, step)))
    return [(sample.sensor, data, sample.sensor > 0x7FF) for data in frames]


PROTOCOL = Protocol(
    name="witmotion-can",
    transport="can",
    default_bitrate=250_000,
    description="WitMotion on CAN; ids are CAN ids",
    decoder=WitCanDecoder,
    encoder=uncounted_can(encode_can),
    ids=range(0x50, 0x56),
    lacks=("time",),
    setup="an identifier each",
    page="witmotion",
)
