"""Heading reset: how the inertial frames of sensors without a common north lie to each other (DIP 4.5).

Every way gives a turn about Z of each sensor's inertial frame to a common one. Sensors that lie side by side
take the pelvis sensor's; a known mounting and motion of the wearer take one whose X axis the wearer faces.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from edgepose import rotations as rot
from edgepose.calibration.body_frame import body_from_inertial
from edgepose.calibration.checks import check_hold, tilt_deg
from edgepose.calibration.mounting import rotation_of
from edgepose.calibration.sensor_to_segment import POSES, Calibration
from edgepose.calibration.static_pose import Hold
from edgepose.errors import CalibrationError
from edgepose.placements import PLACEMENTS, ROOT
from edgepose.rotations import Array

RESET_TILT_LIMIT_DEG = 15.0
MOUNTING_TILT_LIMIT_DEG = 45.0
AXIS_LIMIT_DEG = 45.0  # of an axis that should be level


class HeadingReset(NamedTuple):
    """How the headings of six sensors come together.

    Attributes:
        offset: (6,) turn about Z of each sensor's inertial frame to the common one, rad, -pi to pi.
        error_deg: (6,) how well each is determined, degrees. Side by side, mounting and pose: the tilt that
            remains, which no turn about Z can take away. Motion: RMS of the directions of its movements.
        warnings: one line each, naming the sensor.
    """

    offset: Array
    error_deg: Array
    warnings: Sequence[str] = ()


def turn_about_z(measured: Array, wanted: Array) -> HeadingReset:
    """The turns about Z that bring orientations (6, 4) nearest to wanted ones (6, 4) or (4,)."""
    between = rot.quat_multiply(wanted, rot.quat_conjugate(measured))
    yaw = rot.yaw_of_quat(between)
    tilt = 2.0 * np.arctan2(np.hypot(between[:, 1], between[:, 2]), np.hypot(between[:, 0], between[:, 3]))
    return HeadingReset(np.arctan2(np.sin(yaw), np.cos(yaw)), np.degrees(tilt))


def headings_side_by_side(still: Hold) -> HeadingReset:
    """Heading reset (DIP 4.5) from all six sensors lying side by side in one orientation.

    Raises:
        CalibrationError: a sensor moved or does not lie as the pelvis sensor does; names it.
    """
    mean = check_hold(still, "leave the sensors alone and repeat the heading reset").orientation
    reset = turn_about_z(mean, mean[ROOT])
    if crooked := _over(reset.error_deg, RESET_TILT_LIMIT_DEG):
        raise CalibrationError(
            f"not lying as the {PLACEMENTS[ROOT]} sensor does: {crooked}; "
            "lay all six side by side, same face up, same edge forward, and repeat the heading reset"
        )
    return reset


def headings_from_mounting(orientation: Array, mounting: Sequence[str]) -> HeadingReset:
    """Heading reset from how each sensor sits on a wearer who holds the calibration pose.

    Args:
        orientation: (6, 4) mean quaternions of the hold.
        mounting: six times where the axes point, such as "x up, z back".

    Raises:
        CalibrationError: gravity says that a sensor sits otherwise; names it.
    """
    sits = np.stack([rotation_of(words) for words in mounting])
    reset = turn_about_z(orientation, rot.matrix_to_quat(_facing_x().T @ sits))
    if wrong := _over(reset.error_deg, MOUNTING_TILT_LIMIT_DEG):
        raise CalibrationError(
            f"not mounted as the map of sensors says: {wrong} off by gravity; "
            "is it upside down, or swapped with another one?"
        )
    return reset


def headings_from_axis(orientation: Array, axis: str) -> HeadingReset:
    """Heading reset from one axis, such as "z" or "-x", with which each sensor faces forward in the pose.

    Raises:
        CalibrationError: that axis is steep on a sensor, and gives no direction; names it.
    """
    towards = -1.0 if axis.startswith("-") else 1.0
    forward = towards * rot.quat_to_matrix(orientation)[:, :, "xyz".index(axis[-1])]
    slope = np.array([abs(90.0 - tilt_deg(v)) for v in forward])
    if steep := _over(slope, AXIS_LIMIT_DEG):
        raise CalibrationError(
            f"axis {axis} does not face forward: {steep} from level; "
            "name the axis that does, or give each sensor its mounting in the map of sensors"
        )
    return HeadingReset(-np.arctan2(forward[:, 1], forward[:, 0]), slope)


def headings_from_pose(calibration: Calibration, orientation: Array) -> HeadingReset:
    """Heading reset of a wearer who holds the pose of the calibration again: offsets for that calibration.

    The turn about Z that brings R_TI R_IS inv(R_BS) nearest to R_TB0. The way the wearer faces becomes
    forward.

    Args:
        calibration: of the wearer; its own heading offsets do not matter.
        orientation: (6, 4) mean quaternions as measured.
    """
    r_it = rot.quat_to_matrix(calibration.body_from_inertial).T
    wanted = r_it @ POSES[calibration.pose] @ rot.quat_to_matrix(calibration.bone_from_sensor)
    return turn_about_z(orientation, rot.matrix_to_quat(wanted))


def _facing_x() -> Array:
    """R_TI (3, 3) of a wearer who faces X of the common frame."""
    return body_from_inertial(np.zeros((len(PLACEMENTS), 4)), "heading:0")


def _over(angle_deg: Array, limit_deg: float) -> str:
    """The sensors whose angle is over a limit, with it, for a message."""
    return ", ".join(
        f"{name} ({angle:.0f} deg)"
        for name, angle in zip(PLACEMENTS, angle_deg, strict=True)
        if angle > limit_deg
    )
