"""Raw samples to oriented ones, sensor by sensor, at the sensor's own rate."""

from edgepose.orientation.filter import OrientationFilter
from edgepose.orientation.orienter import Orienter, SensorStatus
from edgepose.orientation.result import Event, Oriented
from edgepose.orientation.settings import FilterSettings
from edgepose.orientation.smoother import smooth

__all__ = [
    "Event",
    "FilterSettings",
    "OrientationFilter",
    "Oriented",
    "Orienter",
    "SensorStatus",
    "smooth",
]
