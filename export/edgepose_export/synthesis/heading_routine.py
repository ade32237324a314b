"""The exercises of `edgepose calibrate --heading-reset motion`, for simulated wearers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.calibration import EXERCISE_S, ROUTINE
from edgepose.skeleton import PARENTS
from edgepose_export.mocap import Motion
from edgepose_export.synthesis.virtual_imus import straight_pose, with_hold

Array = NDArray[np.float64]

HOLD_S = 2.0
"""Time of standing still between the exercises and the take, seconds."""

ASIDE_DEG = 12.0
"""Outward angle of raised forearms, which do not rise straight ahead; found in a recording of a real walk."""

REPEATS = 2

# Joint that rotates, with all joints below it; axis in T; degrees.
_BOW = ((0, (1.0, 0.0, 0.0), 30.0), (3, (1.0, 0.0, 0.0), 15.0), (12, (1.0, 0.0, 0.0), 10.0))
_HANG = ((1, (1.0, 0.0, 0.0), -30.0), (2, (1.0, 0.0, 0.0), -30.0))  # keeps the legs where they are
_HANG += ((16, (1.0, 0.0, 0.0), -45.0), (17, (1.0, 0.0, 0.0), -45.0))


def _level(degrees: float) -> tuple[float, float, float]:
    """Return a level axis in T, rotated from X towards Z."""
    angle = np.radians(degrees)
    return float(np.cos(angle)), 0.0, float(np.sin(angle))


_EXERCISE_ANGLES = {
    "head": _BOW + _HANG,
    "left_forearm": ((18, _level(-ASIDE_DEG), -80.0),),
    "right_forearm": ((19, _level(ASIDE_DEG), -80.0),),
    "left_lower_leg": ((4, (1.0, 0.0, 0.0), 80.0),),
    "right_lower_leg": ((5, (1.0, 0.0, 0.0), 80.0),),
}


def exercises(rate: float) -> Array:
    """Return global rotations (T, 24, 3, 3) of `calibration.ROUTINE`, done from the straight pose."""
    t = np.arange(round(EXERCISE_S * rate)) / rate
    bend = 0.5 - 0.5 * np.cos(2.0 * np.pi * REPEATS * t / EXERCISE_S)
    return np.concatenate([_bent(_EXERCISE_ANGLES[exercise.sensors[0]], bend) for exercise in ROUTINE])


def with_exercises(motion: Motion, stand_s: float) -> Motion:
    """Put `stand_s` seconds of standing straight, the exercises, and `HOLD_S` of standing before a take."""
    motion = with_hold(motion, HOLD_S)
    standing = np.broadcast_to(straight_pose(), (round(stand_s * motion.rate), 24, 3, 3))
    before = np.concatenate([standing, exercises(motion.rate)])
    still = np.broadcast_to(motion.translation[0], (len(before), 3))
    return motion._replace(
        rotations=np.concatenate([before, motion.rotations]),
        translation=np.concatenate([still, motion.translation]),
    )


def _bent(angles: tuple[tuple[int, tuple[float, float, float], float], ...], bend: Array) -> Array:
    """Return the straight pose (T, 24, 3, 3), with joints rotated by shares (T,) of their angles."""
    change = np.tile(np.eye(3), (len(bend), len(PARENTS), 1, 1))
    for joint, axis, degrees in angles:
        change[:, joint] = rot.rotvec_to_matrix(np.radians(degrees) * bend[:, None] * np.array(axis))
    for joint, parent in enumerate(PARENTS[1:], start=1):
        change[:, joint] = change[:, parent] @ change[:, joint]
    return change @ straight_pose()
