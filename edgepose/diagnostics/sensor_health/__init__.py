"""Health measurements of a rig's sensors on their incoming samples; `diagnostics.rules` interprets them.

Times at rest show most: whatever its attitude, a sensor at rest measures nothing but gravity, which its
orientation rotates to (0, 0, 9.81) in the inertial frame.

Each measurement is a small class with `update`, which takes rows of numbers (see `columns`), and `result`.
`Sensor` keeps the newest rows of one sensor and passes them on; `SensorHealthMonitor` compares the sensors of
a rig.
"""

from edgepose.diagnostics.sensor_health.columns import WINDOW_S
from edgepose.diagnostics.sensor_health.health import SensorHealthMonitor
from edgepose.diagnostics.sensor_health.report import SensorHealth
from edgepose.diagnostics.sensor_health.rest import REST_ACC, REST_GYR_DEG_S, REST_S, REST_TURN_DEG

__all__ = [
    "REST_ACC",
    "REST_GYR_DEG_S",
    "REST_S",
    "REST_TURN_DEG",
    "WINDOW_S",
    "SensorHealth",
    "SensorHealthMonitor",
]
