"""Orientation of whole recordings."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from edgepose.errors import EdgeposeError
from edgepose.imu import Recording, SensorData
from edgepose.orientation.filter import OrientationFilter
from edgepose.orientation.smoother import smooth
from edgepose.orientation.types import OrientationResult
from edgepose.orientation.vqf_filter import VqfFilter

_FILTERS: dict[str, Callable[..., OrientationResult]] = {
    "kalman": lambda *data: OrientationFilter().update(*data),
    "smoother": smooth,
    "vqf": lambda *data: VqfFilter().update(*data),
}


def orient_recording(recording: Recording, filter: str, name: str = "recording") -> Recording:
    """Return the recording with orientations by "kalman", "smoother" or "vqf".

    They replace the devices' own orientations in all samples with a rate and a force.

    Args:
        recording: of any number of sensors.
        filter: name of the filter.
        name: of the recording, for messages.

    Raises:
        EdgeposeError: a sensor has no rates or forces, or a package is not installed.
    """
    for sensor, data in recording.sensors.items():
        if data.gyr is None or data.acc is None:
            raise EdgeposeError(
                f"{name}: {sensor} has no rates or no forces, which --filter needs; leave it out"
            )
    sensors = {sensor: _orient(data, _FILTERS[filter]) for sensor, data in recording.sensors.items()}
    return recording._replace(sensors=sensors, metadata={**recording.metadata, "filter": filter})


def _orient(data: SensorData, run: Callable[..., OrientationResult]) -> SensorData:
    assert data.gyr is not None
    assert data.acc is not None
    rows = ~np.isnan(data.gyr[:, 0] + data.acc[:, 0])
    mag = None if data.mag is None else data.mag[rows]
    quat = np.full((len(rows), 4), np.nan) if data.quat is None else data.quat.copy()
    quat[rows] = run(data.time_s[rows], data.gyr[rows], data.acc[rows], mag).quat
    return data._replace(quat=quat)
