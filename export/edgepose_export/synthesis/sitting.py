"""Synthetic sitting: sitting down, sitting and rising, added to captured upper bodies.

Motion capture hardly contains any. Standing and sitting look alike to the sensors on the shanks; the
transition between them, and the pelvis, which tilts back on a seat, tell them apart. A network has to see
both in training, for long stretches.

The feet stay on the floor. The pelvis follows from the inclinations of shanks and thighs, which change
smoothly between postures. Each leg is then solved from hip to ankle. Frames: T, SMPL's axes, metres, radians.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from edgepose import rotations as rot
from edgepose.skeleton import Body, local_from_global
from edgepose_export.mocap.motion import Array, Motion

LENGTH_S = (25.0, 50.0)
"""Least and greatest length of a synthetic take, seconds."""

_LEGS = ((1, 4, 7, 10), (2, 5, 8, 11))
_SPINE = (3, 6, 9)


class Posture(NamedTuple):
    """A posture in which a wearer rests between two moves; angles in radians.

    Attributes:
        thigh: inclination of the thighs, 0 when standing, pi / 2 on a seat.
        shank: inclination of the shanks, positive when the knees are ahead of the ankles.
        pelvis: tilt of the pelvis, positive forwards.
        spine: bend of the spine above the pelvis, positive forwards.
        lap: 0 if the arms move as captured, 1 if the hands lie on the thighs.
    """

    thigh: float
    shank: float
    pelvis: float
    spine: float
    lap: float


def standing(rng: np.random.Generator) -> Posture:
    """Draw a posture: upright, knees nearly straight."""
    bend = rng.uniform(0.0, np.radians(8.0))
    return Posture(bend, bend, rng.normal(0.0, np.radians(3.0)), 0.0, 0.0)


def sitting(rng: np.random.Generator) -> Posture:
    """Draw a posture on a seat of any height: the pelvis tilts back, the spine compensates for most of it."""
    pelvis = np.clip(rng.normal(-20.0, 10.0), -45.0, 8.0)
    return Posture(
        np.radians(np.clip(rng.normal(88.0, 9.0), 60.0, 108.0)),
        np.radians(rng.normal(0.0, 7.0)),
        np.radians(pelvis),
        np.radians(rng.normal(-0.8 * pelvis, 8.0)),
        float(rng.random() < 0.6),
    )


def squatting(rng: np.random.Generator) -> Posture:
    """Draw a posture with bent knees and hips, the trunk leaning forwards."""
    thigh = rng.uniform(30.0, 105.0)
    shank = np.clip(rng.normal(0.35 * thigh, 6.0), 5.0, 42.0)
    pelvis = max(rng.normal(0.3 * thigh, 10.0), -10.0)
    return Posture(*np.radians([thigh, shank, pelvis, rng.normal(5.0, 10.0)]), 0.0)


def seated(motion: Motion, body: Body, rng: np.random.Generator) -> Motion:
    """Return a long take in which the upper body of a short one sits down, sits, rises, squats and stands.

    Args:
        motion: motion of which the joints above the pelvis are used, at the rate of the result.
        body: body that provides the legs.
        rng: source of the random postures and times.
    """
    frames = round(rng.uniform(*LENGTH_S) * motion.rate)
    course, lean = _course(frames, motion.rate, rng)
    sway = _smooth_noise(frames, motion.rate, 4, np.radians(1.2), rng)
    pelvis_pitch = course[:, 2] + lean + sway[:, 0]
    pelvis = rot.rotation_about_axis("y", sway[:, 1]) @ rot.rotation_about_axis("x", pelvis_pitch)
    rotations = np.empty((frames, 24, 3, 3))
    rotations[:, 0] = pelvis
    local = _play_to_and_fro(motion, frames, rng)
    local = _with_trunk(local, course[:, 3] + 0.4 * lean + sway[:, 2])
    local = _with_lap(local, course[:, 4], rng)
    hips, ankles = _hips_and_ankles(course, pelvis, body, motion.rate, rng)
    for side, (leg, ankle) in enumerate(zip(_LEGS, ankles, strict=True)):
        hip = hips + pelvis @ body.offsets[leg[0]]
        thigh, shank = _leg(hip, ankle, body.offsets[list(leg)], side, rng)
        rotations[:, leg[0]] = thigh
        rotations[:, list(leg[1:])] = shank[:, None]
        # The foot is flat on the floor; no sensor or target depends on it.
        rotations[:, list(leg[2:])] = np.eye(3)
    for joint, parent in ((3, 0), (6, 3), (9, 6), (12, 9), (13, 9), (14, 9), (15, 12), (16, 13), (17, 14),
                          (18, 16), (19, 17), (20, 18), (21, 19), (22, 20), (23, 21)):  # fmt: skip
        rotations[:, joint] = rotations[:, parent] @ local[:, joint]
    return motion._replace(rotations=rotations, translation=hips)


def _course(frames: int, rate: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return postures (T, 5) over time, and how far the trunk leans forwards in moves between them (T,)."""
    course, lean = np.empty((frames, 5)), np.zeros(frames)
    posture, kind, start = standing(rng), standing, 0
    while start < frames:
        rest_s = rng.uniform(4.0, 18.0) if kind is sitting else rng.uniform(0.6, 4.0)
        end = min(start + round(rest_s * rate), frames)
        course[start:end] = posture
        if end == frames:
            break
        if kind is not standing:
            kind = standing if rng.random() < 0.85 else sitting
        else:
            kind = squatting if rng.random() < 0.25 else sitting
        following = kind(rng)
        move = round(rng.uniform(0.8, 2.6) * rate)
        share = _minimum_jerk(np.arange(move) / move)[: frames - end]
        course[end : end + move] = (1.0 - share[:, None]) * np.array(posture) + share[:, None] * np.array(
            following
        )
        depth = min(abs(following.thigh - posture.thigh), np.pi / 2) / (np.pi / 2)
        lean[end : end + move] = (
            np.radians(np.clip(rng.normal(28.0, 12.0), 2.0, 60.0)) * depth * np.sin(np.pi * share) ** 2
        )
        posture, start = following, end + move
    return course, lean


