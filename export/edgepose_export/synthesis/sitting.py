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

from edgepose import rotations as rot
from edgepose.skeleton import Body
from edgepose_export.mocap.motion import Array, Motion
from edgepose_export.synthesis.body_parts import (
    LEGS,
    leg,
    leg_hinge,
    minimum_jerk,
    played_to_and_fro,
    smooth_noise,
    with_lap,
    with_trunk,
    with_upper_body,
)

LENGTH_S = (25.0, 50.0)
"""Least and greatest length of a synthetic take, seconds."""


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
    sway = smooth_noise(frames, motion.rate, 4, np.radians(1.2), rng)
    pelvis_pitch = course[:, 2] + lean + sway[:, 0]
    pelvis = rot.rotation_about_axis("y", sway[:, 1]) @ rot.rotation_about_axis("x", pelvis_pitch)
    rotations = np.empty((frames, 24, 3, 3))
    rotations[:, 0] = pelvis
    local = played_to_and_fro(motion, frames, rng)
    local = with_trunk(local, course[:, 3] + 0.4 * lean + sway[:, 2])
    local = with_lap(local, course[:, 4], rng)
    hips, ankles = _hips_and_ankles(course, pelvis, body, motion.rate, rng)
    for side, (joints, ankle) in enumerate(zip(LEGS, ankles, strict=True)):
        hip = hips + pelvis @ body.offsets[joints[0]]
        outwards = np.radians(rng.uniform(-5.0, 22.0)) * (1.0 if side == 0 else -1.0)
        hinge = leg_hinge(hip - ankle, outwards)
        thigh, shank = leg(hip, ankle, body.offsets[list(joints)], hinge)
        rotations[:, joints[0]] = thigh
        rotations[:, list(joints[1:])] = shank[:, None]
        # The foot is flat on the floor; no sensor or target depends on it.
        rotations[:, list(joints[2:])] = np.eye(3)
    rotations = with_upper_body(rotations, local)
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
        share = minimum_jerk(np.arange(move) / move)[: frames - end]
        course[end : end + move] = (1.0 - share[:, None]) * np.array(posture) + share[:, None] * np.array(
            following
        )
        depth = min(abs(following.thigh - posture.thigh), np.pi / 2) / (np.pi / 2)
        lean[end : end + move] = (
            np.radians(np.clip(rng.normal(28.0, 12.0), 2.0, 60.0)) * depth * np.sin(np.pi * share) ** 2
        )
        posture, start = following, end + move
    return course, lean


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
    drift = smooth_noise(len(course), rate, 4, 0.07, rng) * seat[:, None]
    ankles = [
        np.stack([np.full(len(course), side * width) + 0.4 * drift[:, 2 * k], zero, drift[:, 2 * k + 1]], 1)
        for k, side in enumerate((1.0, -1.0))
    ]
    return middle - socket, ankles
