"""Height of the ground under the feet of a whole recording, and the correction of the path to it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edgepose.skeleton import JOINTS, forward_kinematics

Array = NDArray[np.float64]

STEP = 0.10
"""Smallest step of the ground from one stance to the next, metres; less is an error of the poses."""

STANCE_S = 0.1
"""Shortest stance, seconds."""

HEIGHT_ERROR = 0.03
"""Spread (m) of the errors of a standing ankle's height."""

CLIMB_ERROR = 0.1
"""Spread (m/s) of errors of the vertical velocity that last for a second."""

_RECENT = 4  # stances whose drift is averaged
_ANKLES = [JOINTS.index("left_ankle"), JOINTS.index("right_ankle")]


def ankle_heights(path: Array, joints: Array, offsets: Array) -> Array:
    """Return the heights (T, 2) of the ankles above those of someone who stands on ground at 0, metres.

    Args:
        path: (T, 3) of the pelvis.
        joints: (T, 24, 3) positions from the pelvis.
        offsets: (24, 3) of the body.
    """
    straight = forward_kinematics(np.tile(np.eye(3), (24, 1, 1)), offsets)[1][:, 1]
    return path[:, 1:2] + joints[:, _ANKLES, 1] - (straight[_ANKLES] - straight.min())


def ground_correction(heights: Array, standing: Array, rate: float) -> Array:
    """Return what to add to the heights (T,) so that standing ankles are on the ground, metres.

    The ground is level, except where the path climbs a step. The correction changes slowly between stances.

    Args:
        heights: (T, 2) of the ankles, see `ankle_heights`.
        standing: (T - 1, 2) 0 to 1, whether each ankle stands still between frames.
        rate: frames a second.
    """
    from scipy.linalg import solveh_banded

    stances = _stances(standing, rate)
    wanted, weight = np.zeros(len(heights)), np.zeros(len(heights))
    for (frames, foot), level in zip(stances, _levels(heights, stances), strict=True):
        share = standing[frames, foot] / HEIGHT_ERROR**2 / rate
        wanted[frames] += share * (level - heights[frames, foot])
        weight[frames] += share
    if not stances:
        return wanted
    stiffness = np.full(len(heights) - 1, rate / CLIMB_ERROR**2)
    diagonal = weight + 1e-9
    diagonal[1:] += stiffness
    diagonal[:-1] += stiffness
    correction: Array = solveh_banded(np.stack([diagonal, np.append(-stiffness, 0.0)]), wanted, lower=True)
    return correction


def _stances(standing: Array, rate: float) -> list[tuple[slice, int]]:
    """Return frames and foot of each stance, in the order of their starts."""
    stances = []
    for foot in range(2):
        edges = np.diff(np.pad((standing[:, foot] > 0.5).astype(int), 1))
        for start, stop in zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True):
            if stop - start >= STANCE_S * rate:
                stances.append((slice(int(start), int(stop)), foot))
    return sorted(stances, key=lambda stance: stance[0].start)


def _levels(heights: Array, stances: list[tuple[slice, int]]) -> list[float]:
    """Return the ground's height at each stance: that of the one before, of an earlier one, or a new one."""
    levels: list[float] = []
    drifts: list[float] = []
    for frames, foot in stances:
        height = float(np.mean(heights[frames, foot]))
        drift = float(np.mean(drifts[-_RECENT:])) if drifts else height
        ground, last = height - drift, levels[-1] if levels else 0.0
        if abs(ground - last) >= STEP:
            nearest = min(levels, key=lambda level: abs(ground - level))
            last = nearest if abs(ground - nearest) < STEP / 2.0 else ground
        levels.append(last)
        drifts.append(height - last)
    return levels
