"""A motion of the 24 SMPL joints, whatever it was read from."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from edgepose.rotations import geodesic_angle, matrix_to_quat, quat_continuous, quat_to_matrix

Array = NDArray[np.float64]


class Motion(NamedTuple):
    """Global rotations and the pelvis' path, in a world with the axes of the body frame T at heading zero."""

    rotations: Array
    """(T, 24, 3, 3) global bone rotations R_TB; all are the identity in SMPL's zero pose facing +Z."""
    translation: Array
    """(T, 3) pelvis position, metres, Y up."""
    rate: float
    """Frames per second."""
    source: str
    """Where it comes from: "cmu", "bandai-namco" or "amass"."""


def resample(motion: Motion, rate: float = 60.0) -> Motion:
    """The same motion at another rate, from its first frame to the last that still lies inside it.

    Rotations go through a cubic spline on quaternions of continuous sign. Slerp would be linear between
    frames: its corners become spikes in the accelerations that are derived from the motion.
    """
    frames = len(motion.rotations)
    if rate == motion.rate or frames < 2:
        return motion._replace(rate=float(rate))
    times = np.arange(frames) / motion.rate
    wanted = np.arange(int((frames - 1) * rate / motion.rate + 1e-6) + 1) / rate
    wanted = np.minimum(wanted, times[-1])
    quats = CubicSpline(times, quat_continuous(matrix_to_quat(motion.rotations)))(wanted)
    quats /= np.linalg.norm(quats, axis=-1, keepdims=True)
    translation = CubicSpline(times, motion.translation)(wanted)
    return Motion(quat_to_matrix(quats), translation, float(rate), motion.source)


FASTEST_TURN = 60.0
"""rad/s; kicks and punches stay below 45. What is above are faults of the source, mostly half turns."""
FASTEST_PELVIS = 10.0
"""m/s."""
_FEET = (7, 8, 10, 11)  # their angles are noisy, and nothing is learned from them


def pieces(motion: Motion, shortest: float = 1.0) -> list[Motion]:
    """The motion cut where the source jumps, without cut pieces that are shorter than `shortest` seconds.

    To be used before `resample`, whose spline would ring at a jump. A jump turns a bone other than the feet,
    or moves the pelvis, faster than a body can. In some CMU takes of dance a thigh is turned by half a turn
    for a few frames; such pieces are short and go.
    """
    turns = geodesic_angle(motion.rotations[1:], motion.rotations[:-1]) * motion.rate
    turns[:, _FEET] = 0.0
    speed = np.linalg.norm(np.diff(motion.translation, axis=0), axis=1) * motion.rate
    cuts = 1 + np.flatnonzero((turns > FASTEST_TURN).any(axis=1) | (speed > FASTEST_PELVIS))
    if not len(cuts):
        return [motion]
    ends = [0, *cuts.tolist(), len(motion.rotations)]
    return [
        motion._replace(rotations=motion.rotations[a:b], translation=motion.translation[a:b])
        for a, b in pairwise(ends)
        if b - a >= shortest * motion.rate
    ]
