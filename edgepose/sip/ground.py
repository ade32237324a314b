"""Height of the ground under the feet of a whole recording, and the correction of the path to it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edgepose.skeleton import JOINTS, forward_kinematics

Array = NDArray[np.float64]

STEP = 0.14
"""Smallest step of the ground from one stance to the next, metres; less is an error of the poses."""

DRIFT = 0.4
"""Largest vertical velocity, m/s, of a path that drifts while no foot stands for longer than a step takes."""

STRIDE_S = 0.3
"""Time without a stance after which a path drifts, seconds."""

STANCE_S = 0.1
"""Shortest stance, seconds."""

HEIGHT_ERROR = 0.03
"""Spread (m) of the errors of a standing ankle's height."""

ACCELERATION_ERROR = 0.5
"""Spread (m/s^2) of errors of the vertical acceleration that last for a second."""

CLIMB_ERROR = 1.0
"""Spread (m/s) of errors of the vertical velocity that last for a second."""

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


def grounded(
    path: Array, heights: Array, acceleration: Array, standing: Array, rate: float, steps: bool = True
) -> Array:
    """Return the height of the pelvis (T,) with which standing ankles are on the ground, metres.

    By least squares: its second difference is the acceleration, ankles that stand are as high as the ground,
    and between stances it moves like the path.

    Args:
        path: (T,) estimated height of the pelvis, which drifts.
        heights: (T, 2) of the ankles with this path, see `ankle_heights`.
        acceleration: (T,) upward acceleration of the pelvis, m/s^2; NaN where it is unknown.
        standing: (T - 1, 2) 0 to 1, whether each ankle stands still between frames.
        rate: frames a second.
        steps: whether the ground may have steps; where stances are only guessed, it would climb errors.
    """
    from scipy.linalg import solveh_banded

    frames = len(path)
    stances = _stances(standing, rate)
    if not stances:
        return path
    # The unknown is the correction of the path.
    weight, right = np.full(frames, 1e-9), np.zeros(frames)
    levels = _levels(heights, stances, rate) if steps else [0.0] * len(stances)
    for (rows, foot), level in zip(stances, levels, strict=True):
        share = standing[rows, foot] / HEIGHT_ERROR**2
        weight[rows] += share
        right[rows] += share * (level - heights[rows, foot])
    band = np.zeros((3, frames))
    band[0] = weight
    climb = rate**2 / CLIMB_ERROR**2
    band[0, 1:] += climb
    band[0, :-1] += climb
    band[1, :-1] -= climb
    change = rate**2 * (path[2:] - 2.0 * path[1:-1] + path[:-2])
    known = np.isfinite(acceleration[1:-1])
    stiffness = np.where(known, rate**4 / ACCELERATION_ERROR**2, 0.0)
    force = stiffness * np.where(known, acceleration[1:-1] - change, 0.0) / rate**2
    for shift, factor in enumerate((1.0, -2.0, 1.0)):
        rows = slice(shift, frames - 2 + shift)
        band[0, rows] += factor**2 * stiffness
        right[rows] += factor * force
    band[1, :-2] -= 2.0 * stiffness
    band[1, 1:-1] -= 2.0 * stiffness
    band[2, :-2] += stiffness
    return path + np.asarray(solveh_banded(band, right, lower=True))


def _stances(standing: Array, rate: float) -> list[tuple[slice, int]]:
    """Return frames and foot of each stance, in the order of their starts."""
    stances = []
    for foot in range(2):
        edges = np.diff(np.pad((standing[:, foot] > 0.5).astype(int), 1))
        for start, stop in zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True):
            if stop - start >= STANCE_S * rate:
                stances.append((slice(int(start), int(stop)), foot))
    return sorted(stances, key=lambda stance: stance[0].start)


def _levels(heights: Array, stances: list[tuple[slice, int]], rate: float) -> list[float]:
    """Return the ground's height at each stance: that of the one before, of an earlier one, or a new one."""
    levels: list[float] = []
    drift, end = 0.0, 0
    for frames, foot in stances:
        height = float(np.mean(heights[frames, foot]))
        if not levels:
            drift = height
        ground, last = height - drift, levels[-1] if levels else 0.0
        least = STEP + DRIFT * max((frames.start - end) / rate - STRIDE_S, 0.0)
        if abs(ground - last) >= least:
            nearest = min(levels, key=lambda level: abs(ground - level))
            last = nearest if abs(ground - nearest) < STEP / 2.0 else ground
        levels.append(last)
        drift, end = drift + 0.5 * (height - last - drift), max(end, frames.stop)
    return levels