def _minimum_jerk(t: Array) -> Array:
    """Return values from 0 to 1 with zero speed and acceleration at both ends (Flash and Hogan 1985)."""
    smooth: Array = t**3 * (10.0 - 15.0 * t + 6.0 * t * t)
    return smooth


def _smooth_noise(frames: int, rate: float, columns: int, size: float, rng: np.random.Generator) -> Array:
    """Return slow random movement (T, columns) with the standard deviation `size`."""
    knots = np.arange(-1, int(frames / rate / 1.2) + 4) * 1.2
    noise: Array = CubicSpline(knots, rng.normal(0.0, size, (len(knots), columns)))(np.arange(frames) / rate)
    return noise


def _play_to_and_fro(motion: Motion, frames: int, rng: np.random.Generator) -> Array:
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


def _with_trunk(local: Array, bend: Array) -> Array:
    """Return the same with the spine bent forwards; the head compensates for some of it."""
    part = rot.rotation_about_axis("x", bend / len(_SPINE))
    local = local.copy()
    for joint in _SPINE:
        local[:, joint] = part @ local[:, joint]
    local[:, 12] = rot.rotation_about_axis("x", -0.3 * bend) @ local[:, 12]
    return local


def _with_lap(local: Array, share: Array, rng: np.random.Generator) -> Array:
    """Return the same with the forearms laid on the thighs, to a share (T,) from 0 to 1."""
    local = local.copy()
    for shoulder, elbow, side in ((16, 18, 1.0), (17, 19, -1.0)):
        upper, fore = np.radians([rng.uniform(10.0, 45.0), rng.uniform(55.0, 100.0)])
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


def _hips_and_ankles(
    course: Array, pelvis: Array, body: Body, rate: float, rng: np.random.Generator
) -> tuple[Array, list[Array]]:
    """Return the positions (T, 3) of the pelvis and of both ankles."""
    thigh, shank = course[:, 0], course[:, 1]
    lengths = np.linalg.norm(body.offsets[[4, 7]], axis=1)
    zero = np.zeros(len(course))
    # Not quite straight, so that legs that stand apart still reach the floor.
    up = 0.9985 * (lengths[1] * np.cos(shank) + lengths[0] * np.cos(thigh))
    ahead = lengths[1] * np.sin(shank) - lengths[0] * np.sin(thigh)
    middle = np.stack([zero, up, ahead], axis=1)
    socket = pelvis @ (0.5 * (body.offsets[1] + body.offsets[2]))
    width = abs(body.offsets[1][0]) + rng.uniform(0.0, 0.10)
    # On a seat the feet move about, also one at a time.
    seat = np.clip((thigh - np.radians(50.0)) / np.radians(30.0), 0.0, 1.0)
    drift = _smooth_noise(len(course), rate, 4, 0.07, rng) * seat[:, None]
    ankles = [
        np.stack([np.full(len(course), side * width) + 0.4 * drift[:, 2 * k], zero, drift[:, 2 * k + 1]], 1)
        for k, side in enumerate((1.0, -1.0))
    ]
    return middle - socket, ankles


def _leg(
    hip: Array, ankle: Array, offsets: Array, side: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return global rotations (T, 3, 3) of thigh and shank between a hip and an ankle, knee forwards."""
    above, below = np.linalg.norm(offsets[1]), np.linalg.norm(offsets[2])
    line = hip - ankle
    length = np.linalg.norm(line, axis=1)
    reach = np.clip(length, abs(above - below) + 1e-3, 0.9995 * (above + below))
    line = line / length[:, None]
    outwards = np.radians(rng.uniform(-5.0, 22.0)) * (1.0 if side == 0 else -1.0)
    pole = np.array([np.sin(outwards), 0.0, np.cos(outwards)])
    hinge = np.cross(line, pole)
    hinge /= np.linalg.norm(hinge, axis=1, keepdims=True)
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
