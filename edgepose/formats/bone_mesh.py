"""A figure for viewers: a solid of eight faces along each bone of the body."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose.skeleton import JOINTS, PARENTS, TIPS, forward_kinematics

_WIDTH = 0.12
"""Width of a solid from its axis to its corners, as a share of its length."""

_WIDEST_M = 0.035

_WAIST = 0.25
"""Place of the corners between the start and the end of a bone."""


class BoneMesh(NamedTuple):
    """Triangles, three vertices each, in the T-pose with the pelvis at the origin.

    Attributes:
        positions: (N, 3) vertices, metres.
        normals: (N, 3) unit vectors away from the solids.
        joints: (N,) joint that moves each vertex.
    """

    positions: NDArray[np.float32]
    normals: NDArray[np.float32]
    joints: NDArray[np.uint8]


def bone_mesh(offsets: NDArray[np.float64]) -> BoneMesh:
    """Build the figure of a body.

    Args:
        offsets: (24, 3) joint positions minus their parents', metres.
    """
    rest = np.broadcast_to(np.eye(3), (len(JOINTS), 3, 3))
    joints = forward_kinematics(rest, offsets)[1] - offsets[0]
    ends = [(parent, joints[joint]) for joint, parent in enumerate(PARENTS) if parent >= 0]
    ends += [(joint, joints[joint] + tip) for joint, tip in TIPS.items()]
    triangles = [_solid(joints[joint], end) for joint, end in ends]
    positions = np.concatenate(triangles)
    normals = np.cross(positions[:, 1] - positions[:, 0], positions[:, 2] - positions[:, 0])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    moved_by = np.repeat([joint for joint, _ in ends], [3 * len(solid) for solid in triangles])
    return BoneMesh(
        positions.reshape(-1, 3).astype("<f4"),
        np.repeat(normals, 3, axis=0).astype("<f4"),
        moved_by.astype("u1"),
    )


def _solid(start: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the triangles (8, 3, 3) of the solid along a bone, counterclockwise from outside."""
    along = end - start
    length = float(np.linalg.norm(along))
    across = np.cross(along, np.eye(3)[np.abs(along).argmin()])
    across *= min(_WIDTH * length, _WIDEST_M) / np.linalg.norm(across)
    other = np.cross(along, across) / length
    waist = start + _WAIST * along
    corners = [waist + across, waist + other, waist - across, waist - other]
    triangles = []
    for corner, following in zip(corners, [*corners[1:], corners[0]], strict=True):
        triangles += [(start, following, corner), (end, corner, following)]
    return np.array(triangles)
