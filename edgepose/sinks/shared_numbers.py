"""Numbers of a pose that several outputs need, computed once.

They are kept by the values of the rotations, not by the pose, whose arrays a caller may use again.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from edgepose.pose import Array, PoseFrame
from edgepose.rotations import matrix_to_quat, quat_to_rotvec
from edgepose.skeleton import JOINTS

_KEPT = 16
"""Poses that are kept: few, because a pose goes to all outputs of its wearer before the next one comes."""

_TEXT = ",".join(["%.6f"] * 3 * len(JOINTS))


def quats(pose: PoseFrame) -> Array:
    """Return the quaternions (24, 4) of a pose, w >= 0; the array is read-only."""
    return _quats(*_key(pose))


def rotvecs(pose: PoseFrame) -> Array:
    """Return the axis-angle vectors (24, 3) of a pose, radians; the array is read-only."""
    return _rotvecs(*_key(pose))


def rotvec_text(pose: PoseFrame) -> str:
    """Return the 72 axis-angle numbers of a pose, radians, with six decimals and commas between them."""
    return _rotvec_text(*_key(pose))


def _key(pose: PoseFrame) -> tuple[bytes, str]:
    return pose.rotations.tobytes(), pose.rotations.dtype.str


@lru_cache(_KEPT)
def _quats(matrices: bytes, kind: str) -> Array:
    result = matrix_to_quat(np.frombuffer(matrices, kind).reshape(-1, 3, 3))
    result.setflags(write=False)
    return result


@lru_cache(_KEPT)
def _rotvecs(matrices: bytes, kind: str) -> Array:
    result = quat_to_rotvec(_quats(matrices, kind))
    result.setflags(write=False)
    return result


@lru_cache(_KEPT)
def _rotvec_text(matrices: bytes, kind: str) -> str:
    return _TEXT % tuple(_rotvecs(matrices, kind).ravel().tolist())
