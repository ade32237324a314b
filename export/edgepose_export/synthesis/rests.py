"""Synthetic rests: captured motion slowed down to a stop, held with a natural sway, and continued.

Captured takes hardly contain any long rests, and none in unusual postures. Wearers lie, kneel, crouch and
stand about for long; a network must neither drift off nor trust that motion goes on. Rests are put where the
captured body is slow and low, so the ways down and up are the captured ones. Between rests a take plays
forwards or backwards. Frames: T, SMPL's axes, metres, radians.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from edgepose import rotations as rot
from edgepose.skeleton import Body, forward_kinematics, local_from_global, standing_pelvis_position
from edgepose_export.mocap.motion import Array, Motion
from edgepose_export.synthesis.body_parts import smooth_noise

LENGTH_S = (20.0, 50.0)
"""Least and greatest length of a take, seconds."""

REST_S = (2.0, 12.0)
"""Least and greatest length of a rest, seconds."""

TRAVEL_S = (0.7, 15.0)
"""Least and greatest length of captured motion between two rests, seconds."""

RAMP_S = (0.4, 1.0)
"""Time in which motion slows down to a rest, or gains speed after it."""

PACE = (0.85, 1.1)
"""Speeds between rests, as factors on the captured speed."""

SLOW = 0.4
"""Speed of the body, m/s, above which rests become rare."""

LOW = 8.0
"""How much likelier a rest is where the pelvis is down than in a standing body."""

RISING = 0.5
"""Share of the rests of a low body after which it rises, if it has risen in the captured motion."""

BACKWARDS = 0.5
"""How likely it is to go back to a rest, compared with going on to one."""

SWAY_DEG = (0.5, 1.5)
"""Least and greatest sway of a wearer's joints at rest, standard deviation."""

_JOINT_SWAY = {3: 0.2, 6: 0.2, 9: 0.2, 12: 0.5, 15: 0.7, 16: 0.7, 17: 0.7, 18: 0.7, 19: 0.7}
"""Sway of joints as a share of the wearer's; rotations of the arms add up to it."""

_BODY_SWAY = 0.4
"""The same of the whole body, about the ground below the pelvis."""

_BREATHS_HZ, _BREATH_DEG = (0.2, 0.33), (0.2, 0.8)


class _Places(NamedTuple):
    """Where rests may be, for each captured frame (T,), from 0 to 1: slow and low frames."""

    slowness: Array
    lowness: Array

    def likelihood(self, rising: bool) -> Array:
        """Return how likely a rest is (T,), not normalised: where the body is low, or where it is not."""
        wanted = 1.001 - self.lowness if rising else 1.0 + (LOW - 1.0) * self.lowness
        likelihood: Array = self.slowness * wanted
        return likelihood


class Course(NamedTuple):
    """Which captured frame a take shows over time.

    Attributes:
        position: (T,) captured frame, fractional.
        speed: (T,) captured frames per frame, absolute; 0 at rest.
    """

    position: Array
    speed: Array


def with_rests(motion: Motion, body: Body, rng: np.random.Generator) -> Motion:
    """Return a long take in which the wearer of a captured one stops at random, rests and goes on.

    Args:
        motion: captured motion at the rate of the result.
        body: body that tells how low a posture is.
        rng: source of the random places, times and sway.
    """
    if len(motion.rotations) < 2:
        motion = motion._replace(
            rotations=np.repeat(motion.rotations, 2, axis=0),
            translation=np.repeat(motion.translation, 2, axis=0),
        )
    frames = round(rng.uniform(*LENGTH_S) * motion.rate)
    course = _course(_places(motion, body), frames, motion.rate, rng)
    return _swaying(_played(motion, course.position), 1.0 - course.speed.clip(0.0, 1.0), body, rng)


def _places(motion: Motion, body: Body) -> _Places:
    """Return where rests may be in a captured motion."""
    joints = forward_kinematics(local_from_global(motion.rotations), body.offsets, motion.translation)[1]
    velocity = np.gradient(joints, 1.0 / motion.rate, axis=0)
    speed = np.sqrt(np.square(velocity).sum(-1).mean(-1))
    height = (joints[:, 0, 1] - joints[..., 1].min(axis=1)) / standing_pelvis_position(body.offsets)[1]
    lowness = np.clip((0.85 - height) / 0.3, 0.0, 1.0)
    # Without any slow frame the slowest ones still have weight.
    slowness = np.exp(-np.square((speed - speed.min()) / SLOW))
    return _Places(slowness + 1e-3, lowness)


