"""Fit of a wearer who stands still to the pose of a calibration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from itertools import permutations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.calibration.sensor_to_segment import POSES, Calibration
from edgepose.placements import PLACEMENTS
from edgepose.rotations import Array

POSE_TILT_DEG = 20.0
"""Median tilt against the calibration's pose below which a wearer counts as standing in it."""

HEADING_LIMITS_DEG = np.array([60.0 if "forearm" in name else 30.0 for name in PLACEMENTS])
"""How far headings may differ in the pose: arms are never held quite the same."""

SLIP_DEG = 30.0
"""Tilt from which on a sensor has slipped if all others fit the pose."""

FEWEST = 4
"""Fewest sensors of a rig that judge each other."""

_MOST_TURNED_DEG = np.array([100.0, 100.0, 30.0, 30.0, 90.0, 30.0])
"""The same for headings: a head looks aside, forearms twist."""


class PoseFit(NamedTuple):
    """Fit of sensors at rest to the pose of a calibration.

    Attributes:
        placements: (S,) indices of the sensors: those of the six that the rig has.
        tilt_deg: (S,) of each sensor against the pose, degrees.
        heading_deg: (S,) of each sensor against the median of all, degrees, -180 to 180.
        sits_at: (S,) index of the placement at which each sensor seems to be worn, if the sensors fit the
            pose in another order only; None if they fit in their own, or in none.
        best_tilt_deg: (S,) as `tilt_deg`, in that order; None if `sits_at` is.
        north: whether all headings count from one north, so that they can be compared.
    """

    placements: NDArray[np.intp]
    tilt_deg: Array
    heading_deg: Array
    sits_at: NDArray[np.intp] | None
    best_tilt_deg: Array | None
    north: bool

    @property
    def names(self) -> list[str]:
        """Names (S,) of the sensors."""
        return [PLACEMENTS[placement] for placement in self.placements]

    @property
    def in_pose(self) -> bool:
        """Whether the wearer stands in the pose, judged by most sensors."""
        return bool(np.median(self.tilt_deg) < POSE_TILT_DEG)

    @property
    def good(self) -> bool:
        """Whether every sensor fits the pose at its own placement."""
        return self.sits_at is None and bool(np.all(self.tilt_deg < POSE_TILT_DEG)) and self.slipped is None

    @property
    def slipped(self) -> tuple[str, float] | None:
        """The sensor that alone does not fit the pose, and how far it is off, degrees; None otherwise."""
        off = self.tilt_deg > POSE_TILT_DEG
        angle = self.tilt_deg
        if self.north and not off.any():
            off = np.abs(self.heading_deg) > _MOST_TURNED_DEG[self.placements]
            angle = np.where(off, np.abs(self.heading_deg), 0.0)
        i = int(np.argmax(angle))
        alone = self.sits_at is None and np.count_nonzero(off) == 1 and angle[i] > SLIP_DEG
        return (self.names[i], float(angle[i])) if alone and self.names[i] in telling(self.names) else None

    @property
    def off_deg(self) -> float:
        """Sum of the sensors' tilts against the pose in the order that fits best, degrees."""
        return float(np.sum(self.tilt_deg if self.best_tilt_deg is None else self.best_tilt_deg))

    @property
    def swapped(self) -> str | None:
        """A message on the misplaced sensors and where they seem to be worn; None if there are none."""
        if self.sits_at is None:
            return None
        where = ", ".join(
            f"{PLACEMENTS[sensor]} is where {PLACEMENTS[placement]} was"
            for sensor, placement in zip(self.placements, self.sits_at, strict=True)
            if sensor != placement
        )
        return f"sensors were swapped since the calibration: {where}; swap them back, or calibrate again"


def fit_pose(calibration: Calibration, orientation: Array) -> PoseFit:
    """Fit sensors at rest to the pose in which a calibration was made.

    Args:
        calibration: supposedly of the wearer; sensors that its rig lacks are not judged.
        orientation: (6, 4) mean quaternions, sensor to inertial, as measured.
    """
    worn = np.flatnonzero(~calibration.missing)
    r_it = rot.quat_to_matrix(calibration.body_from_inertial).T
    wanted = rot.matrix_to_quat(
        r_it @ POSES[calibration.pose][worn] @ rot.quat_to_matrix(calibration.bone_from_sensor[worn])
    )
    # [placement, sensor]: rotation from a sensor's orientation to the one calibrated at the placement.
    between = rot.quat_multiply(wanted[:, None], rot.quat_conjugate(orientation[worn])[None])
    tilt = np.degrees(rot.tilt_of_quat(between))
    north = calibration.compares_headings
    yaw = rot.yaw_of_quat(between) - calibration.heading_offset[worn, None]
    own = np.arange(len(worn))
    own_tilt, own_heading = tilt[own, own], from_median(-yaw[own, own])
    order = _other_order(tilt, yaw, HEADING_LIMITS_DEG[worn] if north else None)
    if order is None:
        return PoseFit(worn, own_tilt, own_heading, None, None, north)
    return PoseFit(worn, own_tilt, own_heading, worn[np.argsort(order)], tilt[own, order], north)


def _other_order(tilt: Array, yaw: Array, limits_deg: Array | None) -> NDArray[np.intp] | None:
    """Find the sensor that fits each placement; None if the order is right or no order fits.

    Args:
        tilt: (S, S) of each sensor, second, against the pose at each placement, first, degrees.
        yaw: (S, S) of the same, rad.
        limits_deg: (S,) of the headings at each placement; None if headings cannot be compared.
    """
    own = np.arange(len(tilt))

    def headings(order: NDArray[np.intp]) -> Array:
        return np.zeros(len(own)) if limits_deg is None else from_median(-yaw[own, order])

    def fits(heading: Array) -> bool:
        return limits_deg is None or not np.any(abs(heading) > limits_deg)

    if np.all(tilt[own, own] < POSE_TILT_DEG) and fits(headings(own)):
        return None
    best, least = None, math.inf
    orders = _orders(len(own))
    for order in orders[np.all(tilt[own, orders] < POSE_TILT_DEG, axis=1)]:
        heading = headings(order)
        if not fits(heading):
            continue
        cost = np.sum(tilt[own, order] ** 2) + np.sum(heading**2)
        cost += np.count_nonzero(order != own)  # prefer few swaps
        if cost < least:
            best, least = order, cost
    return None if best is None or np.all(best == own) else best


@cache
def _orders(count: int) -> NDArray[np.intp]:
    return np.array(list(permutations(range(count))))


def telling(worn: Sequence[str]) -> set[str]:
    """Return the sensors of a rig of which one that alone is off has slipped.

    A forearm is not among them if the other one is not worn: it may work for minutes while that hangs. There
    are none if no forearm is worn, or too few sensors: the others then fit other postures, too.
    """
    forearms = set(PLACEMENTS[:2])
    names = set(worn) & set(PLACEMENTS)
    if len(names) < FEWEST or not names & forearms:
        return set()
    return names if names >= forearms else names - forearms


def from_median(angles: Array) -> Array:
    """Return angles (n,), radians, relative to their median direction, in degrees from -180 to 180."""
    apart = rot.wrapped(angles[:, None] - angles)
    middle = angles[int(np.argmin(np.abs(apart).sum(axis=1)))]
    return np.degrees(rot.wrapped(angles - middle))
