"""Contacts of a body with its surroundings, and its velocity: targets of the networks' heads for the place.

Both follow from the motion alone. A recording does not say where its floor, stairs, slopes and seats are, so
they are inferred from what rests on them. The lowest point of a body that does not fall touches something. A
foot that comes to rest stays on what it stands on; on stairs each foot is the lowest point of the body for a
part of its stance. A body at rest whose centre of mass is not above its feet sits on something.

Positions and speeds are in metres and seconds, Y up, on the body that the recording is made for.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from edgepose.pose import CONTACTS
from edgepose.skeleton import JOINTS

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

PLACE = len(CONTACTS) + 3
"""Numbers per frame: one contact for each of these joints, then the velocity of the pelvis."""

_PELVIS = 0
_LEG_LENGTH = 0.846
_HEIGHTS = {
    _PELVIS: 0.11,
    **dict.fromkeys((4, 5), 0.06),  # knees
    **dict.fromkeys((7, 8), 0.07),  # ankles
    **dict.fromkeys((10, 11), 0.02),  # toes
    **dict.fromkeys((9, 15, 16, 17), 0.10),  # chest, head, shoulders
    **dict.fromkeys((18, 19), 0.05),  # elbows
    **dict.fromkeys((20, 21), 0.04),  # wrists
}
"""Height of a joint above a surface that the body touches there, with thigh and shank of `_LEG_LENGTH`."""

_MASSES = {
    **{_PELVIS: 0.13, 6: 0.15, 9: 0.15, 15: 0.08},
    **dict.fromkeys((1, 2), 0.07),
    **dict.fromkeys((4, 5), 0.0925),
    **dict.fromkeys((7, 8), 0.0355),
    **dict.fromkeys((16, 17), 0.0135),
    **dict.fromkeys((18, 19), 0.0215),
    **dict.fromkeys((20, 21), 0.014),
}
"""Shares of the body's mass by joint: half of each segment (de Leva 1996) at each of its ends."""

_ENDS_OF_FOOT = {7: 10, 10: 7, 8: 11, 11: 8}
_STILL = {
    **dict.fromkeys((4, 5, 7, 8, 10, 11), (0.4, 0.65)),
    **dict.fromkeys((20, 21), (0.2, 0.35)),
    _PELVIS: (0.1, 0.18),
}
"""Speeds of a joint, m/s: a still phase has a frame below the first one and none above the second."""

_SHORTEST_S, _SHORTEST_SEAT_S = 0.08, 0.3
"""Shortest still phase that is a contact, and the same for the pelvis."""
_GAP_S, _SEAT_GAP_S = 0.05, 0.5
"""Longest gap between two contacts that is closed, and the same for the pelvis."""

_GROUND_S = 0.5
"""Half of the time over which the height of the ground below a still joint is a minimum."""

_FALL = 7.5
"""m/s^2. If the centre of mass accelerates downwards by more, nothing carries the body."""

_REACH, _TOLERANCE = 0.07, 0.04
"""Metres. A still joint touches the ground if it comes as close as `_REACH` to the height of the lowest point
of the body. `_TOLERANCE` is the largest height above its own ground, and above the other end of its foot, so
that raised heels and toes are no contacts.
"""

_SEAT, _FLOOR, _BALANCE = 0.75, 0.36, 0.10
"""Heights of the pelvis above the ground, in leg lengths: below the first it may be on a seat, below the
second it is on the floor or on the heels. In between, the centre of mass decides: without a seat, it cannot
be farther than `_BALANCE` metres outside the points that touch the ground.
"""


class _Body(NamedTuple):
    """A moving body: quantities that decide about contacts."""

    points: Array
    """(T, 24, 3) positions of the joints, smoothed."""
    speed: Array
    """(T, 24) speeds of the joints."""
    clearance: Array
    """(T, 24) heights of the skin below each joint; infinite for joints without an entry in `_HEIGHTS`."""
    centre: Array
    """(T, 3) centre of mass."""
    carried: Mask
    """(T,) whether something carries the body, so that it does not fall freely."""
    leg_length: float
    rate: float


def contacts(joints: Array, rate: float) -> NDArray[np.uint8]:
    """Return which of `CONTACTS` (T, 7) stand still on something: 1, else 0.

    Args:
        joints: (T, 24, 3) positions of the joints, T at least 2.
        rate: frames per second.
    """
    body = _body(joints, rate)
    touching = {joint: _on_ground(body, joint) for joint in _STILL if joint != _PELVIS}
    touching[_PELVIS] = _on_seat(body, touching)
    return np.stack([touching[JOINTS.index(name)] for name in CONTACTS], axis=1).astype(np.uint8)


def level_velocity(translation: Array, pelvis: Array, rate: float) -> Array:
    """Return velocities (T, 3), m/s, in the level frame of the pelvis: Y up, Z where the pelvis faces.

    Args:
        translation: (T, 3) positions of the pelvis joint, T at least 2.
        pelvis: (T, 3, 3) orientations of the pelvis; `normalisation.turn_about_y` defines their heading.
        rate: frames per second.
    """
    velocity = np.gradient(translation, axis=0) * rate
    heading = np.arctan2(pelvis[:, 0, 2] - pelvis[:, 2, 0], pelvis[:, 0, 0] + pelvis[:, 2, 2])
    s, c = np.sin(heading), np.cos(heading)
    x, y, z = velocity.T
    return np.stack([c * x - s * z, y, s * x + c * z], axis=1)


