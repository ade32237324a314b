"""edgepose: six body-worn IMUs in, SMPL poses out.

The names in `__all__` are the public API, described in docs/python-api.md. They are imported when they are
first used: `import edgepose` loads neither torch nor numpy.
"""

from typing import TYPE_CHECKING

from edgepose.utils.lazy import lazy_names

if TYPE_CHECKING:
    from edgepose.calibration import Calibration, load_calibration
    from edgepose.config import OutputConfig, SourceConfig, WearerConfig
    from edgepose.errors import (
        CalibrationError,
        ConfigError,
        DeviceError,
        EdgeposeError,
        FileFormatError,
        ModelError,
    )
    from edgepose.formats.poses.registry import read_poses
    from edgepose.formats.recordings.registry import read_recording
    from edgepose.imu import ImuFrame, ImuSample, Recording
    from edgepose.inference.model import Model, load_model
    from edgepose.pipeline.python_api import Pipeline
    from edgepose.placements import PLACEMENTS, SENSORS
    from edgepose.pose import PoseFrame
    from edgepose.sinks.base import Sink
    from edgepose.sinks.bvh import BvhSink
    from edgepose.sinks.csv import CsvSink
    from edgepose.sinks.glb import GlbSink
    from edgepose.sinks.lsl import LslSink
    from edgepose.sinks.mocopi import MocopiSink
    from edgepose.sinks.npz import NpzSink
    from edgepose.sinks.opensim import MotSink, StoSink
    from edgepose.sinks.udp import UdpSink
    from edgepose.sinks.vmc import VmcSink
    from edgepose.sinks.vrchat import VrchatSink
    from edgepose.skeleton import JOINTS
    from edgepose.sources import open_source

__version__ = "0.1.0"

_MODULES = {
    "BvhSink": "edgepose.sinks.bvh",
    "Calibration": "edgepose.calibration",
    "CalibrationError": "edgepose.errors",
    "ConfigError": "edgepose.errors",
    "CsvSink": "edgepose.sinks.csv",
    "DeviceError": "edgepose.errors",
    "EdgeposeError": "edgepose.errors",
    "FileFormatError": "edgepose.errors",
    "GlbSink": "edgepose.sinks.glb",
    "ImuFrame": "edgepose.imu",
    "ImuSample": "edgepose.imu",
    "JOINTS": "edgepose.skeleton",
    "LslSink": "edgepose.sinks.lsl",
    "MocopiSink": "edgepose.sinks.mocopi",
    "Model": "edgepose.inference.model",
    "ModelError": "edgepose.errors",
    "MotSink": "edgepose.sinks.opensim",
    "NpzSink": "edgepose.sinks.npz",
    "OutputConfig": "edgepose.config",
    "PLACEMENTS": "edgepose.placements",
    "Pipeline": "edgepose.pipeline.python_api",
    "PoseFrame": "edgepose.pose",
    "Recording": "edgepose.imu",
    "SENSORS": "edgepose.placements",
    "Sink": "edgepose.sinks.base",
    "SourceConfig": "edgepose.config",
    "StoSink": "edgepose.sinks.opensim",
    "UdpSink": "edgepose.sinks.udp",
    "VmcSink": "edgepose.sinks.vmc",
    "VrchatSink": "edgepose.sinks.vrchat",
    "WearerConfig": "edgepose.config",
    "load_calibration": "edgepose.calibration",
    "load_model": "edgepose.inference.model",
    "open_source": "edgepose.sources",
    "read_poses": "edgepose.formats.poses.registry",
    "read_recording": "edgepose.formats.recordings.registry",
}

__all__ = [
    "JOINTS",
    "PLACEMENTS",
    "SENSORS",
    "BvhSink",
    "Calibration",
    "CalibrationError",
    "ConfigError",
    "CsvSink",
    "DeviceError",
    "EdgeposeError",
    "FileFormatError",
    "GlbSink",
    "ImuFrame",
    "ImuSample",
    "LslSink",
    "MocopiSink",
    "Model",
    "ModelError",
    "MotSink",
    "NpzSink",
    "OutputConfig",
    "Pipeline",
    "PoseFrame",
    "Recording",
    "Sink",
    "SourceConfig",
    "StoSink",
    "UdpSink",
    "VmcSink",
    "VrchatSink",
    "WearerConfig",
    "load_calibration",
    "load_model",
    "open_source",
    "read_poses",
    "read_recording",
]

__getattr__, __dir__ = lazy_names(__name__, _MODULES)
