"""Orientations for whole recordings."""

from __future__ import annotations

from collections.abc import Callable

from edgepose.errors import EdgeposeError
from edgepose.orientation.filter import OrientationFilter
from edgepose.orientation.result import Oriented
from edgepose.orientation.smoother import smooth
from edgepose.orientation.vqf_filter import VqfFilter
from edgepose.recording import Recording, SensorData

_FILTERS: dict[str, Callable[..., Oriented]] = {
    "kalman": lambda *data: OrientationFilter().update(*data),
    "smoother": smooth,
    "vqf": lambda *data: VqfFilter().update(*data),
}


def orient_recording(recording: Recording, filter: str) -> Recording:
    """The recording with orientations by "kalman", "smoother" or "vqf" in the place of any that it had.

    Raises:
        EdgeposeError: a sensor has no rates or forces, or a package is not installed.
    """
    sensors = {name: _orient(name, data, _FILTERS[filter]) for name, data in recording.sensors.items()}
    return recording._replace(sensors=sensors, metadata={**recording.metadata, "filter": filter})


def _orient(name: str, data: SensorData, run: Callable[..., Oriented]) -> SensorData:
    if data.gyr is None or data.acc is None:
        raise EdgeposeError(f"{name} has no rates or no forces to make orientations of; leave out --filter")
    return data._replace(quat=run(data.time_s, data.gyr, data.acc, data.mag).quat)