def _body(joints: Array, rate: float) -> _Body:
    points = gaussian_filter1d(joints, 0.02 * rate, axis=0, mode="nearest")
    speed = np.linalg.norm(np.gradient(points, axis=0), axis=-1) * rate
    leg_length = float(np.linalg.norm(joints[0, [1, 2, 4, 5]] - joints[0, [4, 5, 7, 8]], axis=-1).sum() / 2.0)
    clearance = np.full(points.shape[:2], np.inf)
    for joint, height in _HEIGHTS.items():
        clearance[:, joint] = points[:, joint, 1] - height * leg_length / _LEG_LENGTH
    centre = np.average(points[:, list(_MASSES)], axis=1, weights=list(_MASSES.values()))
    height = gaussian_filter1d(centre[:, 1], 0.03 * rate, mode="nearest")
    carried = np.gradient(np.gradient(height)) * rate**2 > -_FALL
    return _Body(points, speed, clearance, centre, carried, leg_length, rate)


def _on_ground(body: _Body, joint: int) -> Mask:
    """Return when (T,) a joint of the limbs stands still on the ground, on a step or on the like."""
    clearance, lowest = body.clearance[:, joint], body.clearance.min(axis=1)
    near = clearance < lowest + _REACH
    if joint in _ENDS_OF_FOOT:
        near &= clearance < body.clearance[:, _ENDS_OF_FOOT[joint]] + _TOLERANCE
    result = np.zeros(len(near), bool)
    for run in _still(body, joint, _SHORTEST_S, body.carried):
        if near[run].any():
            result[run] = clearance[run] < _ground(clearance[run], near[run], body.rate) + _TOLERANCE
    return _closed(result, round(_GAP_S * body.rate), body.carried)


def _ground(clearance: Array, near: Mask, rate: float) -> Array:
    """Return the height (T,) of what a still joint stands on.

    It is the least height within `_GROUND_S` at which the joint is near the ground (T,), interpolated where
    it is not. It may change: a foot that stays where it is while its wearer gets up from the floor has
    another height flat on its side than below the shank.
    """
    lowest = minimum_filter1d(np.where(near, clearance, np.inf), 2 * round(_GROUND_S * rate) + 1)
    known = np.flatnonzero(np.isfinite(lowest))
    ground: Array = np.interp(np.arange(len(lowest)), known, lowest[known])
    return ground


def _on_seat(body: _Body, touching: dict[int, Mask]) -> Mask:
    """Return when (T,) the pelvis rests on a seat or on the ground.

    Args:
        body: the moving body.
        touching: when (T,) other joints touch the ground, by joint.
    """
    angle = np.arange(16) * (2.0 * np.pi / 16)
    directions = np.stack([np.cos(angle), np.sin(angle)])
    # How far the points on the ground reach in each direction: their convex hull.
    reach = np.full((len(body.points), len(angle)), -np.inf)
    ground = np.full(len(body.points), np.inf)
    for joint, mask in touching.items():
        reach[mask] = np.maximum(reach[mask], body.points[mask, joint, ::2] @ directions)
        ground[mask] = np.minimum(ground[mask], body.clearance[mask, joint])
    unbalanced = (body.centre[:, ::2] @ directions - reach > _BALANCE).any(axis=1)
    ground = np.where(np.isinf(ground), body.clearance.min(axis=1), ground)
    height = (body.points[:, _PELVIS, 1] - ground) / body.leg_length
    supported = (unbalanced & (height < _SEAT)) | (height < _FLOOR)
    result = np.zeros(len(height), bool)
    for run in _still(body, _PELVIS, _SHORTEST_SEAT_S, height < _SEAT):
        # A wearer who is about to rise leans forwards, and is balanced while the seat still carries them.
        result[run] = supported[run].mean() > 0.3
    slow = body.speed[:, _PELVIS] < 2.0 * _STILL[_PELVIS][1]
    return _closed(result, round(_SEAT_GAP_S * body.rate), slow)


def _still(body: _Body, joint: int, shortest_s: float, allowed: Mask) -> list[slice]:
    """Return the phases in which a joint is still, as long as it is allowed (T,)."""
    speed, (rest, end) = body.speed[:, joint], _STILL[joint]
    runs = _runs((speed < end) & allowed)
    return [
        run for run in runs if run.stop - run.start >= shortest_s * body.rate and (speed[run] < rest).any()
    ]


def _closed(mask: Mask, gap: int, allowed: Mask) -> Mask:
    """Return a mask (T,) with gaps of up to `gap` frames closed where that is allowed (T,)."""
    result = mask.copy()
    for run in _runs(~mask):
        inside = run.start > 0 and run.stop < len(mask)
        result[run] = inside and run.stop - run.start <= gap and bool(allowed[run].all())
    return result


def _runs(mask: Mask) -> list[slice]:
    """Return the slices of consecutive frames in which a mask (T,) is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8))).tolist()
    return [slice(start, stop) for start, stop in zip(edges[::2], edges[1::2], strict=True)]
