"""WitMotion: packet types and scales shared by all links, and the assembly of samples from packets.

Layouts are in docs/witmotion.md.
"""

from __future__ import annotations

from math import pi, radians
from typing import Any

from firmware_protocols._numbers import int16
from firmware_protocols.pairing import CycleDetector
from firmware_protocols.rotation import from_angles, to_yaw_pitch_roll
from firmware_protocols.sample import STANDARD_G, Counters, Sample, Vector3

TIME, ACC, GYR, ANGLES, MAG, QUAT, REGISTERS = 0x50, 0x51, 0x52, 0x53, 0x54, 0x59, 0x5F
"""Packet types."""

ACC_STEP = 16 * STANDARD_G / 32768
"""Step of an acceleration, m/s^2."""

GYR_STEP = radians(2000) / 32768
"""Step of an angular rate, rad/s."""

ANGLE_STEP = pi / 32768
"""Step of an angle, rad."""

QUAT_STEP = 1 / 32768
"""Step of a quaternion's component."""

DAY_US = 86_400_000_000
"""Sample times wrap here, microseconds: devices send the time of day."""

ANGLE_NAMES = ("roll", "pitch", "yaw")
"""Angles in wire order."""


class Cycle:
    """Assembles samples from packets that hold one quantity each and have no counter.

    A device sends the packets of a cycle in the order of their types. A packet whose type is not above that
    of the packet before begins a new cycle. The sample is returned with the type that ended earlier cycles,
    or else when the next cycle begins. It is dropped, and counted as lost, if it has no acceleration, no
    orientation, or lacks a quantity that both previous cycles had.
    """

    def __init__(self, sensor: int, counters: Counters) -> None:
        """Start without packets.

        Args:
            sensor: sensor id of the samples.
            counters: where to count `packets` and `lost`.
        """
        self._sensor = sensor
        self._counters = counters
        self._values: dict[str, Any] = {}
        self._open = False  # whether packets wait for the end of their cycle
        self._last_type = -1
        self._end: int | None = None  # type of the last packet of a cycle
        self._other_end = -1  # type that ended the previous cycle, if not that one
        self._completeness = CycleDetector()
        self._counted = True  # a stream that begins in the middle of a cycle has no loss to count

    def add(self, order: int, values: dict[str, Any]) -> list[Sample]:
        """Take the next packet; `order` is its position in the cycle, usually its type."""
        samples: list[Sample] = []
        if order <= self._last_type:
            if self._open and (self._end is None or self._last_type == self._other_end):
                self._end = self._last_type
            elif self._open:
                self._other_end = self._last_type
            samples = self._close()
            self._counted = False
        self._last_type = order
        if not self._open and self._end is not None and order > self._end:
            # The cycle is longer than assumed, and the sample that this packet belongs to has been returned.
            self._end = order
            return samples
        self._open = True
        self._values |= values
        if order == self._end:
            self._other_end = -1
            samples += self._close()
        return samples

    def cut(self) -> list[Sample]:
        """Close the cycle at unreadable input: what follows may belong to another cycle."""
        was_open = self._open
        samples = self._close()
        self._counted = was_open or self._end is None
        self._last_type = -1
        return samples

    def drop(self, order: int) -> None:
        """Drop the cycle of a packet whose content is invalid."""
        self._values.clear()
        self._open = False
        self._counted = True
        self._last_type = order

    def _close(self) -> list[Sample]:
        if not self._open:
            return []
        values, self._values = self._values, {}
        self._open = False
        roll, pitch, yaw = (values.pop(name, None) for name in ANGLE_NAMES)
        if "quat" not in values and roll is not None and pitch is not None and yaw is not None:
            quat = from_angles(yaw, pitch, roll)
            if quat is not None:
                values["quat"] = quat
        counted, self._counted = self._counted, True
        whole = self._completeness.is_complete(values)
        if "quat" not in values or "acc" not in values or not whole:
            self._counters.lost += not counted
            return []
        self._counters.packets += 1
        return [Sample(self._sensor, **values)]


def scaled(vector: tuple[int, ...], step: float) -> Vector3:
    """Return a vector of integer steps in its unit."""
    x, y, z = vector
    return (x * step, y * step, z * step)


def angles_of(vector: tuple[int, ...]) -> dict[str, Any]:
    """Return angles of integer steps by name, rad."""
    return {name: value * ANGLE_STEP for name, value in zip(ANGLE_NAMES, vector, strict=True)}


def vectors_of(sample: Sample, mag_ut: float, angles: bool) -> list[tuple[int, Vector3, float]]:
    """Return type, values and step of each vector that the sample has, in the order of the types."""
    roll_pitch_yaw = to_yaw_pitch_roll(sample.quat)[::-1] if angles and sample.quat is not None else None
    return [
        (kind, values, step)
        for kind, values, step in (
            (ACC, sample.acc, ACC_STEP),
            (GYR, sample.gyr, GYR_STEP),
            (ANGLES, roll_pitch_yaw, ANGLE_STEP),
            (MAG, sample.mag, mag_ut),
        )
        if values is not None
    ]


def steps_of(values: tuple[float, ...], step: float) -> list[int]:
    """Return values in steps, clamped to int16."""
    return [int16(value / step) for value in values]
