"""Headings of a run: as calibrated, or reset while the wearer holds the calibration pose again.

Gyroscopes cannot keep a heading for long, and without a north a filter starts with an arbitrary one. The pose
shows the offsets (see `edgepose.calibration.headings_from_pose`); the direction that the wearer faces becomes
forward.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import compress

import numpy as np

from edgepose import rotations as rot
from edgepose.calibration import Calibration, HeadingReset, headings_from_pose
from edgepose.calibration.fit import fit_pose
from edgepose.calibration.heading_reset import added_headings_from_pose
from edgepose.errors import CalibrationError, EdgeposeError
from edgepose.imu import ImuFrame
from edgepose.placements import PLACEMENTS
from edgepose.rotations import Array

HOLD_S = 1.0
"""Length of the hold that is averaged, seconds."""

START_HOLD_S = 2.0
"""The same at the start, seconds: longer, as filters have not settled and there are no poses to delay."""

SPREAD_LIMIT_DEG = 3.0
TILT_LIMIT_DEG = 20.0
"""With more tilt against the calibration, the pose is another one or a sensor has slipped."""

HELD_LIMIT = 0.5
"""Largest share of a hold for which a sensor may be silent."""

BLEND_S = 1.0
"""Time over which new headings replace the old ones, seconds: the network has never seen limbs jump."""

REPEAT_S = 5.0
"""Time between two messages on why the start is not complete yet, seconds."""

_POSE = {"straight": "stand straight, arms hanging, palms to the thighs", "t-pose": "stand in the T-pose"}


class HeadingRezero:
    """Provides the calibration for each frame of a run, with headings reset on request."""

    def __init__(
        self,
        calibration: Calibration,
        *,
        hold_first: bool = False,
        requests: Callable[[], list[float]] = list,
        notify: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Start with the calibration's headings.

        Args:
            calibration: of the wearer.
            hold_first: its headings are not valid; there are no poses before the first good hold.
            requests: called at each frame; returns the delay in seconds of each newly requested hold.
            notify: called with each message for the wearer.
        """
        self._calibration = calibration
        self._requests, self._notify = requests, notify
        self._new = _headings(calibration)
        self._old: Array | None = None if hold_first else self._new
        self._blend_from_s = -np.inf
        self._hold: list[ImuFrame] = []
        self._hold_from_s: float | None = None
        self._notified_s = -np.inf
        if hold_first:
            notify(f"{_POSE[calibration.pose]}, facing forward, and hold still: poses start after that")

    def calibration_for(self, frame: ImuFrame) -> Calibration | None:
        """Return the calibration for a frame; None until the first hold, if there must be one."""
        requests = self._requests()
        if self._old is None:
            if requests:
                pose = _POSE[self._calibration.pose]
                self._notify(f"re-zero ignored: no headings have been found yet; {pose}, facing forward")
            self._first_hold(frame)
        else:
            if requests:
                self._request(frame.time_s, min(requests))
            if self._hold_from_s is not None and frame.time_s >= self._hold_from_s:
                self._later_hold(frame)
        return self._blended(frame.time_s)

    def _request(self, time_s: float, delay_s: float) -> None:
        """Plan a hold, unless an earlier one is planned: many requests must not put it off."""
        if self._hold_from_s is not None and self._hold_from_s <= time_s + delay_s:
            return
        self._hold, self._hold_from_s = [], time_s + delay_s
        wait = f"in {delay_s:g} s" if delay_s else "now"
        self._notify(f"re-zero {wait}: {_POSE[self._calibration.pose]}, facing forward")

    def _first_hold(self, frame: ImuFrame) -> None:
        self._hold.append(frame)
        if frame.time_s - self._hold[0].time_s < START_HOLD_S:
            return
        try:
            found = _from_hold(self._calibration, self._hold)
        except EdgeposeError as error:
            del self._hold[: len(self._hold) // 4 + 1]
            if frame.time_s - self._notified_s > REPEAT_S:
                self._notified_s = frame.time_s
                self._notify(f"waiting for the pose: {error}")
            return
        self._hold = []
        self._old = self._new = found.offset
        self._calibration = _with_headings(self._calibration, found.offset)
        for line in found.warnings:
            self._notify(line)
        self._notify(f"headings found; tilt off by {self._by_sensor(found.error_deg)} deg. You can move now")

    def _later_hold(self, frame: ImuFrame) -> None:
        self._hold.append(frame)
        if frame.time_s - self._hold[0].time_s < HOLD_S:
            return
        try:
            found = _from_hold(self._calibration, self._hold)
        except EdgeposeError as error:
            self._notify(f"headings stay as they are: {error}")
        else:
            self._old = _headings(self._calibration)
            self._new = np.where(np.isnan(found.offset), self._old, found.offset)
            self._blend_from_s = frame.time_s
            turned = np.where(
                np.isnan(found.error_deg), np.nan, np.degrees(rot.wrapped(self._new - self._old))
            )
            for line in found.warnings:
                self._notify(line)
            self._notify(
                f"re-zeroed: headings turned by {self._by_sensor(turned)} deg; "
                f"tilt off by {self._by_sensor(found.error_deg)} deg"
            )
        self._hold, self._hold_from_s = [], None

    def _by_sensor(self, angle_deg: Array) -> str:
        names = [*PLACEMENTS, *self._calibration.added.names]
        known = [(name, angle) for name, angle in zip(names, angle_deg, strict=True) if not np.isnan(angle)]
        return ", ".join(f"{name} {angle:.1f}" for name, angle in known)

    def _blended(self, time_s: float) -> Calibration | None:
        if self._old is None:
            return None
        if self._old is not self._new:
            share = min(max((time_s - self._blend_from_s) / BLEND_S, 0.0), 1.0)
            smooth = share * share * (3.0 - 2.0 * share)
            offset = self._old + smooth * rot.wrapped(self._new - self._old)
            # One that was unknown until now has nothing to turn from.
            offset = np.where(np.isnan(self._old), self._new, offset)
            self._calibration = _with_headings(self._calibration, offset)
            if share == 1.0:
                self._old = self._new
        return self._calibration


def _headings(calibration: Calibration) -> Array:
    """Return the heading offsets (6 + A,) of the six sensors and of the added ones."""
    return np.concatenate([calibration.heading_offset, calibration.added.heading_offset])


def _with_headings(calibration: Calibration, offset: Array) -> Calibration:
    """Return a calibration with other heading offsets (6 + A,)."""
    six = len(PLACEMENTS)
    added = (
        replace(calibration.added, heading_offset=offset[six:]) if len(offset) > six else calibration.added
    )
    return replace(calibration, heading_offset=offset[:six], added=added)


def _from_hold(calibration: Calibration, frames: list[ImuFrame]) -> HeadingReset:
    """Reset headings, offsets and errors (6 + A,), from frames of the held pose.

    An added sensor that was silent, moved or does not fit the pose costs only its own heading, then NaN.

    Raises:
        CalibrationError: the wearer moved, or gravity shows another pose; names the sensors.
    """
    worn = ~calibration.missing
    mean, spread = _still(np.stack([frame.orientation for frame in frames]))
    # Repeated values of a short dropout do no harm.
    if silent := _names(worn & (np.mean([frame.held for frame in frames], axis=0) > HELD_LIMIT)):
        raise CalibrationError(f"nothing new from {silent}")
    if moved := _names(worn & (spread > SPREAD_LIMIT_DEG), spread):
        raise CalibrationError(f"moved: {moved}; hold still")
    found = headings_from_pose(calibration, mean)
    fit = fit_pose(replace(calibration, north=False), mean)
    if fit.swapped is not None:
        raise CalibrationError(fit.swapped)
    if crooked := _names(worn & (found.error_deg > TILT_LIMIT_DEG), found.error_deg):
        raise CalibrationError(
            f"tilt differs from the calibration's: {crooked}; "
            "take its pose, or calibrate again if a sensor has slipped"
        )
    offset = np.where(worn, found.offset, calibration.heading_offset)
    added = _added_from_hold(calibration, frames)
    errors = np.concatenate([np.where(worn, found.error_deg, np.nan), added.error_deg])
    return HeadingReset(np.concatenate([offset, added.offset]), errors, added.warnings)


def _added_from_hold(calibration: Calibration, frames: list[ImuFrame]) -> HeadingReset:
    """Reset the headings (A,) of the added sensors; NaN, and a warning, where that is not possible."""
    frames_added = [frame.added for frame in frames if frame.added is not None]
    if not frames_added:
        return HeadingReset(np.zeros(0), np.zeros(0))
    mean, spread = _still(np.stack([added.orientation for added in frames_added]))
    found = added_headings_from_pose(calibration, mean)
    problems = {
        "nothing new from": np.mean([added.held for added in frames_added], axis=0) > HELD_LIMIT,
        "moved:": spread > SPREAD_LIMIT_DEG,
        "tilt differs from the calibration's:": found.error_deg > TILT_LIMIT_DEG,
    }
    bad = np.any(list(problems.values()), axis=0)
    names = calibration.added.names
    warnings = [
        f"{problem} {', '.join(compress(names, wrong))}; the others are re-zeroed"
        for problem, wrong in problems.items()
        if wrong.any()
    ]
    return HeadingReset(
        np.where(bad, np.nan, found.offset), np.where(bad, np.nan, found.error_deg), warnings, names
    )


def _still(orientation: Array) -> tuple[Array, Array]:
    """Return mean quaternions (N, 4), and spread (N,) in degrees, of orientations (T, N, 4)."""
    mean = np.stack([rot.mean_rotation(quats) for quats in orientation.swapaxes(0, 1)])
    away = np.linalg.norm(
        rot.quat_to_rotvec(rot.quat_multiply(rot.quat_conjugate(mean), orientation)), axis=-1
    )
    return mean, np.degrees(np.sqrt(np.mean(away**2, axis=0)))


def _names(wrong: Array | np.ndarray, angle_deg: Array | None = None) -> str:
    """List the marked sensors, for a message."""
    return ", ".join(
        PLACEMENTS[i] if angle_deg is None else f"{PLACEMENTS[i]} {angle_deg[i]:.0f} deg"
        for i in np.flatnonzero(wrong)
    )
