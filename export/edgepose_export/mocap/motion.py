"""Motions of the 24 SMPL joints, independent of the source: type, resampling, cutting at jumps."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from edgepose.rotations import geodesic_angle, matrix_to_quat, quat_continuous, quat_to_matrix

Array = NDArray[np.float64]


class Motion(NamedTuple):
    """Global rotations and pelvis positions, in a world with the axes of the body frame T at heading zero."""

    rotations: Array
    """(T, 24, 3, 3) global bone rotations R_TB; all are the identity in SMPL's zero pose, facing +Z."""
    translation: Array
    """(T, 3) pelvis position, metres, Y up."""
    rate: float
    """Frames per second."""
    source: str
    """Origin: "cmu", "bandai-namco", "bvh" for other BVH files, or "amass"."""
    leg_length: float = 0.0
    """Length of thigh and shank of the source's body, mean of both sides, metres; 0 if unknown."""


def resample(motion: Motion, rate: float = 60.0) -> Motion:
    """Resample a motion, from its first frame to the last sample within it.

    Rotations are interpolated by a cubic spline on quaternions of continuous sign. Slerp is linear between
    frames, and its corners would become spikes in the accelerations derived from the motion.
    """
    frames = len(motion.rotations)
    if rate == motion.rate or frames < 2:
        return motion._replace(rate=float(rate))
    times = np.arange(frames) / motion.rate
    wanted = np.arange(_frames_at(rate, motion)) / rate
    wanted = np.minimum(wanted, times[-1])
    quats = CubicSpline(times, quat_continuous(matrix_to_quat(motion.rotations)))(wanted)
    quats /= np.linalg.norm(quats, axis=-1, keepdims=True)
    translation = CubicSpline(times, motion.translation)(wanted)
    return motion._replace(rotations=quat_to_matrix(quats), translation=translation, rate=float(rate))


def _frames_at(rate: float, motion: Motion) -> int:
    return int((len(motion.rotations) - 1) * rate / motion.rate + 1e-6) + 1


_STILL_RAD, _STILL_M = 2e-3, 1e-3
_MOST_FOLDED_RAD = 2.4
"""A spine does not bend by more; joints of a take that is more folded have been mixed up."""
_FEWEST_FRAMES = 3
"""Accelerations are second differences."""


def fault(motion: Motion, rate: float = 60.0) -> str | None:
    """Return why a motion is of no use at a rate, Hz; None if it is of use."""
    frames = len(motion.rotations)
    if frames < 2 or _frames_at(rate, motion) < _FEWEST_FRAMES:
        return f"too short: {frames} frame{'s' * (frames != 1)} at {motion.rate:g} Hz"
    folded = np.median(geodesic_angle(motion.rotations[:, 0], motion.rotations[:, 9]))
    if folded > _MOST_FOLDED_RAD:
        return f"no posture of a body: pelvis and chest are {np.degrees(folded):.0f} deg apart"
    turned = geodesic_angle(motion.rotations, motion.rotations[0]).max()
    if turned < _STILL_RAD and np.ptp(motion.translation, axis=0).max() < _STILL_M:
        return f"no motion: all {frames} frames are the same"
    return None


def scaled_to(motion: Motion, leg_length: float) -> Motion:
    """Return a motion for a body with other legs, so that its feet do not slide.

    Args:
        motion: the motion; unchanged if the length of its own legs is unknown.
        leg_length: length of thigh and shank, metres.
    """
    if not motion.leg_length:
        return motion
    scale = leg_length / motion.leg_length
    return motion._replace(translation=scale * motion.translation, leg_length=leg_length)


FASTEST_TURN = 60.0
"""rad/s; kicks and punches stay below 45. Faster ones are faults of the source, mostly by 180 deg."""
FASTEST_PELVIS = 10.0
"""m/s."""
_FEET = (7, 8, 10, 11)  # their angles are noisy, and no sensor or target depends on them


def pieces(motion: Motion, shortest: float = 1.0) -> list[Motion]:
    """Cut a motion where the source jumps, and drop cut pieces shorter than `shortest` seconds.

    At a jump a bone other than the feet rotates, or the pelvis moves, faster than a body can. In some CMU
    takes of dance a thigh is rotated by 180 deg for a few frames; such pieces are short and are dropped. Call
    this before `resample`, whose spline would ring at a jump.
    """
    rates = geodesic_angle(motion.rotations[1:], motion.rotations[:-1]) * motion.rate
    rates[:, _FEET] = 0.0
    speed = np.linalg.norm(np.diff(motion.translation, axis=0), axis=1) * motion.rate
    cuts = 1 + np.flatnonzero((rates > FASTEST_TURN).any(axis=1) | (speed > FASTEST_PELVIS))
    if not len(cuts):
        return [motion]
    ends = [0, *cuts.tolist(), len(motion.rotations)]
    return [
        motion._replace(rotations=motion.rotations[a:b], translation=motion.translation[a:b])
        for a, b in pairwise(ends)
        if b - a >= shortest * motion.rate
    ]
