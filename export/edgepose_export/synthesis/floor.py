"""Synthetic kneeling and sitting on the ground, added to captured upper bodies.

Like `edgepose_export.synthesis.sitting`, for postures in which the legs part or leave the floor: one knee or
both down, sitting on the heels, sitting on the ground with legs bent, crossed or stretched. Hips and ankles
move smoothly between postures, and each leg is solved in between. Frames: T, SMPL's axes, metres, radians.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from edgepose import rotations as rot
from edgepose.skeleton import Body
from edgepose_export.mocap.motion import Array, Motion
from edgepose_export.synthesis.body_parts import (
    LEGS,
    leg,
    minimum_jerk,
    played_to_and_fro,
    smooth_noise,
    with_lap,
    with_support,
    with_trunk,
    with_upper_body,
)

SHARE = 0.25
"""Share of the takes with synthetic sitting in which the wearer sits and kneels on the floor instead."""

LENGTH_S = (25.0, 50.0)
"""Least and greatest length of a synthetic take, seconds."""

_LIFT = 0.06  # metres by which a foot is lifted in a step
_KNEELING_FOOT = np.radians(150.0)  # the instep lies on the floor


class Leg(NamedTuple):
    """One leg: where its ankle is, and how it is turned.

    Attributes:
        out: distance of the ankle from the middle, metres.
        up: height of the ankle above that of a foot that stands on the floor, metres.
        ahead: metres.
        outwards: rotation of the knee outwards, radians.
        foot: pitch of the foot, positive with the toes down, radians.
    """

    out: float
    up: float
    ahead: float
    outwards: float
    foot: float


class Stance(NamedTuple):
    """A posture in which a wearer rests between two moves.

    Attributes:
        hips_up: height of the hips above the ankles of a standing body, metres.
        hips_ahead: metres.
        pelvis: tilt of the pelvis, positive forwards, radians.
        spine: bend of the spine above the pelvis, positive forwards, radians.
        lap: 0 if the arms move as captured, 1 if the hands lie on the thighs.
        support: 1 if the hands are on the floor behind the hips.
        left: left leg.
        right: right leg.
    """

    hips_up: float
    hips_ahead: float
    pelvis: float
    spine: float
    lap: float
    support: float
    left: Leg
    right: Leg

    def row(self) -> Array:
        """Return all numbers (16,), the legs last."""
        return np.array([*self[:6], *self.left, *self.right])


class _Wearer(NamedTuple):
    """Lengths of a body and its random numbers."""

    thigh: float
    shank: float
    width: float
    rng: np.random.Generator

    def degrees(self, mean: float, deviation: float) -> float:
        """Draw an angle, radians."""
        return float(np.radians(self.rng.normal(mean, deviation)))

    def standing_leg(self, ahead: float) -> Leg:
        return Leg(self.width, 0.0, ahead, self.degrees(8.0, 4.0), 0.0)

    def kneeling_leg(self, hips_ahead: float) -> Leg:
        return Leg(self.width, 0.02, hips_ahead - 0.98 * self.shank, self.degrees(6.0, 4.0), _KNEELING_FOOT)


def _stand(wearer: _Wearer, before: Stance) -> Stance:
    """Draw a posture: upright over the foot that is further ahead."""
    ahead = max(before.left.ahead, before.right.ahead)
    bend = np.radians(wearer.rng.uniform(0.0, 8.0))
    up = 0.9985 * (wearer.shank + wearer.thigh) * np.cos(bend)
    legs = wearer.standing_leg(ahead), wearer.standing_leg(ahead)
    return Stance(up, ahead, wearer.degrees(0.0, 3.0), 0.0, 0.0, 0.0, *legs)


def _kneel_on_one(wearer: _Wearer, before: Stance) -> Stance:
    """Draw a posture on one knee: from standing one foot steps back, from both knees one foot steps ahead."""
    reach = wearer.thigh * wearer.rng.uniform(0.8, 0.98)
    standing = before.left.foot == before.right.foot == 0.0
    hips_ahead = before.left.ahead - reach if standing else before.hips_ahead
    front = wearer.standing_leg(hips_ahead + reach)._replace(outwards=wearer.degrees(12.0, 6.0))
    legs = [front, wearer.kneeling_leg(hips_ahead)]
    if wearer.rng.random() < 0.5:
        legs.reverse()
    up = wearer.thigh * wearer.rng.uniform(0.9, 0.985)
    lap = float(wearer.rng.random() < 0.3)
    return Stance(up, hips_ahead, wearer.degrees(2.0, 8.0), wearer.degrees(5.0, 8.0), lap, 0.0, *legs)


def _kneel(wearer: _Wearer, before: Stance) -> Stance:
    """Draw a posture on both knees, with the thighs upright."""
    knees = before.hips_ahead
    if before.left.foot == before.right.foot:  # from the heels
        knees = before.left.ahead + 0.98 * wearer.shank
    legs = wearer.kneeling_leg(knees), wearer.kneeling_leg(knees)
    up = wearer.thigh * wearer.rng.uniform(0.93, 0.99)
    return Stance(up, knees, wearer.degrees(2.0, 7.0), wearer.degrees(2.0, 6.0), 0.0, 0.0, *legs)


def _sit_on_heels(wearer: _Wearer, before: Stance) -> Stance:
    """Draw a posture on the heels of a kneeling body."""
    knees = before.left.ahead + 0.98 * wearer.shank
    rise = wearer.degrees(24.0, 5.0)
    up, ahead = wearer.thigh * np.sin(rise), knees - wearer.thigh * np.cos(rise)
    pelvis = wearer.degrees(-8.0, 9.0)
    lap = float(wearer.rng.random() < 0.6)
    spine = -0.7 * pelvis + wearer.degrees(0.0, 7.0)
    return Stance(up, ahead, pelvis, spine, lap, 0.0, before.left, before.right)


def _crouch(wearer: _Wearer, before: Stance) -> Stance:
    """Draw a posture on the way to the ground and back: deep, hands reaching for the floor."""
    seated = before.hips_up < 0.3 * wearer.thigh
    ahead = before.hips_ahead + 0.75 * wearer.thigh if seated else before.left.ahead
    up = 0.45 * wearer.thigh * wearer.rng.uniform(0.8, 1.3)
    legs = wearer.standing_leg(ahead), wearer.standing_leg(ahead)
    hips = ahead - 0.6 * wearer.thigh
    return Stance(up, hips, wearer.degrees(18.0, 8.0), wearer.degrees(15.0, 8.0), 0.0, 0.5, *legs)


def _sit_on_ground(wearer: _Wearer, before: Stance) -> Stance:
    """Draw a posture on the ground, the legs bent, crossed or stretched."""
    ahead = before.hips_ahead
    if before.hips_up > 0.3 * wearer.thigh:
        ahead -= wearer.rng.uniform(0.0, 0.15)
    crossed = wearer.rng.random() < 0.3
    kinds = ["crossed"] * 2 if crossed else wearer.rng.choice(["bent", "stretched"], size=2).tolist()
    legs = [_leg_on_ground(wearer, ahead, kind, side) for side, kind in enumerate(kinds)]
    pelvis = np.radians(np.clip(wearer.rng.normal(-24.0, 10.0), -50.0, 0.0))
    # Hanging arms, as captured, would reach into the floor.
    support = wearer.rng.random() < 0.45
    spine = (-0.4 if support else -0.8) * pelvis + wearer.degrees(0.0, 8.0)
    return Stance(0.02, ahead, float(pelvis), float(spine), float(not support), float(support), *legs)


def _leg_on_ground(wearer: _Wearer, ahead: float, kind: str, side: int) -> Leg:
    """Draw a leg of a wearer on the ground; `ahead` is where the hips are."""
    length = wearer.thigh + wearer.shank
    if kind == "stretched":
        far = ahead + length * wearer.rng.uniform(0.93, 0.99)
        return Leg(wearer.width + 0.1 * wearer.rng.random(), -0.03, far, wearer.degrees(5.0, 5.0), -0.5)
    if kind == "crossed":
        near = ahead + length * (0.25 if side else 0.36)
        return Leg(-0.08, 0.0, near, wearer.degrees(62.0, 6.0), 0.0)
    near = ahead + length * wearer.rng.uniform(0.42, 0.7)
    return Leg(wearer.width, 0.0, near, wearer.degrees(8.0, 8.0), 0.0)


_Draw = Callable[[_Wearer, Stance], Stance]

_FOLLOWING: dict[_Draw, tuple[tuple[_Draw, float], ...]] = {
    _stand: ((_kneel_on_one, 0.55), (_crouch, 0.45)),
    _kneel_on_one: ((_kneel, 0.5), (_stand, 0.5)),
    _kneel: ((_sit_on_heels, 0.5), (_kneel_on_one, 0.5)),
    _sit_on_heels: ((_kneel, 1.0),),
    _crouch: ((_stand, 0.0), (_sit_on_ground, 1.0)),
    _sit_on_ground: ((_sit_on_ground, 0.5), (_crouch, 0.5)),
}
"""Postures that may follow each, with their shares. From a crouch a wearer goes on the way begun."""

_REST_S: dict[_Draw, tuple[float, float]] = {
    _stand: (0.6, 4.0),
    _kneel_on_one: (0.4, 8.0),
    _kneel: (0.3, 8.0),
    _sit_on_heels: (2.0, 14.0),
    _crouch: (0.0, 0.3),
    _sit_on_ground: (2.0, 14.0),
}
"""Least and greatest length of the rests, seconds."""


def on_the_floor(motion: Motion, body: Body, rng: np.random.Generator) -> Motion:
    """Return a long take in which the upper body of a short one kneels, sits on the ground and gets up.

    Args:
        motion: motion of which the joints above the pelvis are used, at the rate of the result.
        body: body that provides the legs.
        rng: source of the random postures and times.
    """
    frames = round(rng.uniform(*LENGTH_S) * motion.rate)
    thigh, shank = np.linalg.norm(body.offsets[[4, 7]], axis=1).tolist()
    wearer = _Wearer(thigh, shank, abs(body.offsets[1][0]) + rng.uniform(0.0, 0.08), rng)
    course, lean = _course(wearer, frames, motion.rate)
    sway = smooth_noise(frames, motion.rate, 3, np.radians(1.2), rng)
    pelvis = rot.rotation_about_axis("y", sway[:, 1]) @ rot.rotation_about_axis(
        "x", course[:, 2] + lean + sway[:, 0]
    )
    rotations = np.empty((frames, 24, 3, 3))
    rotations[:, 0] = pelvis
    local = with_trunk(played_to_and_fro(motion, frames, rng), course[:, 3] + 0.4 * lean + sway[:, 2])
    local = with_support(with_lap(local, course[:, 4], rng), course[:, 5], rng)
    middle = np.stack([np.zeros(frames), course[:, 0], course[:, 1]], axis=1)
    hips = middle - pelvis @ (0.5 * (body.offsets[1] + body.offsets[2]))
    for joints, numbers, side in zip(LEGS, (course[:, 6:11], course[:, 11:]), (1.0, -1.0), strict=True):
        ankle = numbers[:, :3] * [side, 1.0, 1.0]
        hip = hips + pelvis @ body.offsets[joints[0]]
        hinge = _hinge(hip - ankle, side * numbers[:, 3])
        thighs, shanks = leg(hip, ankle, body.offsets[list(joints)], hinge)
        rotations[:, joints[0]], rotations[:, joints[1]] = thighs, shanks
        rotations[:, list(joints[2:])] = rot.rotation_about_axis("x", numbers[:, 4])[:, None]
    return Motion(with_upper_body(rotations, local), hips, motion.rate, motion.source)


def _hinge(line: Array, outwards: Array) -> Array:
    """Return the axes (T, 3) of knees that point forwards or up, rotated about the leg by angles (T,)."""
    line = line / np.linalg.norm(line, axis=1, keepdims=True)
    lateral = np.array([1.0, 0.0, 0.0]) - line[:, :1] * line
    lateral /= np.linalg.norm(lateral, axis=1, keepdims=True)
    axis: Array = np.cos(outwards)[:, None] * lateral + np.sin(outwards)[:, None] * np.cross(line, lateral)
    return axis


def _course(wearer: _Wearer, frames: int, rate: float) -> tuple[Array, Array]:
    """Return stances (T, 16) over time, and how far the trunk leans forwards in moves between them (T,)."""
    rng = wearer.rng
    course, lean = np.empty((frames, 16)), np.zeros(frames)
    origin = Stance(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, *[wearer.standing_leg(0.0)] * 2)
    kind: _Draw = _stand
    stance, start, rising = _stand(wearer, origin), 0, False
    while start < frames:
        end = min(start + round(rng.uniform(*_REST_S[kind]) * rate), frames)
        course[start:end] = stance.row()
        following = _stand if kind is _crouch and rising else _drawn(_FOLLOWING[kind], rng)
        rising = kind is _sit_on_ground
        target = following(wearer, stance)
        move = round(rng.uniform(0.8, 2.2) * rate)
        share = minimum_jerk(np.arange(move) / move)[: frames - end, None]
        way = (1.0 - share) * stance.row() + share * target.row()
        for first, before, after in ((6, stance.left, target.left), (11, stance.right, target.right)):
            if abs(after.ahead - before.ahead) > 0.05:
                way[:, first + 1] += _LIFT * np.sin(np.pi * share[:, 0]) ** 2
        if {kind, following} == {_kneel, _sit_on_heels}:
            # On an arc about the knees, which would be pushed into the floor on the straight way.
            arc = 0.11 * wearer.thigh * np.sin(np.pi * share) ** 2
            way[:, :2] += arc * [1.0, -1.0]
        course[end : end + move] = way
        depth = min(abs(target.hips_up - stance.hips_up) / wearer.thigh, 1.0)
        most = np.radians(np.clip(rng.normal(18.0, 10.0), 0.0, 50.0)) * depth
        lean[end : end + move] = most * np.sin(np.pi * share[:, 0]) ** 2
        stance, kind, start = target, following, end + move
    return course, lean


def _drawn(choices: tuple[tuple[_Draw, float], ...], rng: np.random.Generator) -> _Draw:
    """Draw one of the choices by their shares."""
    return choices[rng.choice(len(choices), p=[share for _, share in choices])][0]
