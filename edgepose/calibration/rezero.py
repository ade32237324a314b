"""Headings of a run: as calibrated, or found anew while the wearer holds the calibration pose again.

Gyroscopes cannot keep a heading for long, and without a north a filter starts with any. The pose shows what
is missing (see `edgepose.calibration.headings_from_pose`), and the way the wearer faces becomes forward.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from edgepose import rotations as rot
from edgepose.calibration import Calibration, HeadingReset, headings_from_pose
from edgepose.errors import CalibrationError, EdgeposeError
from edgepose.imu import ImuFrame
from edgepose.placements import PLACEMENTS
from edgepose.rotations import Array

HOLD_S = 1.0
"""Length of the hold that is averaged, seconds."""

START_HOLD_S = 2.0
"""The same at the start, where filters have hardly begun and nobody waits for poses."""

SPREAD_LIMIT_DEG = 3.0
TILT_LIMIT_DEG = 20.0
"""Gravity shows that the pose is another one, or that a sensor has slipped."""

HELD_LIMIT = 0.5
"""Largest share of a hold in which a sensor may have been silent."""

BLEND_S = 1.0
"""Seconds in which new headings replace the old ones: networks know limbs that turn, none that jump."""

REPEAT_S = 5.0
"""Time between two remarks on why a start is not complete yet, seconds."""

_POSE = {"straight": "stand straight, arms hanging, palms to the thighs", "t-pose": "stand in the T-pose"}


class HeadingRezero:
    """The calibration of each frame of a run."""

    def __init__(
        self,
        calibration: Calibration,
        *,
        hold_first: bool = False,
        requests: Callable[[], list[float]] = list,
        notify: Callable[[str], None] = lambda text: None,
    ) -> None:
        """As calibrated.

        Args:
            calibration: of the wearer.
            hold_first: its headings are worth nothing; there are no poses before the first good hold.
            requests: asked at each frame for new wishes to begin a hold, in how many seconds each.
            notify: hears what the wearer has to know.
        """
        self._calibration = calibration
        self._requests, self._notify = requests, notify
        self._old: Array | None = None if hold_first else calibration.heading_offset
        self._new = calibration.heading_offset
        self._blend_from_s = -np.inf
        self._hold: list[ImuFrame] = []
        self._hold_from_s: float | None = None
        self._told_s = -np.inf
        if hold_first:
            notify(f"{_POSE[calibration.pose]}, facing forward, and hold still: poses begin after that")

    def calibration_for(self, frame: ImuFrame) -> Calibration | None:
        """The calibration for a frame; None until the first hold, if there must be one."""
        wishes = self._requests()
        if self._old is None:
            self._start(frame)
        else:
            for delay_s in wishes[-1:]:
                self._hold, self._hold_from_s = [], frame.time_s + delay_s
                wait = f"in {delay_s:g} s" if delay_s else "now"
                self._notify(f"re-zero {wait}: {_POSE[self._calibration.pose]}, facing forward")
            if self._hold_from_s is not None and frame.time_s >= self._hold_from_s:
                self._again(frame)
        return self._blended(frame.time_s)

    def _start(self, frame: ImuFrame) -> None:
        self._hold.append(frame)
        if frame.time_s - self._hold[0].time_s < START_HOLD_S:
            return
        try:
            found = _from_hold(self._calibration, self._hold)
        except EdgeposeError as error:
            del self._hold[: len(self._hold) // 4 + 1]
            if frame.time_s - self._told_s > REPEAT_S:
                self._told_s = frame.time_s
                self._notify(f"waiting for the pose: {error}")
            return
        self._hold = []
        self._old = self._new = found.offset
        self._calibration = replace(self._calibration, heading_offset=found.offset)
        self._notify(f"headings found; tilt off by {_by_sensor(found.error_deg)} deg. You can move now")

    def _again(self, frame: ImuFrame) -> None:
        self._hold.append(frame)
        if frame.time_s - self._hold[0].time_s < HOLD_S:
            return
        try:
            found = _from_hold(self._calibration, self._hold)
        except EdgeposeError as error:
            self._notify(f"headings stay as they are: {error}")
        else:
            self._old, self._new = self._calibration.heading_offset, found.offset
            self._blend_from_s = frame.time_s
            turned = np.degrees(_wrapped(self._new - self._old))
            self._notify(
                f"re-zeroed: headings turned by {_by_sensor(turned)} deg; "
                f"tilt off by {_by_sensor(found.error_deg)} deg"
            )
        self._hold, self._hold_from_s = [], None

    def _blended(self, time_s: float) -> Calibration | None:
        if self._old is None:
            return None
        if self._old is not self._new:
            share = min(max((time_s - self._blend_from_s) / BLEND_S, 0.0), 1.0)
            smooth = share * share * (3.0 - 2.0 * share)
            offset = self._old + smooth * _wrapped(self._new - self._old)
            self._calibration = replace(self._calibration, heading_offset=offset)
            if share == 1.0:
                self._old = self._new
        return self._calibration


def _from_hold(calibration: Calibration, frames: list[ImuFrame]) -> HeadingReset:
    """Heading reset from frames of the held pose.

    Raises:
        CalibrationError: the wearer moved, or gravity says that it is another pose; names the sensors.
    """
    # What a short loss repeats is no other pose.
    if silent := _names(np.mean([frame.held for frame in frames], axis=0) > HELD_LIMIT):
        raise CalibrationError(f"nothing new from {silent}")
    orientation = np.stack([frame.orientation for frame in frames])
    mean = np.stack([rot.mean_rotation(own) for own in orientation.swapaxes(0, 1)])
    away = np.linalg.norm(
        rot.quat_to_rotvec(rot.quat_multiply(rot.quat_conjugate(mean), orientation)), axis=-1
    )
    spread = np.degrees(np.sqrt(np.mean(away**2, axis=0)))
    if moved := _names(spread > SPREAD_LIMIT_DEG, spread):
        raise CalibrationError(f"moved: {moved}; hold still")
    found = headings_from_pose(calibration, mean)
    if crooked := _names(found.error_deg > TILT_LIMIT_DEG, found.error_deg):
        raise CalibrationError(
            f"another tilt than in the calibration: {crooked}; "
            "take its pose, or calibrate again if a sensor has slipped"
        )
    return found


def _names(wrong: Array | np.ndarray, angle_deg: Array | None = None) -> str:
    """The sensors that are marked, for a message."""
    return ", ".join(
        PLACEMENTS[i] if angle_deg is None else f"{PLACEMENTS[i]} {angle_deg[i]:.0f} deg"
        for i in np.flatnonzero(wrong)
    )


def _by_sensor(angle_deg: Array) -> str:
    return ", ".join(f"{name} {angle:.1f}" for name, angle in zip(PLACEMENTS, angle_deg, strict=True))


def _wrapped(angle: Array) -> Array:
    """Angles brought to -pi .. pi."""
    return np.arctan2(np.sin(angle), np.cos(angle))
