"""Raw samples to oriented ones, sensor by sensor, at the sensor's own rate."""

from edgepose.orientation.estimator import Orienter, SensorStatus
from edgepose.orientation.filter import OrientationFilter
from edgepose.orientation.settings import FilterSettings
from edgepose.orientation.smoother import smooth
from edgepose.orientation.types import Event, Oriented

__all__ = [
    "Event",
    "FilterSettings",
    "OrientationFilter",
    "Oriented",
    "Orienter",
    "SensorStatus",
    "smooth",
]
