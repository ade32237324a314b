"""Calibration from oriented sensors to bones (DIP 4.2): heading reset, body frame, bone offsets.

Frames: I inertial (Z up), S one sensor, T body (X to the wearer's left, Y up, Z forward), B one bone. Angles
are in radians, except those whose names end in `_deg`, which are for people to read.
"""

from edgepose.calibration.body_frame import body_from_inertial, check_body_frame
from edgepose.calibration.checks import HoldError, HoldSummary, MovedError, check_covered, check_hold
from edgepose.calibration.functional import EXERCISE_S, ROUTINE, headings_from_motion, routine
from edgepose.calibration.heading_reset import (
    HeadingReset,
    WeakMotionError,
    headings_from_axis,
    headings_from_mounting,
    headings_from_pose,
    headings_side_by_side,
)
from edgepose.calibration.json_format import from_json, load_calibration, save, to_json
from edgepose.calibration.mounting import mounting, mounting_warnings
from edgepose.calibration.sensor_to_segment import POSES, Calibration, apply_calibration, calibrate
from edgepose.calibration.static_pose import (
    Hold,
    SensorHold,
    all_of,
    check_reported,
    hold_from_recording,
    hold_from_samples,
    stillest_start,
    trim,
)
from edgepose.calibration.steps import STEPS_S, headings_from_steps
from edgepose.calibration.two_poses import (
    TWO_POSES,
    facing_deg,
    forward_of_raised_arms,
    t_pose_start,
    with_raised_arms,
    with_t_pose,
)
from edgepose.imu import GRAVITY

__all__ = [
    "EXERCISE_S",
    "GRAVITY",
    "POSES",
    "ROUTINE",
    "STEPS_S",
    "TWO_POSES",
    "Calibration",
    "HeadingReset",
    "Hold",
    "HoldError",
    "HoldSummary",
    "MovedError",
    "SensorHold",
    "WeakMotionError",
    "all_of",
    "apply_calibration",
    "body_from_inertial",
    "calibrate",
    "check_body_frame",
    "check_covered",
    "check_hold",
    "check_reported",
    "facing_deg",
    "forward_of_raised_arms",
    "from_json",
    "headings_from_axis",
    "headings_from_motion",
    "headings_from_mounting",
    "headings_from_pose",
    "headings_from_steps",
    "headings_side_by_side",
    "hold_from_recording",
    "hold_from_samples",
    "load_calibration",
    "mounting",
    "mounting_warnings",
    "routine",
    "save",
    "stillest_start",
    "t_pose_start",
    "to_json",
    "trim",
    "with_raised_arms",
    "with_t_pose",
]
