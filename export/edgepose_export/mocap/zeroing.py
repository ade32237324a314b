"""The zero of an actor: bones' frames as a wearer's calibration in the straight pose would define them.

A wearer is calibrated in the straight pose: there every bone has the orientation R_TB0, whatever the body.
Skeletons of motion capture define their zero in their own ways: by a T-pose that nobody took, by markers, by
the axes of an editor. Here the straight pose of each actor is estimated from the actor's own takes, and one
constant right factor for each bone brings it to R_TB0.

Evidence is combined as a mean weighted by precision, bone by bone and axis by axis:

- quiet, upright standing with hanging arms,
- quiet, upright standing whatever the arms do, for all bones but the arms',
- upright walking, plus the mean difference between standing and walking,
- how people stand on average: for limbs only, since directions of limbs mean the same in all sources.

Left and right are averaged: actors stand askew, and a wearer's straight pose is symmetric. Frames: T. Angles
are rotation vectors by which a bone is rotated from R_TB0, as seen from the pelvis' heading.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from edgepose import rotations as rot
from edgepose.skeleton import JOINTS
from edgepose_export.mocap.straight_pose import straight_pose

from .hinges import Bends, hinge_rotations
from .motion import Array, Motion

LEAST_FRAMES = 20
"""Frames of standing or walking, 20 a second, below which they do not count as evidence."""


class Zero(NamedTuple):
    """An actor's zero.

    Attributes:
        directions: (24, 3, 3) right factors that keep the directions of the limbs: `hinges` for limbs,
            `straight` for the trunk. With them a body moves as the actor did, and feet do not slide.
        straight: (24, 3, 3) right factors to frames that have R_TB0 in the straight pose.
        evidence: "standing", "walking", or "none": only limbs are zeroed, as people stand on average, and the
            trunk keeps the zero of the source.
    """

    directions: Array
    straight: Array
    evidence: str

    def applied(self, motion: Motion) -> Motion:
        """Return a take of the actor with bones that have R_TB0 in the straight pose."""
        return motion._replace(rotations=motion.rotations @ self.straight)

    @property
    def back(self) -> Array:
        """Right factors (24, 3, 3) from `straight` to `directions`, for `virtual_imus`."""
        return np.swapaxes(self.straight, -1, -2) @ self.directions


class Evidence(NamedTuple):
    """Evidence of an actor's straight pose, over any number of takes of one skeleton.

    Attributes:
        bends: axes about which elbows and knees bend.
        sums: (kinds, 24, 3, 3) sums of rotations of postures of each kind, seen from the pelvis' heading.
        counts: (kinds,) numbers of these postures.
    """

    bends: Bends
    sums: Array
    counts: Array

    @classmethod
    def of(cls, motion: Motion) -> Evidence:
        """Return that of a take, 20 frames a second."""
        postures = _postures(motion)
        return cls(
            Bends.of(motion),
            np.stack([part.sum(axis=0) for part in postures]),
            np.array([len(part) for part in postures]),
        )

    def plus(self, other: Evidence) -> Evidence:
        """Return that of both."""
        return Evidence(self.bends.plus(other.bends), self.sums + other.sums, self.counts + other.counts)


def find_zero(evidence: Evidence) -> Zero:
    """Return the zero of an actor."""
    hinges = hinge_rotations(evidence.bends)
    total, weight = STANDING_DEG / _SPREAD**2, 1.0 / _SPREAD**2
    found = "none"
    for kind, summed, count in zip(_KINDS, evidence.sums, evidence.counts, strict=True):
        if count < LEAST_FRAMES:
            continue
        # A posture is not better known from a long hold than from two or three short ones.
        precision = count / (count + 60.0) / kind.spread**2
        total = total + precision * (_deviation(summed @ hinges) + kind.offset)
        weight = weight + precision
        found = kind.name if found == "none" else found
    angles = np.radians(total / weight)
    rest = straight_pose()
    straight = hinges @ np.swapaxes(rest, -1, -2) @ rot.rotvec_to_matrix(-angles) @ rest
    directions = straight.copy()
    directions[_LIMBS] = hinges[_LIMBS]
    return Zero(directions, straight, found)


# --- postures ----------------------------------------------------------------------------------------------


def _postures(motion: Motion) -> list[Array]:
    """Return a take's rotations (N, 24, 3, 3), seen from the pelvis' heading, for each of `_KINDS`."""
    step = max(1, round(motion.rate / 20.0))
    reach = max(1, round(0.1 * motion.rate))
    frames = np.arange(reach, len(motion.rotations) - reach, step)
    here = motion.rotations[frames]
    before, after = motion.rotations[frames - reach], motion.rotations[frames + reach]
    turning = (
        rot.geodesic_angle(before[:, _MOVING], after[:, _MOVING]).max(axis=1) * motion.rate / (2 * reach)
    )
    span = max(1, round(0.15 * motion.rate))
    first = np.maximum(frames - span, 0)
    last = np.minimum(frames + span, len(motion.rotations) - 1)
    way = np.linalg.norm((motion.translation[last] - motion.translation[first])[:, [0, 2]], axis=1)
    speed = way / (last - first) * motion.rate
    level = _without_heading(here)
    upright = (_inclination(level, (0, 9), _UP) < UPRIGHT_DEG).all(axis=1)
    legs = _inclination(level, (1, 2, 4, 5), _DOWN).max(axis=1)
    arms = _hanging(level)
    quiet = upright & (legs < 20.0) & (turning < QUIET)
    hanging = (arms[:, :2] < 30.0).all(axis=1) & (arms[:, 2:] < 45.0).all(axis=1)
    walking = upright & (legs < 75.0) & (arms[:, :2] < 45.0).all(axis=1)
    walking &= (speed > WALKING[0]) & (speed < WALKING[1])
    return [level[quiet & hanging], level[quiet & ~hanging], level[walking]]


def _without_heading(rotations: Array) -> Array:
    """Return rotations (T, 24, 3, 3) as seen from the pelvis' heading (the twist about Y)."""
    root = rotations[:, 0]
    heading = np.arctan2(root[:, 0, 2] - root[:, 2, 0], root[:, 0, 0] + root[:, 2, 2])
    level: Array = rot.rotation_about_axis("y", -heading)[:, None] @ rotations
    return level


