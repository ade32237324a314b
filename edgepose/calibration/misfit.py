"""Detection, during a run, of a calibration that does not belong to the wearer."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.calibration import Calibration
from edgepose.calibration.fit import PoseFit, fit_pose
from edgepose.calibration.impossible import ImpossibleBones
from edgepose.calibration.same_limb import SAME_LIMB, SameLimb
from edgepose.calibration.slip import Slip, SlipMonitor
from edgepose.imu import ImuFrame
from edgepose.rotations import Array

START_S = 20.0
"""Time from the start within which the wearer should stand still in the pose, seconds."""

REST_S, REST_DEG = 1.5, 3.0
"""The wearer stands still if no sensor turns by more than `REST_DEG` for `REST_S`."""

STRANGE_DEG = 60.0
"""Tilt of one sensor against the pose that a sloppy stance does not explain."""

UPSIDE_DOWN_DEG = 120.0
"""Tilt of one sensor from which on it is upside down rather than slipped."""

COMPARE_S = 2.0
"""Time after which the rig is compared with the calibration's: all sensors have reported by then."""

_EVERY_S = 0.5


class MisfitDetector:
    """Checks frames against the calibration and warns of each problem once.

    Attributes:
        slips: sensors that have turned on their limbs, as far as found.
    """

    def __init__(self, calibration: Calibration, compare: Callable[[], list[str]] = list) -> None:
        """Create the detector.

        Args:
            calibration: of the run.
            compare: called once; returns a line on each other difference from when the calibration was made.
        """
        self._calibration, self._compare = calibration, compare
        self._worn = ~calibration.missing
        self._start_s: float | None = None
        self._next_s = -np.inf
        self._frames: deque[ImuFrame] = deque()  # of the last REST_S
        self._looking = True
        self._compared = False
        self._rest: Array | None = None  # the newest one that was compared with the pose
        self._nearest: PoseFit | None = None  # of the rests so far
        self._warned_no_pose = False
        self._impossible = ImpossibleBones()
        self._same_limb = SameLimb()
        self._slip_monitor = SlipMonitor(calibration.compares_headings, calibration.without)
        self.slips: list[Slip] = []
        self._swapped = False
        self._explained = False  # whether a reported swap or slip explains impossible bones

    def update(self, frame: ImuFrame, bones: Array) -> list[str]:
        """Return the warnings that a frame gives rise to, one line each.

        Args:
            frame: as measured.
            bones: (6, 3, 3) its bones, R_TB.
        """
        if self._start_s is None:
            self._start_s = frame.time_s
        if self._looking:
            self._frames.append(frame)
            while self._frames[0].time_s < frame.time_s - REST_S:
                self._frames.popleft()
        complete = not (True in frame.held.tolist() and (frame.held & self._worn).any())
        lines = self._check_slips(frame, bones) if complete else []
        if frame.time_s < self._next_s:
            return lines
        self._next_s = frame.time_s + _EVERY_S
        passed_s = frame.time_s - self._start_s
        lines += self._check_bones(frame, bones)
        if complete and (pair := self._same_limb.update(frame.time_s, frame.orientation, ~self._worn)):
            lines.append(f"warning: {' and '.join(pair)} {SAME_LIMB}")
        if not self._compared and passed_s >= COMPARE_S:
            lines += self._comparison()
        if self._looking:
            lines += self._check_pose(passed_s)
        return lines

    def at_end(self) -> list[str]:
        """Return the warnings that are left after the last frame."""
        lines = [] if self._compared else self._comparison()
        return lines + (self._no_pose() if self._looking else [])

    def _comparison(self) -> list[str]:
        self._compared = True
        return [f"warning: {line}" for line in self._compare()]

    def _check_slips(self, frame: ImuFrame, bones: Array) -> list[str]:
        found = self._slip_monitor.update(frame.time_s, bones)
        if not found or self._swapped:
            return []
        self.slips += found
        self._explained = True  # one wrong sensor makes others look impossible, too
        known = self._nearest.slipped if self._warned_no_pose and self._nearest is not None else None
        return [
            f"warning: {slip.placement} has {slip.message}"
            for slip in found
            if known is None or slip.placement != known[0]
        ]

    def _check_bones(self, frame: ImuFrame, bones: Array) -> list[str]:
        if self._explained:
            return []
        wrong: dict[str, list[str]] = {}
        for name, problem in self._impossible.update(bones, frame.held, _EVERY_S).items():
            wrong.setdefault(problem, []).append(name)
        if wrong and self._nearest is not None and self._nearest.slipped is not None:
            self._explained = True  # one wrong sensor, such as that of the pelvis, makes others look wrong
            return self._no_pose()
        return [f"warning: {', '.join(names)}: {problem}" for problem, names in wrong.items()]

    def _check_pose(self, passed_s: float) -> list[str]:
        worn, newest = self._worn, self._frames[-1].orientation
        lasts = self._rest is not None and _turned_deg(self._rest, newest, worn) < REST_DEG
        rest = None if lasts else _rest(self._frames, worn)
        if rest is not None:
            self._rest = rest
            fit = fit_pose(self._calibration, rest)
            self._looking = fit.swapped is None and not fit.good
            if fit.swapped is not None:
                self._explained = self._swapped = True
                return [f"warning: {fit.swapped}"]
            if self._nearest is None or fit.off_deg < self._nearest.off_deg:
                self._nearest = fit
        return self._no_pose() if self._looking and passed_s > START_S else []

    def _no_pose(self) -> list[str]:
        nearest, warned = self._nearest, self._warned_no_pose
        self._warned_no_pose = True
        if not warned and nearest is not None and nearest.slipped is not None:
            return [f"warning: {_slip(*nearest.slipped)}"]
        if warned or nearest is None or (nearest.in_pose and nearest.tilt_deg.max() < STRANGE_DEG):
            return []
        tilt = ", ".join(f"{n} {angle:.0f}" for n, angle in zip(nearest.names, nearest.tilt_deg, strict=True))
        return [
            f"warning: the wearer has not stood still in the calibration's pose (tilt off by {tilt} deg); if "
            "they have, the calibration is of another wearer or rig: calibrate again"
        ]


def _slip(name: str, angle_deg: float) -> str:
    """Return the message about the only sensor that does not sit as calibrated."""
    off = f"{name} is turned by {angle_deg:.0f} deg against the calibration, while all others fit"
    if angle_deg > UPSIDE_DOWN_DEG:
        return f"{off}: it sits upside down; turn it round, or calibrate again"
    return f"{off}: if the wearer stood in its pose, the sensor has slipped; put it back, or calibrate again"


def _rest(frames: deque[ImuFrame], worn: NDArray[np.bool_]) -> Array | None:
    """Mean orientations (6, 4) of frames in which none of the worn sensors turned; None if one did."""
    silent = np.any([frame.held for frame in frames], axis=0)[worn].any()
    if silent or frames[-1].time_s - frames[0].time_s < REST_S - _EVERY_S:
        return None
    # A cheap check that catches most motion.
    if _turned_deg(frames[0].orientation, frames[-1].orientation, worn) > REST_DEG:
        return None
    orientation = np.stack([frame.orientation for frame in frames])
    mean = np.stack([rot.mean_rotation(quats) for quats in orientation.swapaxes(0, 1)])
    return mean if _turned_deg(mean, orientation, worn) < REST_DEG else None


def _turned_deg(one: Array, other: Array, worn: NDArray[np.bool_]) -> float:
    """Return the largest angle, degrees, between orientations (..., 6, 4) of the worn sensors."""
    return float(np.degrees(rot.angle_between_quats(one, other)[..., worn].max()))
