"""From oriented sensors to bones in the body frame (DIP 4.2): heading reset, body frame, bone offsets.

Frames: I inertial (Z up), S one sensor, T body (X to the wearer's left, Y up, Z forward), B one bone. Angles
are radians, except where a name ends in `_deg`: those are for a person.
"""

from edgepose.calibration.body_frame import body_from_inertial, check_body_frame
from edgepose.calibration.bones import POSES, Calibration, apply, calibrate, mounting
from edgepose.calibration.checks import GRAVITY, HoldSummary, MovedError, check_hold
from edgepose.calibration.files import from_json, load_calibration, save, to_json
from edgepose.calibration.headings import HeadingReset, heading_offsets
from edgepose.calibration.holds import (
    Hold,
    SensorHold,
    cut,
    hold_from_recording,
    hold_from_samples,
    stillest_start,
)

__all__ = [
    "GRAVITY",
    "POSES",
    "Calibration",
    "HeadingReset",
    "Hold",
    "HoldSummary",
    "MovedError",
    "SensorHold",
    "apply",
    "body_from_inertial",
    "calibrate",
    "check_body_frame",
    "check_hold",
    "cut",
    "from_json",
    "heading_offsets",
    "hold_from_recording",
    "hold_from_samples",
    "load_calibration",
    "mounting",
    "save",
    "stillest_start",
    "to_json",
]
