"""Whether a calibration can be that of a wearer, by the pose in which they stand and by what bones can do."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import permutations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.calibration.sensor_to_segment import POSES, Calibration
from edgepose.placements import PLACEMENTS
from edgepose.rotations import Array

POSE_TILT_DEG = 20.0
"""Median tilt against the calibration's pose up to which a wearer stands in it."""

HEADING_LIMITS_DEG = np.array([60.0 if "forearm" in name else 30.0 for name in PLACEMENTS])
"""How far headings may be from each other's in the pose: arms are never held quite the same."""

_ORDERS = np.array(list(permutations(range(len(PLACEMENTS)))))

_MOST_DEG: Mapping[str, tuple[float, float]] = {
    "head": (120.0, 140.0),
    "left_lower_leg": (165.0, 130.0),
    "right_lower_leg": (165.0, 130.0),
}
"""Angles between a bone's Y (along the body) and X (to the left) and those of the pelvis that nobody exceeds.

A head nods and turns by about 120 with the whole back, a knee folds to 155, legs cross at 100. Arms reach
anywhere.
"""


class PoseFit(NamedTuple):
    """How sensors at rest fit to the pose of a calibration.

    Attributes:
        tilt_deg: (6,) of each sensor against the pose, degrees.
        heading_deg: (6,) of each sensor against the median of all, degrees, -180 to 180.
        sits_at: (6,) index of the placement at which each sensor seems to sit, if another order of them fits
            the pose and theirs does not; None if theirs does, or none.
        best_tilt_deg: (6,) as `tilt_deg`, in that order; None without one.
    """

    tilt_deg: Array
    heading_deg: Array
    sits_at: NDArray[np.intp] | None
    best_tilt_deg: Array | None

    @property
    def in_pose(self) -> bool:
        """Whether the wearer stands in the pose, as most sensors see it."""
        return bool(np.median(self.tilt_deg) < POSE_TILT_DEG)

    @property
    def good(self) -> bool:
        """Whether every sensor stands in the pose where it should."""
        return self.sits_at is None and bool(np.all(self.tilt_deg < POSE_TILT_DEG))

    @property
    def off_deg(self) -> float:
        """How far the sensors are from the pose in the order that fits best, degrees, all together."""
        return float(np.sum(self.tilt_deg if self.best_tilt_deg is None else self.best_tilt_deg))

    @property
    def exchanged(self) -> str:
        """Sensors and where they seem to sit, for a message."""
        if self.sits_at is None:
            return ""
        return ", ".join(
            f"{PLACEMENTS[sensor]} sits where {PLACEMENTS[place]} did"
            for sensor, place in enumerate(self.sits_at)
            if sensor != place
        )


def fit_pose(calibration: Calibration, orientation: Array) -> PoseFit:
    """How sensors at rest fit to the pose in which a calibration was made.

    Args:
        calibration: of the wearer, or so it is said.
        orientation: (6, 4) mean quaternions, sensor to inertial, as measured.
    """
    r_it = rot.quat_to_matrix(calibration.body_from_inertial).T
    wanted = rot.matrix_to_quat(
        r_it @ POSES[calibration.pose] @ rot.quat_to_matrix(calibration.bone_from_sensor)
    )
    # [place, sensor]: what would turn a sensor to where the place's was.
    between = rot.quat_multiply(wanted[:, None], rot.quat_conjugate(orientation)[None])
    tilt = np.degrees(
        2.0
        * np.arctan2(np.hypot(between[..., 1], between[..., 2]), np.hypot(between[..., 0], between[..., 3]))
    )
    turn = rot.yaw_of_quat(between) - calibration.heading_offset[:, None]
    places = np.arange(len(PLACEMENTS))
    own_tilt, own_heading = tilt[places, places], from_median(-turn[places, places])
    order = _other_order(calibration, tilt, turn, own_tilt, own_heading)
    if order is None:
        return PoseFit(own_tilt, own_heading, None, None)
    return PoseFit(own_tilt, own_heading, np.argsort(order), tilt[places, order])


def _other_order(
    calibration: Calibration, tilt: Array, turn: Array, own_tilt: Array, own_heading: Array
) -> NDArray[np.intp] | None:
    """For each place the sensor that fits there, if all do somewhere and not all where they should."""
    # Without a common north, headings that are reset wander: tilts alone have to tell.
    north = calibration.north and not np.any(calibration.heading_offset)
    if np.all(own_tilt < POSE_TILT_DEG) and not (north and np.any(abs(own_heading) > HEADING_LIMITS_DEG)):
        return None
    best, least = None, math.inf
    places = np.arange(len(PLACEMENTS))
    for order in _ORDERS[np.all(tilt[places, _ORDERS] < POSE_TILT_DEG, axis=1)]:
        heading = from_median(-turn[places, order])
        if north and np.any(abs(heading) > HEADING_LIMITS_DEG):
            continue
        cost = np.sum(tilt[places, order] ** 2) + (np.sum(heading**2) if north else 0.0)
        cost += np.count_nonzero(order != places)  # as few exchanges as will do
        if cost < least:
            best, least = order, cost
    return None if best is None or np.all(best == places) else best


def from_median(angles: Array) -> Array:
    """Angles (n,) in radians against their median direction, in degrees from -180 to 180."""
    apart = np.angle(np.exp(1j * (angles[:, None] - angles)))
    middle = angles[int(np.argmin(np.abs(apart).sum(axis=1)))]
    return np.degrees(np.angle(np.exp(1j * (angles - middle))))


def impossible_bones(bones: Array) -> list[str]:
    """Bones that no body can have so.

    Args:
        bones: (6, 3, 3) R_TB, in the order of PLACEMENTS.
    """
    pelvis = bones[PLACEMENTS.index("pelvis")]
    # Cosines between the axes of a bone and those of the pelvis.
    x, y = (np.einsum("sa,a->s", bones[:, :, axis], pelvis[:, axis]) for axis in (0, 1))
    result = []
    for name, (along, across) in _MOST_DEG.items():
        i = PLACEMENTS.index(name)
        if y[i] < math.cos(math.radians(along)) or x[i] < math.cos(math.radians(across)):
            result.append(name)
    return result
