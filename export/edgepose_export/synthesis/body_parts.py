"""Parts of synthetic takes: captured upper bodies, trunks and arms in other postures, legs, smooth courses.

Frames: T, SMPL's axes, metres, radians. Local rotations are relative to the joint's parent.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from edgepose import rotations as rot
from edgepose.skeleton import local_from_global
from edgepose_export.mocap.motion import Array, Motion

LEGS = ((1, 4, 7, 10), (2, 5, 8, 11))
"""Joints of both legs, from the hip to the base of the toes."""

_SPINE = (3, 6, 9)

_UPPER_BODY = (
    (3, 0), (6, 3), (9, 6), (12, 9), (13, 9), (14, 9), (15, 12), (16, 13), (17, 14), (18, 16), (19, 17),
    (20, 18), (21, 19), (22, 20), (23, 21),
)  # fmt: skip
"""Joints above the pelvis and their parents."""


def minimum_jerk(t: Array) -> Array:
    """Return values from 0 to 1 with zero speed and acceleration at both ends (Flash and Hogan 1985)."""
    smooth: Array = t**3 * (10.0 - 15.0 * t + 6.0 * t * t)
    return smooth


def smooth_noise(frames: int, rate: float, columns: int, size: float, rng: np.random.Generator) -> Array:
    """Return slow random movement (T, columns) with the standard deviation `size`."""
    knots = np.arange(-1, int(frames / rate / 1.2) + 4) * 1.2
    noise: Array = CubicSpline(knots, rng.normal(0.0, size, (len(knots), columns)))(np.arange(frames) / rate)
    return noise


def played_to_and_fro(motion: Motion, frames: int, rng: np.random.Generator) -> Array:
    """Return local rotations (T, 24, 3, 3) of a take played to and fro, coming to rest at both ends."""
    local = local_from_global(motion.rotations)
    last = len(local) - 1
    phase = np.pi * np.arange(frames) / max(last, 1) / rng.uniform(1.2, 1.8) + rng.uniform(0.0, 2.0 * np.pi)
    position = 0.5 * last * (1.0 - np.cos(phase))
    low = np.minimum(position.astype(int), max(last - 1, 0))
    high = np.minimum(low + 1, last)
    # Neighbouring frames are only a few degrees apart, so the orthonormalised mean is a good interpolation.
    share = (position - low)[:, None, None, None]
    return rot.nearest_rotation((1.0 - share) * local[low] + share * local[high])


def with_trunk(local: Array, bend: Array) -> Array:
    """Return the same with the spine bent forwards; the head compensates for some of it."""
    part = rot.rotation_about_axis("x", bend / len(_SPINE))
    local = local.copy()
    for joint in _SPINE:
        local[:, joint] = part @ local[:, joint]
    local[:, 12] = rot.rotation_about_axis("x", -0.3 * bend) @ local[:, 12]
    return local


def with_lap(local: Array, share: Array, rng: np.random.Generator) -> Array:
    """Return the same with the forearms laid on the thighs, to a share (T,) from 0 to 1."""
    return _with_arms(local, share, (10.0, 45.0), (55.0, 100.0), rng)


def with_support(local: Array, share: Array, rng: np.random.Generator) -> Array:
    """Return the same with the hands on the floor behind the hips, to a share (T,) from 0 to 1."""
    return _with_arms(local, share, (-52.0, -24.0), (-40.0, -10.0), rng)


def _with_arms(
    local: Array,
    share: Array,
    upper_deg: tuple[float, float],
    fore_deg: tuple[float, float],
    rng: np.random.Generator,
) -> Array:
    """Return the same with the arms held ahead of the trunk, at angles drawn within limits."""
    local = local.copy()
    for shoulder, elbow, side in ((16, 18, 1.0), (17, 19, -1.0)):
        upper, fore = np.radians([rng.uniform(*upper_deg), rng.uniform(*fore_deg)])
        hang = rot.rotation_about_axis("z", -side * np.radians(rng.uniform(72.0, 88.0)))
        arm = rot.rotation_about_axis("x", -upper) @ hang
        inwards = rot.rotation_about_axis("y", -side * np.radians(rng.uniform(0.0, 35.0)))
        twist = rot.rotation_about_axis("x", np.radians(rng.uniform(-60.0, 40.0)))
        forearm = inwards @ rot.rotation_about_axis("x", -fore) @ hang @ twist
        for joint, target in ((shoulder, arm), (elbow, arm.T @ forearm)):
            start = rot.matrix_to_quat(local[:, joint])
            goal = np.broadcast_to(rot.matrix_to_quat(target), start.shape)
            local[:, joint] = rot.quat_to_matrix(rot.slerp(start, goal, share))
    return local


def with_upper_body(rotations: Array, local: Array) -> Array:
    """Return global rotations (T, 24, 3, 3) in which the joints above the pelvis follow local ones."""
    rotations = rotations.copy()
    for joint, parent in _UPPER_BODY:
        rotations[:, joint] = rotations[:, parent] @ local[:, joint]
    return rotations


def leg_hinge(line: Array, outwards: Array | float) -> Array:
    """Return the axes (T, 3) of knees that point forwards, turned outwards to the left by an angle.

    Args:
        line: (T, 3) from the ankle to the hip.
        outwards: radians, of each frame or of all.
    """
    pole = np.stack(np.broadcast_arrays(np.sin(outwards), 0.0, np.cos(outwards)), axis=-1)
    return np.cross(line, pole)


def leg(hip: Array, ankle: Array, offsets: Array, hinge: Array) -> tuple[Array, Array]:
    """Return global rotations (T, 3, 3) of thigh and shank between a hip and an ankle (T, 3).

    Args:
        hip: positions of the hip.
        ankle: positions of the ankle.
        offsets: (4, 3) offsets of hip, knee, ankle and toes.
        hinge: (T, 3) axes about which the knees bend, square to the lines between ankle and hip.
    """
    above, below = np.linalg.norm(offsets[1]), np.linalg.norm(offsets[2])
    line = hip - ankle
    length = np.linalg.norm(line, axis=1)
    reach = np.clip(length, abs(above - below) + 1e-3, 0.9995 * (above + below))
    line = line / length[:, None]
    hinge = hinge / np.linalg.norm(hinge, axis=1, keepdims=True)
    # Angle at the ankle between the line to the hip and the shank (law of cosines).
    cosine = (below**2 + reach**2 - above**2) / (2.0 * below * reach)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    shank_up = rot.rotvec_to_matrix(hinge * angle[:, None]) @ line[:, :, None]
    knee = ankle + below * shank_up[:, :, 0]
    return _bone(hip - knee, hinge, offsets[1]), _bone(knee - ankle, hinge, offsets[2])


def _bone(up: Array, hinge: Array, offset: Array) -> Array:
    """Return the rotation of a bone with far end `offset` in the zero pose; `up` points to its near end."""

    def frame(direction: Array, side: Array) -> Array:
        y = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
        z = np.cross(side, y)
        z /= np.linalg.norm(z, axis=-1, keepdims=True)
        return np.stack([np.cross(y, z), y, z], axis=-1)

    return frame(up, hinge) @ frame(-offset, np.array([1.0, 0.0, 0.0])).T
