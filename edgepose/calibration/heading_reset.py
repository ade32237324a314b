"""Heading reset: the relative headings of sensors without a common north (DIP 4.5).

Every method returns a rotation about Z from each sensor's inertial frame to a common one. For sensors that
lie side by side that is the pelvis sensor's frame; for a known mounting and for motion of the wearer it is a
frame whose X axis points where the wearer faces.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from edgepose import rotations as rot
from edgepose.calibration.body_frame import body_from_inertial
from edgepose.calibration.checks import check_hold, tilt_deg
from edgepose.calibration.mounting import rotation_of
from edgepose.calibration.sensor_to_segment import POSES, Calibration, held_bone
from edgepose.calibration.static_pose import Hold, all_of, root_of, sensor_names
from edgepose.errors import CalibrationError
from edgepose.placements import PLACEMENTS, ROOT
from edgepose.rotations import Array

RESET_TILT_LIMIT_DEG = 15.0
MOUNTING_TILT_LIMIT_DEG = 45.0
AXIS_LIMIT_DEG = 45.0  # of an axis that should be level


class WeakMotionError(CalibrationError):
    """Motion that shows no heading; the wearer can try again with clearer movements."""


class HeadingReset(NamedTuple):
    """Heading offsets of N sensors.

    Attributes:
        offset: (N,) rotation about Z from each sensor's inertial frame to the common one, rad, -pi to pi.
        error_deg: (N,) uncertainty of each, degrees. Side by side, mounting and pose: the remaining tilt,
            which no rotation about Z can remove. Motion: RMS spread of the directions of its movements.
            Steps: estimated from the displacements.
        warnings: one line each, naming the sensor.
        names: of the sensors.
    """

    offset: Array
    error_deg: Array
    warnings: Sequence[str] = ()
    names: Sequence[str] = PLACEMENTS


def turn_about_z(measured: Array, wanted: Array) -> HeadingReset:
    """Return the rotations about Z that bring orientations (N, 4) nearest to wanted ones (N, 4) or (4,)."""
    between = rot.quat_multiply(wanted, rot.quat_conjugate(measured))
    return HeadingReset(rot.wrapped(rot.yaw_of_quat(between)), np.degrees(rot.tilt_of_quat(between)))


def headings_side_by_side(still: Hold) -> HeadingReset:
    """Reset headings (DIP 4.5) from all sensors lying side by side in one orientation.

    Raises:
        CalibrationError: a sensor moved or does not lie like the pelvis sensor; names it.
    """
    mean = check_hold(still, "leave the sensors alone and repeat the heading reset").orientation
    names = sensor_names(still)
    reset = turn_about_z(mean, mean[root_of(names)])
    if crooked := over(reset.error_deg, RESET_TILT_LIMIT_DEG, names):
        raise CalibrationError(
            f"not lying like the {PLACEMENTS[ROOT]} sensor: {crooked}; "
            f"lay {all_of(names)} side by side, same face up, same edge forward, and repeat the heading reset"
        )
    return reset._replace(names=names)


def headings_from_mounting(
    orientation: Array, mounting: Sequence[str], names: Sequence[str] = PLACEMENTS
) -> HeadingReset:
    """Reset headings from the known mounting of each sensor on a wearer who holds the calibration pose.

    Args:
        orientation: (N, 4) mean quaternions of the hold.
        mounting: N mountings, such as "x up, z back".
        names: of the sensors.

    Raises:
        CalibrationError: gravity contradicts a sensor's mounting; names it.
    """
    mounted = np.stack([rotation_of(words) for words in mounting])
    reset = turn_about_z(orientation, rot.matrix_to_quat(_facing_x().T @ mounted))
    if wrong := over(reset.error_deg, MOUNTING_TILT_LIMIT_DEG, names):
        raise CalibrationError(
            f"not mounted as the sensor map says, judged by gravity: {wrong}; "
            "is it upside down, or swapped with another one?"
        )
    return reset._replace(names=names)


def headings_from_axis(orientation: Array, axis: str, names: Sequence[str] = PLACEMENTS) -> HeadingReset:
    """Reset headings from one axis of all N sensors, such as "z" or "-x", that points forward in the pose.

    Raises:
        CalibrationError: that axis is too steep on a sensor to show a direction; names it.
    """
    sign = -1.0 if axis.startswith("-") else 1.0
    forward = sign * rot.quat_to_matrix(orientation)[:, :, "xyz".index(axis[-1])]
    slope = np.array([abs(90.0 - tilt_deg(v)) for v in forward])
    if steep := over(slope, AXIS_LIMIT_DEG, names):
        raise CalibrationError(
            f"axis {axis} does not face forward: {steep} from level; "
            "name the axis that does, or give each sensor its mounting in the sensor map"
        )
    return HeadingReset(-np.arctan2(forward[:, 1], forward[:, 0]), slope, (), names)


def headings_from_pose(calibration: Calibration, orientation: Array) -> HeadingReset:
    """Reset the headings of a calibration from its pose, which the wearer holds again.

    The offset is the rotation about Z that brings R_TI R_IS inv(R_BS) nearest to R_TB0. The direction that
    the wearer faces becomes forward.

    Args:
        calibration: of the wearer; its own heading offsets do not matter.
        orientation: (6, 4) mean quaternions as measured.
    """
    r_it = rot.quat_to_matrix(calibration.body_from_inertial).T
    wanted = r_it @ POSES[calibration.pose] @ rot.quat_to_matrix(calibration.bone_from_sensor)
    return turn_about_z(orientation, rot.matrix_to_quat(wanted))


def added_headings_from_pose(calibration: Calibration, orientation: Array) -> HeadingReset:
    """Reset the headings of the added sensors like `headings_from_pose`, from orientations (A, 4)."""
    added = calibration.added
    r_it = rot.quat_to_matrix(calibration.body_from_inertial).T
    held = np.stack([held_bone(calibration.pose, name) for name in added.names])
    wanted = rot.matrix_to_quat(r_it @ held @ rot.quat_to_matrix(added.bone_from_sensor))
    return turn_about_z(orientation, wanted)._replace(names=added.names)


def _facing_x() -> Array:
    """Return R_TI (3, 3) of a wearer who faces X of the common frame."""
    return body_from_inertial(np.zeros((len(PLACEMENTS), 4)), "heading:0")


def over(angle_deg: Array, limit_deg: float, names: Sequence[str] = PLACEMENTS) -> str:
    """List the sensors whose angle is over a limit, with the angle, for a message."""
    return ", ".join(
        f"{name} ({angle:.0f} deg)" for name, angle in zip(names, angle_deg, strict=True) if angle > limit_deg
    )
