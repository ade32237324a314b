"""The body that is posed: SMPL's 24 joints, a default body from a wearer's height, forward kinematics.

Body frame T is SMPL's: X to the wearer's left, Y up, Z forward. In the zero pose (T-pose) every bone frame equals T.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

JOINTS = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle", "spine3",
    "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder", "right_shoulder", "left_elbow",
    "right_elbow", "left_wrist", "right_wrist", "left_hand", "right_hand",
)  # fmt: skip
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)

PREDICTED = (1, 2, 3, 4, 5, 6, 9, 12, 13, 14, 15, 16, 17, 18, 19)
"""Joints that a network predicts (DIP 3.4); feet, toes, wrists and hands stay at rest, joint 0 is measured."""

UNOBSERVED = (1, 2, 3, 6, 9, 12, 13, 14, 16, 17)
"""Predicted joints whose bones carry no sensor."""


def forward_kinematics(local: ArrayLike, offsets: ArrayLike, translation: ArrayLike | None = None) -> tuple[Array, Array]:
    """Global joint rotations and positions of a posed body.

    Args:
        local: (..., 24, 3, 3) rotation of each joint against its parent; joint 0 against the body frame T.
        offsets: (24, 3) joint position minus its parent's in the zero pose, metres; row 0 is the pelvis itself.
        translation: (..., 3) added to all positions, metres.

    Returns:
        (..., 24, 3, 3) global rotations R_TB and (..., 24, 3) positions in T, metres.
    """
    local, offsets = np.asarray(local, float), np.asarray(offsets, float)
    rotations = np.empty_like(local)
    positions = np.empty(local.shape[:-1])
    rotations[..., 0, :, :] = local[..., 0, :, :]
    positions[..., 0, :] = offsets[0] if translation is None else offsets[0] + np.asarray(translation, float)
    for j, parent in enumerate(PARENTS[1:], start=1):
        rotations[..., j, :, :] = rotations[..., parent, :, :] @ local[..., j, :, :]
        positions[..., j, :] = positions[..., parent, :] + rotations[..., parent, :, :] @ offsets[j]
    return rotations, positions


def local_from_global(rotations: ArrayLike) -> Array:
    """Local rotations (..., 24, 3, 3) of global ones: the inverse of the rotation part of `forward_kinematics`."""
    rotations = np.asarray(rotations, float)
    local = np.swapaxes(rotations[..., list(PARENTS), :, :], -1, -2) @ rotations
    local[..., 0, :, :] = rotations[..., 0, :, :]
    return local