def _inclination(rotations: Array, joints: tuple[int, ...], axis: Array) -> Array:
    """Return the angles (T, N), degrees, of bones' axes from where the axis points in T."""
    cosine = np.einsum("tnij,j,i->tn", rotations[:, list(joints)], axis, axis)
    angle: Array = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return angle


def _hanging(rotations: Array) -> Array:
    """Return the angles (T, 4), degrees, of upper arms and forearms, left and right, from straight down."""
    sides = np.array([1.0, -1.0, 1.0, -1.0])
    down = -rotations[:, [16, 17, 18, 19], 1, 0] * sides
    angle: Array = np.degrees(np.arccos(np.clip(down, -1.0, 1.0)))
    return angle


def _deviation(summed: Array) -> Array:
    """Return rotation vectors (24, 3), degrees, from R_TB0 to the mean of summed postures, left = right."""
    mean = rot.nearest_rotation(summed)
    angles = np.degrees(rot.matrix_to_rotvec(mean @ np.swapaxes(straight_pose(), -1, -2)))
    symmetric: Array = 0.5 * (angles + angles[_MIRROR] * [1.0, -1.0, -1.0])
    return symmetric


# --- what is known of people -----------------------------------------------------------------------------

UPRIGHT_DEG = 30.0
"""Greatest tilt of pelvis and chest in upright postures; their zero differs between sources."""
QUIET = 0.6
"""rad/s; greatest rate of any bone in a hold."""
WALKING = (0.6, 2.0)
"""m/s; least and greatest speed of walking."""

_UP, _DOWN = np.array([0.0, 1.0, 0.0]), np.array([0.0, -1.0, 0.0])
_MOVING = [0, 1, 2, 4, 5, 9, 15, 16, 17, 18, 19]
_LIMBS = [1, 2, 4, 5, 7, 8, 10, 11, 16, 17, 18, 19, 20, 21, 22, 23]
_SIDES = {"left": "right", "right": "left"}
_MIRROR = [
    JOINTS.index("_".join((_SIDES.get(side, side), rest)) if rest else side)
    for side, _, rest in (name.partition("_") for name in JOINTS)
]

_NOTHING = (0.0, 0.0, 0.0)
_FREE = (60.0, 60.0, 60.0)

