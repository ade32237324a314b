"""WitMotion: types and steps that all its links have in common, and how packets become samples.

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
"""Types of packets."""

ACC_STEP = 16 * STANDARD_G / 32768
"""Step of an acceleration, m/s^2."""

GYR_STEP = radians(2000) / 32768
"""Step of an angular rate, rad/s."""

ANGLE_STEP = pi / 32768
"""Step of an angle, rad."""

QUAT_STEP = 1 / 32768
"""Step of a quaternion's component."""

DAY_US = 86_400_000_000
"""Times of samples wrap here, microseconds: devices send the time of day."""

ANGLE_NAMES = ("roll", "pitch", "yaw")
"""Angles in the order on the wire."""


class Cycle:
    """Samples out of packets that hold one quantity each and have no count.

    A device sends the packets of a cycle in the order of their types. One whose type is not above that of the
    packet before begins a new cycle. The sample goes out with the last type of the earlier cycles, or else
    when the next cycle begins. It is dropped without an acceleration or an orientation, or without a quantity
    that both cycles before had; this counts as lost.
    """

    def __init__(self, sensor: int, counters: Counters) -> None:
        """Start with nothing seen.

        Args:
            sensor: of the samples.
            counters: `packets` and `lost` are counted here.
        """
        self._sensor = sensor
        self._counters = counters
        self._values: dict[str, Any] = {}
        self._open = False  # a packet has come that is part of no sample yet
        self._top = -1  # type of the packet before
        self._end: int | None = None  # the last type of a cycle
        self._other_end = -1  # where the cycle before ended, if not there
        self._usual = CycleDetector()
        self._counted = True  # a stream that begins in the middle of a cycle has lost nothing

    def add(self, order: int, values: dict[str, Any]) -> list[Sample]:
        """Take the next packet; `order` is its type."""
        samples: list[Sample] = []
        if order <= self._top:
            if self._open and (self._end is None or self._top == self._other_end):
                self._end = self._top
            elif self._open:
                self._other_end = self._top
            samples = self._close()
            self._counted = False
        self._top = order
        if not self._open and self._end is not None and order > self._end:
            # What was taken for the end is none; the sample that this belongs to is gone.
            self._end = order
            return samples
        self._open = True
        self._values |= values
        if order == self._end:
            self._other_end = -1
            samples += self._close()
        return samples

    def cut(self) -> list[Sample]:
        """Something unreadable came: what follows can be of another cycle."""
        was_open = self._open
        samples = self._close()
        self._counted = was_open or self._end is None
        self._top = -1
        return samples

    def drop(self, order: int) -> None:
        """Take a packet that spoils its cycle."""
        self._values.clear()
        self._open = False
        self._counted = True
        self._top = order

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
        whole = self._usual.whole(values)
        if "quat" not in values or "acc" not in values or not whole:
            self._counters.lost += not counted
            return []
        self._counters.packets += 1
        return [Sample(self._sensor, **values)]


def scaled(vector: tuple[int, ...], step: float) -> Vector3:
    """A vector of whole steps in its unit."""
    x, y, z = vector
    return (x * step, y * step, z * step)


def angles_of(vector: tuple[int, ...]) -> dict[str, Any]:
    """Angles of whole steps by name, rad."""
    return {name: value * ANGLE_STEP for name, value in zip(ANGLE_NAMES, vector, strict=True)}


def vectors_of(sample: Sample, mag_ut: float, angles: bool) -> list[tuple[int, Vector3, float]]:
    """Type, values and step of what the sample has, in the order of the types."""
    turned = to_yaw_pitch_roll(sample.quat)[::-1] if angles and sample.quat is not None else None
    return [
        (kind, values, step)
        for kind, values, step in (
            (ACC, sample.acc, ACC_STEP),
            (GYR, sample.gyr, GYR_STEP),
            (ANGLES, turned, ANGLE_STEP),
            (MAG, sample.mag, mag_ut),
        )
        if values is not None
    ]


def steps_of(values: tuple[float, ...], step: float) -> list[int]:
    """Values in steps, as int16."""
    return [int16(value / step) for value in values]
