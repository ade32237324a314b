"""Comparison of worn sensors with the calibration of their wearer."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from edgepose.calibration.fit import POSE_TILT_DEG, PoseFit, fit_pose
from edgepose.calibration.heading_reset import headings_from_pose
from edgepose.calibration.impossible import ImpossibleBones
from edgepose.calibration.same_limb import SAME_LIMB, SameLimb
from edgepose.calibration.sensor_to_segment import Calibration, apply_calibration
from edgepose.calibration.slip import SlipMonitor
from edgepose.diagnostics.sensor_health.columns import QUAT, TIME
from edgepose.diagnostics.sensor_health.rest import Rest
from edgepose.diagnostics.sensor_health.sensor import Sensor
from edgepose.placements import PLACEMENTS
from edgepose.rotations import Array

_POSE_OFF_DEG = 30.0  # sum over six sensors: accuracy with which a wearer takes the pose again
_EVERY_S = 0.1  # time between two checks of the bones


class WornComparison:
    """Sensors against a calibration, which knows how they sat in its pose.

    Attributes:
        placements: indices of the sensors that are compared: those of the six that the rig has.
    """

    def __init__(self, calibration: Calibration) -> None:
        """Create the comparison with the calibration that the wearer should have."""
        # Devices' own headings differ from those that a filter computed here.
        self._own_headings = calibration.filter == "none"
        self._calibration = calibration
        self.placements = np.flatnonzero(~calibration.missing).tolist()
        self._tilts_only = dataclasses.replace(calibration, north=False)
        self._fit: PoseFit | None = None
        self._swaps: dict[int, str] = {}
        self._off_deg = math.inf
        self._headings: dict[int, float] = {}
        self._bones = ImpossibleBones()
        self._impossible: dict[str, str] = {}
        self._slip_monitor = SlipMonitor(calibration.compares_headings, calibration.without)
        self._slips: dict[str, str] = {}
        self._same_limb = SameLimb()
        self._shared: dict[str, str] = {}
        self._next_s = -math.inf

    def compare_pose(self, resting: Mapping[int, Rest]) -> None:
        """Compare sensors at rest, by placement, whose wearer stands in the pose, or should."""
        rests = {i: resting[i] for i in self.placements}
        oriented = all(np.isfinite(rest.quat).all() for rest in rests.values()) and self._own_headings
        if not oriented and not all(np.linalg.norm(rest.acc) > 0.0 for rest in rests.values()):
            return
        calibration = self._calibration if oriented else self._tilts_only
        quats = np.tile([1.0, 0.0, 0.0, 0.0], (len(PLACEMENTS), 1))
        for i, rest in rests.items():
            quats[i] = rest.quat if oriented else level(rest.acc)
        fit = fit_pose(calibration, quats)
        if not fit.off_deg <= self._off_deg + _POSE_OFF_DEG:
            return  # the wearer has been nearer to the pose before
        self._off_deg = min(fit.off_deg, self._off_deg)
        if fit.in_pose and oriented:
            self._headings = dict(zip(self.placements, fit.heading_deg.tolist(), strict=True))
        self._swaps = {}
        if fit.sits_at is not None:
            pairs = zip(self.placements, fit.sits_at, strict=True)
            self._swaps = {i: PLACEMENTS[at] for i, at in pairs if at != i}
        elif fit.in_pose:
            off = [i for i, tilt in zip(self.placements, fit.tilt_deg, strict=True) if tilt > POSE_TILT_DEG]
            self._swaps = _swaps(calibration, quats, off)
        self._fit = fit

    def check_bones(self, sensors: Sequence[Sensor]) -> None:
        """Look for bones in impossible orientations, in the newest rows of all sensors."""
        windows = [sensors[i].window for i in self.placements]
        if not self._own_headings or not all(len(window) for window in windows):
            return
        first_s, last_s = (f(float(w[i, TIME]) for w in windows) for f, i in ((max, 0), (min, -1)))
        times = np.arange(max(first_s, self._next_s), last_s, _EVERY_S)
        if not len(times):
            return
        self._next_s = float(times[-1]) + _EVERY_S
        rows = [np.minimum(np.searchsorted(w[:, TIME], times), len(w) - 1) for w in windows]
        quats = np.tile([1.0, 0.0, 0.0, 0.0], (len(times), len(PLACEMENTS), 1))
        quats[:, self.placements] = np.stack(
            [w[row, QUAT] for w, row in zip(windows, rows, strict=True)], axis=1
        )
        unit = np.abs(np.linalg.norm(quats, axis=-1) - 1.0).max(axis=1) < 0.01
        times, quats = times[unit], quats[unit]
        bones, _ = apply_calibration(self._calibration, quats, np.zeros((*quats.shape[:2], 3)))
        missing = self._calibration.missing
        for time_s, instant, quat in zip(times.tolist(), bones, quats, strict=True):
            self._impossible |= self._bones.update(instant, missing, _EVERY_S)
            pair = self._same_limb.update(time_s, quat, missing) or ()
            self._shared |= {name: f"{' and '.join(pair)} {SAME_LIMB}" for name in pair}
            for slip in self._slip_monitor.update(time_s, instant):
                self._slips[slip.placement] = f"it has {slip.message}"

    def result(self) -> list[dict[str, Any]]:
        """Return fields for the `SensorHealth` of each sensor."""
        # A sensor that does not fit the pose makes others look impossible, too.
        impossible = self._impossible if self._fit is None or self._fit.good else {}
        impossible = self._shared or self._slips or impossible
        fields: list[dict[str, Any]] = [{"impossible": impossible.get(name)} for name in PLACEMENTS]
        if self._fit is not None:
            for i, tilt in zip(self.placements, self._fit.tilt_deg.tolist(), strict=True):
                fields[i] |= {"pose_tilt_deg": tilt, "in_pose": self._fit.in_pose}
        for i, name in self._swaps.items():
            fields[i]["swapped_with"] = name
        for i, heading in self._headings.items():
            fields[i] |= {"heading_deg": heading, "heading_on": "body"}
        return fields


def level(acc: Array) -> Array:
    """Return a quaternion (4,) that rotates an acceleration (3,) at rest upwards, with any heading."""
    x, y, z = acc / np.linalg.norm(acc)
    quat = np.array([1.0 + z, y, -x, 0.0]) if z > -1.0 + 1e-9 else np.array([0.0, 1.0, 0.0, 0.0])
    return quat / np.linalg.norm(quat)


def _swaps(calibration: Calibration, quats: Array, off: Sequence[int]) -> dict[int, str]:
    """Find for each sensor that is off the one with which it must be swapped so that both fit the pose."""
    result: dict[int, str] = {}
    for i, j in combinations(off, 2):
        swapped = quats.copy()
        swapped[[i, j]] = quats[[j, i]]
        if headings_from_pose(calibration, swapped).error_deg[[i, j]].max() < POSE_TILT_DEG:
            result[i], result[j] = PLACEMENTS[j], PLACEMENTS[i]
    return result
