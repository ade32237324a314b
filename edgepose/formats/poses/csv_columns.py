"""Columns of pose CSV files, described in docs/reference/outputs.md."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from edgepose.pose import CONTACTS
from edgepose.rotations import matrix_to_euler_zxy, matrix_to_quat, matrix_to_rotvec
from edgepose.skeleton import JOINTS

ROTATION_FORMATS = {
    "axis-angle": ("x", "y", "z"),
    "quat": ("w", "x", "y", "z"),
    "matrix": ("r00", "r01", "r02", "r10", "r11", "r12", "r20", "r21", "r22"),
    "euler": ("rz", "rx", "ry"),
}
"""Column endings of each representation; euler: R = Rz Rx Ry, rotations about the moving axes."""


TRANSLATION = ("trans_x", "trans_y", "trans_z")
"""Columns of the position of the pelvis, metres."""

CONTACT = tuple(f"contact_{joint}" for joint in CONTACTS)
"""Columns of the probabilities of contact."""


def rotation_columns(rotations: str) -> list[str]:
    """Return the names of the columns of all joints, in order; `rotations` is a key of `ROTATION_FORMATS`."""
    return [f"{joint}_{end}" for joint in JOINTS for end in ROTATION_FORMATS[rotations]]


def pose_columns(rotations: str, std: bool, translation: bool = False, contacts: bool = False) -> list[str]:
    """Return the names of all columns, in order; `rotations` is a key of `ROTATION_FORMATS`."""
    names = ["frame", "time_s", "status", *rotation_columns(rotations)]
    names += [f"{joint}_std" for joint in JOINTS] if std else []
    names += TRANSLATION if translation else ()
    return [*names, *CONTACT] if contacts else names


def numbers(rotations: str, matrices: NDArray[Any]) -> NDArray[Any]:
    """Convert rotation matrices (24, 3, 3) to the representation `rotations`, (24, n)."""
    if rotations == "axis-angle":
        return matrix_to_rotvec(matrices)
    if rotations == "quat":
        return matrix_to_quat(matrices)
    if rotations == "euler":
        return matrix_to_euler_zxy(matrices)
    return matrices
