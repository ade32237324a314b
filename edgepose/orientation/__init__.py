"""Orientation filters: raw samples to oriented ones, sensor by sensor, at the sensor's own rate.

Filters import filterpy and scipy, so the names below are imported on first use.
"""

from typing import TYPE_CHECKING

from edgepose.utils.lazy import lazy_names

if TYPE_CHECKING:
    from edgepose.orientation.estimator import OrientationEstimator, SensorStatus
    from edgepose.orientation.filter import OrientationFilter
    from edgepose.orientation.settings import FilterSettings
    from edgepose.orientation.smoother import smooth
    from edgepose.orientation.types import Event, OrientationResult

__all__ = [
    "Event",
    "FilterSettings",
    "OrientationEstimator",
    "OrientationFilter",
    "OrientationResult",
    "SensorStatus",
    "smooth",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "Event": "edgepose.orientation.types",
        "FilterSettings": "edgepose.orientation.settings",
        "OrientationFilter": "edgepose.orientation.filter",
        "OrientationResult": "edgepose.orientation.types",
        "OrientationEstimator": "edgepose.orientation.estimator",
        "SensorStatus": "edgepose.orientation.estimator",
        "smooth": "edgepose.orientation.smoother",
    },
)