def _course(places: _Places, frames: int, rate: float, rng: np.random.Generator) -> Course:
    """Draw rests and the ways between them."""
    likelihood = places.likelihood(rising=False)
    place = int(rng.choice(len(likelihood), p=likelihood / likelihood.sum()))
    position, speed = [], []
    length = 0
    while length < frames:
        # Short rests are more frequent than long ones.
        rest = round((REST_S[0] + (REST_S[1] - REST_S[0]) * rng.random() ** 2) * rate)
        position.append(np.full(rest, float(place)))
        speed.append(np.zeros(rest))
        rising = bool(places.lowness[place] > 0.5 and rng.random() < RISING)
        following = _next_place(places.likelihood(rising), place, rate, rng)
        share, fast = _way(abs(following - place) / rate, rate, rng)
        position.append(place + np.sign(following - place) * share * rate)
        speed.append(fast)
        length += rest + len(share)
        place = following
    # The first rest is partly before the take.
    skipped = rng.integers(0, len(position[0]))
    wanted = slice(skipped, skipped + frames)
    return Course(np.concatenate(position)[wanted], np.concatenate(speed)[wanted])


def _next_place(likelihood: Array, place: int, rate: float, rng: np.random.Generator) -> int:
    """Draw the captured frame of the next rest."""
    away = np.arange(len(likelihood)) - place
    near = (np.abs(away) >= TRAVEL_S[0] * rate) & (np.abs(away) <= TRAVEL_S[1] * rate)
    if not near.any():
        near = away != 0
    weights = likelihood * near * np.where(away < 0, BACKWARDS, 1.0)
    return int(rng.choice(len(weights), p=weights / weights.sum()))


def _way(seconds: float, rate: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return captured time (T,), from 0 to less than `seconds`, and its speed, from rest to rest.

    The speed rises and falls smoothly, so that accelerations have no spikes.
    """
    ramp = rng.uniform(*RAMP_S)
    pace = min(rng.uniform(*PACE), seconds / ramp)
    whole = seconds / pace + ramp
    t = np.arange(round(whole * rate)) / rate
    up, down = np.clip(t / ramp, 0.0, 1.0), np.clip((whole - t) / ramp, 0.0, 1.0)
    speed = pace * (up * up * (3.0 - 2.0 * up) + down * down * (3.0 - 2.0 * down) - 1.0)
    # The integral of the speed.
    risen = ramp * (up**3 - 0.5 * up**4) + (t - ramp).clip(0.0)
    lost = ramp * ((1.0 - down) - (0.5 - down**3 + 0.5 * down**4))
    return pace * (risen - lost), speed


def _played(motion: Motion, position: Array) -> Motion:
    """Return the captured motion at fractional frames (T,), by cubic splines as in `mocap.resample`."""
    at = np.arange(len(motion.rotations))
    quats = CubicSpline(at, rot.quat_continuous(rot.matrix_to_quat(motion.rotations)))(position)
    quats /= np.linalg.norm(quats, axis=-1, keepdims=True)
    translation = CubicSpline(at, motion.translation)(position)
    return motion._replace(rotations=rot.quat_to_matrix(quats), translation=translation)


def _swaying(motion: Motion, amount: Array, body: Body, rng: np.random.Generator) -> Motion:
    """Return a motion in which a wearer sways and breathes, to a share (T,) from 0 to 1."""
    frames, size = len(amount), np.radians(rng.uniform(*SWAY_DEG))
    local = local_from_global(motion.rotations)
    for joint, share in _JOINT_SWAY.items():
        noise = smooth_noise(frames, motion.rate, 3, share * size, rng)
        local[:, joint] = local[:, joint] @ rot.rotvec_to_matrix(amount[:, None] * noise)
    hz, depth, phase = rng.uniform(*_BREATHS_HZ), np.radians(rng.uniform(*_BREATH_DEG)), rng.uniform(0, 6.3)
    breath = amount * depth * np.sin(2.0 * np.pi * hz * np.arange(frames) / motion.rate + phase)
    local[:, 9] = local[:, 9] @ rot.rotation_about_axis("x", -breath)
    rotations, joints = forward_kinematics(local, body.offsets, motion.translation)
    ground = motion.translation.copy()
    ground[:, 1] = joints[..., 1].min(axis=1)
    noise = smooth_noise(frames, motion.rate, 3, _BODY_SWAY * size, rng)
    sway = rot.rotvec_to_matrix(amount[:, None] * noise)
    above = (sway @ (motion.translation - ground)[..., None])[..., 0]
    return motion._replace(rotations=sway[:, None] @ rotations, translation=ground + above)
