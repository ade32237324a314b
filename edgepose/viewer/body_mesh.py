"""Body of simple solids for 3-D views: cylinders along bones, balls at joints, a head with a nose."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edgepose.rotations import matrix_to_quat, minimal_rotation
from edgepose.skeleton import JOINTS, PARENTS, forward_kinematics

Array = NDArray[np.float64]

RADII = {
    "pelvis": 0.115, "hip": 0.08, "spine1": 0.115, "knee": 0.068, "spine2": 0.115, "ankle": 0.05,
    "spine3": 0.12, "foot": 0.04, "neck": 0.055, "collar": 0.075, "head": 0.05, "shoulder": 0.06,
    "elbow": 0.047, "wrist": 0.038, "hand": 0.035,
}  # fmt: skip
"""Radius of the bone that ends at a joint, and of the ball of the pelvis, metres."""

TIPS = {10: (0.0, 0.0, 0.06), 11: (0.0, 0.0, 0.06), 22: (0.07, 0.0, 0.0), 23: (-0.07, 0.0, 0.0)}
"""Ends of feet and hands: joint, and position in its frame, metres."""

HEAD, HEAD_SIZE = (0.0, 0.09, 0.02), (0.08, 0.115, 0.095)
NOSE, NOSE_SIZE = (0.0, 0.075, 0.12), (0.016, 0.022, 0.016)


class BodyMesh(NamedTuple):
    """Solids of one kind: cylinders of radius and length 1 along Z, or balls of radius 1, about their centre.

    Attributes:
        joints: (N,) joint in whose frame each is fixed.
        rotations: (N, 3, 3) their axes in that frame.
        centres: (N, 3) their centres in that frame, metres.
        sizes: (N, 3) scale factors along their axes.
        sides: N names "left", "trunk", "right".
    """

    joints: NDArray[np.int64]
    rotations: Array
    centres: Array
    sizes: Array
    sides: list[str]

    def posed(self, rotations: Array, positions: Array) -> tuple[Array, Array]:
        """Return unit quaternions (N, 4) and centres (N, 3) for global joints (24, 3, 3), (24, 3)."""
        frames = rotations[self.joints]
        centres = positions[self.joints] + (frames @ self.centres[:, :, None])[..., 0]
        return matrix_to_quat(frames @ self.rotations), centres


def _side(joint: int) -> str:
    side = JOINTS[joint].partition("_")[0]
    return side if side in ("left", "right") else "trunk"


def radius(joint: int) -> float:
    """Return the radius of the bone that ends at a joint, metres."""
    return RADII[JOINTS[joint].rpartition("_")[2]]


def build(offsets: ArrayLike) -> tuple[BodyMesh, BodyMesh]:
    """Return the cylinders and balls of a body with `offsets` (24, 3), metres."""
    offsets = np.asarray(offsets, float)
    bones = [(PARENTS[j], np.zeros(3), offsets[j], radius(j), _side(j)) for j in range(1, len(JOINTS))]
    bones += [(j, np.zeros(3), np.array(tip), radius(j), _side(j)) for j, tip in TIPS.items()]
    along = np.stack([end - start for _, start, end, _, _ in bones])
    lengths = np.linalg.norm(along, axis=1)
    # The nudge gives bones without length, or against Z, some direction.
    directions = along + np.array([1e-6, 0.0, 0.0])
    cylinders = BodyMesh(
        np.array([joint for joint, *_ in bones]),
        minimal_rotation([0.0, 0.0, 1.0], directions),
        np.stack([(start + end) / 2 for _, start, end, _, _ in bones]),
        np.stack(
            [(radius, radius, length) for (_, _, _, radius, _), length in zip(bones, lengths, strict=True)]
        ),
        [side for *_, side in bones],
    )
    balls = [(joint, end, (radius,) * 3, side) for joint, _, end, radius, side in bones]
    balls += [(0, np.zeros(3), (RADII["pelvis"],) * 3, "trunk")]
    balls += [(15, np.array(HEAD), HEAD_SIZE, "trunk"), (15, np.array(NOSE), NOSE_SIZE, "trunk")]
    return cylinders, BodyMesh(
        np.array([joint for joint, *_ in balls]),
        np.tile(np.eye(3), (len(balls), 1, 1)),
        np.stack([centre for _, centre, _, _ in balls]),
        np.array([size for _, _, size, _ in balls]),
        [side for *_, side in balls],
    )


def ground(rotations: ArrayLike, offsets: ArrayLike, translation: ArrayLike | None = None) -> float:
    """Return the height of the lowest point of the body over all poses (..., 24, 3, 3), metres."""
    _, joints = forward_kinematics(rotations, offsets, translation)
    return float(joints[..., 1].min()) - RADII["foot"]
