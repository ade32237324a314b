"""Detection, during a run, of a sensor that has turned on its limb.

While the other bones say that the wearer is upright, the mean orientation of one over a stride is near that
of the straight pose, whatever the wearer does: in four hours of motion capture (sport, work, walks) no lower
leg and no pelvis stayed away from it for a minute. The bone of a sensor that has slipped does.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from edgepose import rotations as rot
from edgepose.calibration.fit import telling
from edgepose.calibration.sensor_to_segment import POSES
from edgepose.placements import PLACEMENTS
from edgepose.rotations import Array

WINDOW_S = 2.0
"""Time over which orientations are averaged, seconds: longer than a stride."""

UPRIGHT_DEG = 20.0
"""Largest mean tilt of the other bones of a wearer who is upright."""

MOST = 0.9
"""Share of the windows in which a bone must be off by more than its limit."""

_FEWEST_FRAMES = 10


class _Limit(NamedTuple):
    """From which angles on, tilt and heading in degrees, in how many windows, a bone is off."""

    tilt_deg: float
    heading_deg: float
    windows: int


_LIMITS: Mapping[str, _Limit] = {
    "left_forearm": _Limit(25.0, 35.0, 45),
    "right_forearm": _Limit(25.0, 35.0, 45),
    "left_lower_leg": _Limit(18.0, 25.0, 30),
    "right_lower_leg": _Limit(18.0, 25.0, 30),
    "head": _Limit(30.0, 35.0, 45),
    "pelvis": _Limit(15.0, 25.0, 30),
}
"""Beyond what motion capture shows: arms are bent and heads are bowed for a while, hips hardly ever."""

_STRAIGHT = POSES["straight"]
_UP = _STRAIGHT[:, 1]  # (6, 3) up in the frame of each bone
_FORWARD_SHOWN_BY = [i for i, name in enumerate(PLACEMENTS) if "forearm" not in name]


class Slip(NamedTuple):
    """A sensor that has turned on its limb.

    Attributes:
        placement: the sensor.
        angle_deg: how far, degrees, about.
        kind: "tilt" or "heading", whichever is off.
        seconds: upright time in which it was off.
    """

    placement: str
    angle_deg: float
    kind: str
    seconds: float

    @property
    def message(self) -> str:
        """The slip in one line, without the name of the sensor."""
        magnet = " (unless a magnet or iron is near)" if self.kind == "heading" else ""
        return (
            f"turned on its limb by about {self.angle_deg:.0f} deg{magnet}: for {self.seconds:.0f} s of "
            f"standing and walking its {self.kind} disagreed with all others; put it back, or calibrate again"
        )


class SlipMonitor:
    """Collects windows in which the wearer is upright, and reports each sensor that is off, once."""

    def __init__(self, north: bool, without: Sequence[str] = ()) -> None:
        """Create the monitor.

        Args:
            north: whether headings count from one north, so that they can be compared.
            without: sensors that the rig lacks, which are not judged.
        """
        self._north = north
        self._worn = [i for i, name in enumerate(PLACEMENTS) if name not in without]
        judged = telling([PLACEMENTS[i] for i in self._worn])
        self._sum = np.zeros((len(PLACEMENTS), 3, 3))
        self._frames = 0
        self._from_s: float | None = None
        # Of each sensor not reported yet: tilt, heading in degrees.
        self._windows: dict[str, deque[tuple[float, float]]] = {
            name: deque(maxlen=limit.windows) for name, limit in _LIMITS.items() if name in judged
        }

    def update(self, time_s: float, bones: Array) -> list[Slip]:
        """Return the sensors that are now found to have slipped.

        Args:
            time_s: time of a frame in which no sensor of the rig is held, seconds.
            bones: (6, 3, 3) its bones, R_TB, in the order of PLACEMENTS.
        """
        if not self._windows:
            return []  # a rig too small to judge its sensors, or all of them are reported
        if self._from_s is None or not 0.0 <= time_s - self._from_s < 2.0 * WINDOW_S:
            self._begin(time_s)
        elif time_s - self._from_s >= WINDOW_S:
            mean, frames = self._sum / max(self._frames, 1), self._frames
            self._begin(time_s)
            self._add(bones)
            return self._judge(mean) if frames >= _FEWEST_FRAMES else []
        self._add(bones)
        return []

    def _begin(self, time_s: float) -> None:
        self._from_s, self._frames = time_s, 0
        self._sum = np.zeros_like(self._sum)

    def _add(self, bones: Array) -> None:
        self._sum += bones
        self._frames += 1

    def _judge(self, mean: Array) -> list[Slip]:
        """Return the slips that a window with mean rotations (6, 3, 3) completes."""
        tilt_deg, heading_deg = _tilts_deg(mean), _headings_deg(mean, self._worn)
        slips = []
        for name, windows in list(self._windows.items()):
            i = PLACEMENTS.index(name)
            if max(tilt_deg[j] for j in self._worn if j != i) > UPRIGHT_DEG:
                continue
            windows.append((float(tilt_deg[i]), float(heading_deg[i])))
            if len(windows) == windows.maxlen and (slip := self._slip(name, np.array(windows))) is not None:
                slips.append(slip)
                del self._windows[name]
        return slips

    def _slip(self, name: str, windows: Array) -> Slip | None:
        limit, seconds = _LIMITS[name], len(windows) * WINDOW_S
        tilt, heading = windows.T
        if np.mean(tilt > limit.tilt_deg) >= MOST:
            return Slip(name, float(np.median(tilt)), "tilt", seconds)
        sided = max(np.mean(heading > limit.heading_deg), np.mean(heading < -limit.heading_deg))
        if self._north and sided >= MOST:
            return Slip(name, float(abs(np.median(heading))), "heading", seconds)
        return None


def _tilts_deg(mean: Array) -> Array:
    """Return the tilts (6,) of mean rotations (6, 3, 3) against the straight pose."""
    up = mean[:, 1]
    size = np.maximum(np.linalg.norm(up, axis=1), 1e-9)
    return np.asarray(np.degrees(np.arccos(np.clip(np.sum(up * _UP, axis=1) / size, -1.0, 1.0))))


def _headings_deg(mean: Array, worn: Sequence[int]) -> Array:
    """Return the headings (6,) of mean rotations (6, 3, 3) against those of the others of trunk and legs."""
    heading = np.exp(1j * rot.yaw_of_matrix(mean @ rot.transpose(_STRAIGHT)))
    shown_by = [j for j in _FORWARD_SHOWN_BY if j in worn]
    others = [sum(heading[j] for j in shown_by if j != i) for i in range(len(PLACEMENTS))]
    return np.asarray(np.degrees(np.angle(heading / np.array(others))))
