"""What every decoder gives: one reading of one sensor in one convention, whatever the wire says.

`base.Decoder` is the interface of the decoders.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

CanFrame = tuple[int, bytes, bool]
"""Identifier, data, whether the identifier has 29 bits."""

STANDARD_G = 9.80665
"""One g of devices that send accelerations in g, m/s^2."""


class Sample(NamedTuple):
    """One measurement, SI units; absent quantities are None.

    Attributes:
        sensor: the device's own id on its line or bus (node id, source address, id byte); 0 where the
            protocol has none.
        time_us: device clock at the measurement, microseconds, wrapping at the decoder's WRAP_US; None where
            the device sends no time.
        quat: unit quaternion w, x, y, z (scalar first) that turns vectors of the sensor frame into an
            inertial frame with Z up.
        acc: specific force in the sensor frame, m/s^2: +9.81 on the axis that points up at rest.
        gyr: angular rate in the sensor frame, rad/s.
        mag: magnetic field in the sensor frame, uT, or in the device's own unit where it is not calibrated to
            uT.
        temperature: degC.
    """

    sensor: int
    time_us: int | None = None
    quat: Quaternion | None = None
    acc: Vector3 | None = None
    gyr: Vector3 | None = None
    mag: Vector3 | None = None
    temperature: float | None = None


@dataclass
class Counters:
    """What a decoder has seen since it was made.

    Attributes:
        bytes: bytes fed (CAN: data bytes).
        packets: samples returned.
        bad: pieces of the input that were no valid packet: wrong checksum, impossible length or content.
        resyncs: times a good packet followed one or more bad ones.
        lost: packets missing by the devices' own counts.
        late: packets dropped as duplicates or older than their sensor's last one.
        skipped: intact packets that hold nothing for a Sample.
        restarts: times a device's count and clock began anew, or paused too long to count what is missing.
    """

    bytes: int = 0
    packets: int = 0
    bad: int = 0
    resyncs: int = 0
    lost: int = 0
    late: int = 0
    skipped: int = 0
    restarts: int = 0


def unit_quaternion(w: float, x: float, y: float, z: float, tolerance: float = 0.1) -> Quaternion | None:
    """The quaternion at norm 1, or None if its norm is further than the tolerance from 1 or not a number.

    Sensors that are starting send zeros; normalising those would invent an orientation.
    """
    norm = (w * w + x * x + y * y + z * z) ** 0.5
    if not abs(norm - 1.0) <= tolerance:
        return None
    return (w / norm, x / norm, y / norm, z / norm)


def z_up(quat: Quaternion) -> Quaternion:
    """A quaternion sensor -> NED made sensor -> ENU: (x, y, z) becomes (y, x, -z) on the inertial side."""
    w, x, y, z = quat
    # R_ENU_NED is a half turn about (1, 1, 0) / sqrt(2).
    h = 0.5**0.5
    return (-h * (x + y), h * (w + z), h * (w - z), h * (y - x))
