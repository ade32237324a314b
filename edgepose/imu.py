"""IMU measurements: one sample, one frame of all sensors, and whole recordings."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

FILTERS = ("none", "kalman", "vqf")
"""Orientation filters; "none" uses the orientations that the devices send."""


GRAVITY = 9.81
"""Specific force measured by a sensor at rest, m/s^2; in I along +Z."""

HOLD_PERIODS = 2.5
"""Age of a sensor's last sample, in its periods, above which its values are repetitions."""

GAP_S = 60.0
"""Silence of all sensors after which frames restart instead of repeating the last values, seconds."""


class ImuSample(NamedTuple):
    """One reading of one sensor, in SI units.

    Attributes:
        sensor: index into `edgepose.placements.SENSORS`.
        time_s: time of the measurement on the source's clock, seconds. Live sources map device clocks to Unix
            time; files keep their own times.
        quat: unit quaternion w, x, y, z, sensor frame to inertial frame I (Z up); None if the device measures
            no orientation.
        acc: specific force in the sensor frame, m/s^2 (a level sensor at rest reads +9.81 on its up axis);
            None if absent.
        gyr: angular rate in the sensor frame, rad/s; None if absent.
        mag: magnetic field in the sensor frame, uT; None if absent.
    """

    sensor: int
    time_s: float
    quat: Quaternion | None = None
    acc: Vector3 | None = None
    gyr: Vector3 | None = None
    mag: Vector3 | None = None


class AddedFrame(NamedTuple):
    """The A sensors of a rig besides the six, at one instant of the frame clock.

    Attributes:
        orientation: (A, 4) unit quaternions w, x, y, z, sensor to inertial (R_IS).
        held: (A,) bool, True for a sensor without new data, or that has not sent any yet.
        bones: (A, 3, 3) R_TB of their segments, NaN where the heading is unknown; None before calibration.
    """

    orientation: NDArray[np.float64]
    held: NDArray[np.bool_]
    bones: NDArray[np.float64] | None = None


class ImuFrame(NamedTuple):
    """All sensors at one instant of the frame clock.

    Attributes:
        index: frame number from 0, counting every tick of the clock.
        time_s: time of the tick on the source's clock, seconds.
        orientation: (6, 4) unit quaternions w, x, y, z, sensor to inertial (R_IS), in the order of
            PLACEMENTS.
        force: (6, 3) specific force averaged over the frame, inertial frame, m/s^2: (0, 0, 9.81) at rest.
        held: (6,) bool, True for a sensor without new data, whose last values are repeated.
        ready_s: time on the source's clock at which the last packet for the frame arrived, seconds.
        added: the sensors besides the six; None if the rig has no others.
    """

    index: int  # type: ignore[assignment]  # hides tuple.index, which is not needed here
    time_s: float
    orientation: NDArray[np.float64]
    force: NDArray[np.float64]
    held: NDArray[np.bool_]
    ready_s: float
    added: AddedFrame | None = None


class SensorData(NamedTuple):
    """All samples of one sensor.

    Attributes:
        time_s: (N,) times, never decreasing, seconds.
        quat: (N, 4) unit quaternions w, x, y, z, sensor to inertial; None if not measured.
        acc: (N, 3) specific force, sensor frame, m/s^2; None if not measured.
        gyr: (N, 3) angular rate, sensor frame, rad/s; None if not measured.
        mag: (N, 3) magnetic field, sensor frame, uT; None if not measured.

    A row of NaN means not measured at that time, such as by a magnetometer slower than the other sensors.
    """

    time_s: Array
    quat: Array | None = None
    acc: Array | None = None
    gyr: Array | None = None
    mag: Array | None = None


class Recording(NamedTuple):
    """A recording of the sensors of one wearer.

    Attributes:
        sensors: data by name, in the order of SENSORS.
        metadata: rate, frame, units, placements and other information from the file.
        damage: one line for the user (file, row, what to do) if part of the file was bad; the rest is here.
    """

    sensors: dict[str, SensorData]
    metadata: dict[str, str]
    damage: str | None = None
