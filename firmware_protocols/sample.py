"""The output of all decoders: readings of sensors in one convention, whatever the wire format.

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
"""One g, m/s^2, for devices that send accelerations in g."""


class Sample(NamedTuple):
    """One measurement, SI units; absent quantities are None.

    Attributes:
        sensor: the device's own id on its line or bus (node id, source address, id byte); 0 if the protocol
            has none.
        time_us: device clock at the measurement, microseconds, wrapping at the decoder's WRAP_US; None if the
            device sends no time.
        quat: unit quaternion w, x, y, z (scalar first) that maps vectors from the sensor frame to an inertial
            frame with Z up.
        acc: specific force in the sensor frame, m/s^2: +9.81 on the axis that points up at rest.
        gyr: angular rate in the sensor frame, rad/s.
        mag: magnetic field in the sensor frame, uT, or in the device's own unit if it is not calibrated to
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
    """Counts of what a decoder has received since its creation.

    Attributes:
        bytes: bytes fed (CAN: data bytes).
        packets: samples returned.
        bad: invalid pieces of the input: wrong checksum, impossible length or content.
        resyncs: valid packets that directly follow bad input.
        lost: missing packets, according to the devices' counters.
        late: packets dropped as duplicates, or as older than the last one of their sensor.
        skipped: valid packets that hold no quantity of a Sample.
        restarts: restarts of a device's counter or clock, and pauses too long to count what is missing.
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
    """Return the quaternion normalised to norm 1; None if its norm is not 1 within the tolerance.

    Sensors send zeros while they start; normalising those would invent an orientation.
    """
    norm = (w * w + x * x + y * y + z * z) ** 0.5
    if not abs(norm - 1.0) <= tolerance:
        return None
    return (w / norm, x / norm, y / norm, z / norm)


def z_up(quat: Quaternion) -> Quaternion:
    """Convert a quaternion sensor -> NED to sensor -> ENU, or back: inertial (x, y, z) becomes (y, x, -z)."""
    w, x, y, z = quat
    # R_ENU_NED is a rotation by 180 degrees about (1, 1, 0) / sqrt(2).
    h = 0.5**0.5
    return (-h * (x + y), h * (w + z), h * (w - z), h * (y - x))