# Angles about T's X, Y, Z, degrees, of joints on the left and in the middle, with hinges: mean and standard
# deviation (for standing, doubled: eleven are few) between the 11 actors of CMU and of Seoul National
# University's motion who both stand with hanging arms and walk. Trunks have no common zero.
_STANDING_PEOPLE = {
    "hip": ((-4.8, 5.8, 2.1), (6.2, 9.2, 7.0)),
    "knee": ((11.9, 11.3, 1.4), (4.0, 11.4, 5.0)),
    "shoulder": ((1.3, -1.5, 11.1), (13.8, 18.0, 9.8)),
    "elbow": ((-14.9, -38.5, 11.4), (8.4, 24.0, 10.2)),
}
_WALKING_TO_STANDING = {
    "pelvis": ((0.5, 0.0, 0.0), (2.8, 2.8, 2.8)),
    "spine1": ((-4.4, 0.0, 0.0), (5.3, 5.3, 5.3)),
    "spine2": ((-4.5, 0.0, 0.0), (4.3, 4.3, 4.3)),
    "spine3": ((-4.5, 0.0, 0.0), (4.3, 4.3, 4.3)),
    "neck": ((-3.9, 0.0, 0.0), (4.3, 4.3, 4.3)),
    "head": ((-4.4, 0.0, 0.0), (7.2, 7.2, 7.2)),
    "hip": ((9.9, 0.5, -0.1), (3.8, 2.3, 1.2)),
    "knee": ((-8.7, 1.1, 0.6), (1.8, 3.0, 1.9)),
    "ankle": ((-9.7, 1.0, 1.8), (3.4, 3.1, 2.1)),
    "foot": ((-9.7, 1.0, 1.8), (3.4, 3.1, 2.1)),
    "collar": ((-4.4, -1.0, -1.3), (4.3, 1.5, 1.5)),
    "shoulder": ((-2.8, 3.3, -2.3), (3.0, 11.7, 3.0)),
    "elbow": ((9.5, -0.4, 0.4), (15.8, 7.3, 8.3)),
}
_HOLD_SPREAD = {
    "head": (8.0, 6.0, 6.0),
    "hip": (2.5, 4.0, 2.5),
    "knee": (2.5, 4.0, 2.5),
    "shoulder": (5.0, 8.0, 5.0),
    "elbow": (5.0, 8.0, 5.0),
}
"""How far quiet, upright postures of actors are from their straight pose; 4 deg for other joints."""
_ARMS = ("collar", "shoulder", "elbow", "wrist", "hand")


def _kind(joint: str) -> str:
    side, _, rest = joint.partition("_")
    kind = rest if side in _SIDES else joint
    return {"wrist": "elbow", "hand": "elbow"}.get(kind, kind)  # they keep still against the forearm


def _rows(table: dict[str, tuple[tuple[float, ...], tuple[float, ...]]]) -> tuple[Array, Array]:
    """Return mean and standard deviation (24, 3) of all joints from those of the left ones."""
    rows = [table.get(_kind(name), (_NOTHING, _FREE)) for name in JOINTS]
    mean, spread = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
    right = [name.startswith("right") for name in JOINTS]
    mean[right] *= [1.0, -1.0, -1.0]
    return mean, spread


STANDING_DEG, _SPREAD = _rows(_STANDING_PEOPLE)
_HOLD = np.array([_HOLD_SPREAD.get(_kind(name), (4.0, 4.0, 4.0)) for name in JOINTS])
_ARMS_RAISED = np.where([[_kind(name) in _ARMS] for name in JOINTS], 1e6, _HOLD + 1.0)
_ZEROS = np.zeros((len(JOINTS), 3))


class _Kind(NamedTuple):
    """A kind of evidence.

    Attributes:
        name: see `Zero.evidence`.
        offset: (24, 3) what is added to its rotation vectors, degrees.
        spread: (24, 3) how far they then are from the straight pose, degrees.
    """

    name: str
    offset: Array
    spread: Array


_KINDS = (
    _Kind("standing", _ZEROS, _HOLD),
    _Kind("standing", _ZEROS, _ARMS_RAISED),
    _Kind("walking", *_rows(_WALKING_TO_STANDING)),
)
