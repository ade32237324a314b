"""Takes joined to long tracks, and situations made from takes, for `bench_drift.py`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.placements import BONES, PLACEMENTS, ROOT
from edgepose.skeleton import default_body, forward_kinematics, global_rotations
from edgepose_export.training.dataset import RATE, Take

Array = NDArray[np.float64]

FADE = 30
"""Frames over which the sensors pass from one take to the next."""

_HEAD, _HIPS = 15, (1, 2)
_RIGHT_ARM = (14, 17, 19)


class Track(NamedTuple):
    """Takes one after the other; each goes on in the direction in which the pelvis faced before.

    Attributes:
        take: all of them.
        counts: (T,) whether a frame is one of a take, not between two.
    """

    take: Take
    counts: NDArray[np.bool_]


def turned(take: Take, angles: Array) -> Take:
    """Return a take whose sensors are turned about the vertical by angles (T, 6), rad."""
    rotations = rot.rotation_about_axis("y", angles)
    return take._replace(
        orientation=(rotations @ take.orientation).astype(np.float32),
        acceleration=(rotations @ take.acceleration[..., None])[..., 0].astype(np.float32),
    )


def moved(take: Take, rotation: Array) -> Take:
    """Return a take in which everything is rotated by (3, 3) or (T, 3, 3)."""
    pose = take.pose.copy()
    pose[:, 0] = rotation @ take.pose[:, 0]
    each = rotation if rotation.ndim == 2 else rotation[:, None]
    return take._replace(
        orientation=(each @ take.orientation).astype(np.float32),
        acceleration=(each @ take.acceleration[..., None])[..., 0].astype(np.float32),
        pose=pose,
    )


def joined(takes: Sequence[Take], order: Sequence[int]) -> Track:
    """Join takes in an order."""
    parts: list[Take] = []
    counts: list[NDArray[np.bool_]] = []
    for index in order:
        take = takes[index]
        if parts:
            last = parts[-1].orientation[-1]
            face = rot.yaw_of_matrix(last[ROOT]) - rot.yaw_of_matrix(take.orientation[0, ROOT])
            take = _faded(moved(take, rot.rotation_about_axis("y", face)), last)
        parts.append(take)
        counts.append(np.arange(len(take.pose)) >= (FADE if len(parts) > 1 else 0))
    columns = [np.concatenate(column) for column in zip(*((t[1], t[2], t[3]) for t in parts), strict=True)]
    return Track(Take("track", *columns, ""), np.concatenate(counts))


def _faded(take: Take, last: NDArray[np.float32]) -> Take:
    """Let the first frames pass over from the last orientations (6, 3, 3) before them."""
    orientation = take.orientation.copy()
    away = rot.matrix_to_rotvec(last.astype(float) @ rot.transpose(orientation[0].astype(float)))
    for k in range(min(FADE, len(orientation))):
        share = (k + 1.0) / (FADE + 1.0)
        orientation[k] = (
            rot.rotvec_to_matrix((1.0 - share * share * (3.0 - 2.0 * share)) * away) @ orientation[k]
        )
    return take._replace(orientation=orientation)


def random_track(kinds: Sequence[Sequence[Take]], seconds: float, rng: np.random.Generator) -> Track:
    """Join takes of several kinds, 40 to 120 s of each in turn, to a track of a length."""
    takes = [take for kind in kinds for take in kind]
    first = np.cumsum([0, *(len(kind) for kind in kinds)])
    order: list[int] = []
    frames, turn = 0, 0
    while frames < seconds * RATE:
        end = min(frames + rng.uniform(40.0, 120.0) * RATE, seconds * RATE)
        kind = turn % len(kinds)
        while frames < end:
            order.append(int(rng.integers(first[kind], first[kind + 1])))
            frames += len(takes[order[-1]].pose)
        turn += 1
    track = joined(takes, order)
    length = round(seconds * RATE)
    cut = track.take._replace(**{n: getattr(track.take, n)[:length] for n in Take._fields[1:4]})
    return Track(cut, track.counts[:length])


def drift(take: Take, bias: Array, scale: Array) -> Array:
    """Return heading errors (T, 6), rad, of gyroscopes with biases (6,), rad/s, and scale errors (6,)."""
    r = take.orientation.astype(float)
    steps = rot.matrix_to_rotvec(r[1:] @ rot.transpose(r[:-1]))[..., 1]
    angle = np.concatenate([np.zeros((1, len(PLACEMENTS))), np.cumsum(steps, axis=0)])
    return bias * np.arange(len(r))[:, None] / RATE + scale * angle


# --- situations ---------------------------------------------------------------------------------------------


def turning(take: Take) -> Take:
    """Let the wearer turn on the spot: half a turn in 2 s, to the left and later back, then 2 s of rest."""
    time_s = np.arange(len(take.pose)) / RATE
    angle = np.pi * (np.clip(time_s % 8.0, 0.0, 2.0) - np.clip(time_s % 8.0 - 4.0, 0.0, 2.0)) / 2.0
    return moved(take, rot.rotation_about_axis("y", angle))


def lying(take: Take) -> Take:
    """Lay the wearer on the back."""
    face = float(rot.yaw_of_matrix(take.orientation[0, ROOT].astype(float)))
    there = rot.rotation_about_axis("y", face)
    return moved(take, there @ rot.rotation_about_axis("x", -np.pi / 2.0) @ there.T)


def sitting_askew(take: Take) -> Take:
    """Turn legs and feet by 25 deg to the left of the pelvis, and the head by 20 deg to the right."""
    bones = global_rotations(take.pose)
    left, right = (rot.rotation_about_axis("y", np.radians(angle)) for angle in (25.0, -20.0))
    pose, angles = take.pose.copy(), np.zeros((len(take.pose), len(PLACEMENTS)))
    for hip in _HIPS:
        pose[:, hip] = rot.transpose(bones[:, 0]) @ left @ bones[:, hip]
    pose[:, _HEAD] = rot.transpose(bones[:, 12]) @ right @ bones[:, _HEAD]
    angles[:, 2:4], angles[:, 4] = np.radians(25.0), np.radians(-20.0)
    return turned(take, angles)._replace(pose=pose)


def one_armed(take: Take) -> Take:
    """Let the right arm work in front of the other side of the body; the forearm goes to and fro."""
    time_s = np.arange(len(take.pose)) / RATE
    collar, shoulder, elbow = _RIGHT_ARM
    pose = take.pose.astype(float)
    pose[:, collar] = np.eye(3)
    pose[:, shoulder] = rot.euler_to_matrix(np.radians([70.0, 25.0]), "yz")
    pose[:, elbow] = rot.rotation_about_axis("y", np.radians(50.0 + 20.0 * np.sin(np.pi * time_s)))
    sensor = PLACEMENTS.index("right_forearm")
    bones, points = forward_kinematics(pose, default_body().offsets)
    orientation, acceleration = take.orientation.copy(), take.acceleration.copy()
    orientation[:, sensor] = bones[:, BONES[sensor]]
    moving = np.gradient(np.gradient(points[:, elbow] - points[:, 0], axis=0), axis=0) * RATE**2
    acceleration[:, sensor] = acceleration[:, ROOT] + moving
    return take._replace(orientation=orientation, acceleration=acceleration, pose=pose.astype(np.float32))
