"""Motions with known paths, for tests of the place: a body whose legs are solved for given feet."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from edgepose.place import PlaceTracker
from edgepose.rotations import rotation_about_axis
from edgepose.skeleton import default_body, local_from_global

RATE = 60.0
BODY = default_body()
THIGH, SHANK = np.linalg.norm(BODY.offsets[[4, 7]], axis=1)
SOLE = BODY.offsets[10][1]  # height of the sole below the ankle, negative


class Motion(NamedTuple):
    """Poses (T, 24, 3, 3), positions of the pelvis (T, 3), contacts and velocity (T, 10), times (T,)."""

    poses: np.ndarray
    pelvis: np.ndarray
    place: np.ndarray
    time_s: np.ndarray


def motion(pelvis, soles, planted, heading=0.0):
    """The motion of a body with its pelvis (T, 3) and soles (T, 2, 3) there, facing `heading`, radians."""
    frames = len(pelvis)
    heading = np.broadcast_to(np.asarray(heading, float), frames)
    root = rotation_about_axis("y", heading)
    rotations = np.repeat(root[:, None], 24, axis=1)
    for side, (hip, knee) in enumerate(((1, 4), (2, 5))):
        # The law of cosines. The sole is below the ankle along the shank, so it lengthens the shank.
        way = np.einsum("tji,tj->ti", root, soles[:, side] - pelvis - root @ BODY.offsets[hip])
        shank = SHANK - SOLE
        length = np.linalg.norm(way, axis=1).clip(0.2, THIGH + shank - 1e-6)
        at_hip = np.arccos((THIGH**2 + length**2 - shank**2) / (2.0 * THIGH * length))
        at_knee = np.arccos((THIGH**2 + shank**2 - length**2) / (2.0 * THIGH * shank))
        pitch = np.arctan2(way[:, 2], -way[:, 1])
        roll = np.arcsin((way[:, 0] / length).clip(-1.0, 1.0))
        thigh = root @ rotation_about_axis("z", roll) @ rotation_about_axis("x", -pitch - at_hip)
        rotations[:, hip] = thigh
        rotations[:, [knee, knee + 3, knee + 6]] = (thigh @ rotation_about_axis("x", np.pi - at_knee))[
            :, None
        ]
    velocity = np.einsum("tji,tj->ti", root, np.gradient(pelvis, axis=0) * RATE)
    contacts = np.zeros((frames, 7))
    contacts[:, :2] = planted
    place = np.concatenate([contacts, velocity], axis=1).astype(np.float32)
    return Motion(local_from_global(rotations), pelvis, place, np.arange(frames) / RATE)


def walk(steps=12, length=0.35, along=(0.0, 0.0, 1.0), climb=0.0, step_s=0.6, stand_s=0.5):
    """A walk: each foot swings for `step_s` by twice the length, along a direction, `climb` up per step."""
    swing, stand = round(step_s * RATE), round(stand_s * RATE)
    along = np.asarray(along, float)
    across = BODY.offsets[1][0] * np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    feet = across.copy()
    soles, planted = [np.repeat(feet[None], stand, 0)], [np.ones((stand, 2))]
    for k in range(steps):
        share = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, swing + 1) / swing)
        ahead = length * (1 if k in (0, steps - 1) else 2)
        way = np.repeat(feet[None], swing, 0)
        goal = ahead * along + [0.0, climb * (1 if k in (0, steps - 1) else 2), 0.0]
        way[:, k % 2] += share[:, None] * goal
        way[:, k % 2, 1] += (0.08 + max(climb, 0.0)) * np.sin(np.pi * share)
        on = np.ones((swing, 2))
        on[1:-1, k % 2] = 0.0
        soles.append(way)
        planted.append(on)
        feet = way[-1].copy()
    soles.append(np.repeat(feet[None], stand, 0))
    planted.append(np.ones((stand, 2)))
    soles, planted = np.concatenate(soles), np.concatenate(planted)
    pelvis = soles.mean(axis=1)
    pelvis[:, 1] = soles[:, :, 1].min(axis=1) + 0.86
    smooth = np.ones(15) / 15.0
    pelvis[:, 1] = np.convolve(np.pad(pelvis[:, 1], 7, mode="edge"), smooth, "valid")
    return motion(pelvis, soles, planted)


def follow(moved, tracker=None, place=True, every=1):
    """The estimated positions of the pelvis (T, 3)."""
    tracker = tracker or PlaceTracker(BODY)
    places = moved.place if place else [None] * len(moved.poses)
    rows = zip(moved.time_s.tolist(), moved.poses, places, strict=True)
    return np.array([tracker.update(*row).translation for row in list(rows)[::every]])


def relative(path):
    """A path on the ground from its start, with heights as they are."""
    return path - path[0] * [1.0, 0.0, 1.0]
