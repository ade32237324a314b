"""Mapping files: TOML that says which joint is which, for skeletons whose names are not understood."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError
from edgepose.utils.text_files import read_toml

from .skeleton_roles import ROLES
from .skeleton_size import UNITS

Array = NDArray[np.float64]

_AXES = {"x": 0, "y": 1, "z": 2}


class Mapping(NamedTuple):
    """What a user says about a skeleton."""

    joints: dict[str, str] = {}  # noqa: RUF012
    """Names of joints by role (`ROLES`)."""
    unit: str | float | None = None
    """Unit of length, a key of `UNITS`, or metres; None if not given."""
    up: Array | None = None
    """(3,) the up axis of the file's world; None if not given."""


def read_mapping(path: str | Path) -> Mapping:
    """Read a mapping file: `unit`, `up`, and joints by role, all optional.

        unit = "cm"
        up = "z"
        left_thigh = "Bone.012"

    Raises:
        EdgeposeError: it cannot be read, or a key or value is unknown.
    """
    path = Path(path)
    fields = read_toml(path)
    unit, up = _unit(path, fields.pop("unit", None)), _up(path, fields.pop("up", None))
    for role, joint in fields.items():
        if role not in ROLES:
            raise EdgeposeError(f"{path}: unknown key {role!r}; known are unit, up, {', '.join(ROLES)}")
        if not isinstance(joint, str):
            raise EdgeposeError(f"{path}: {role} must be the name of a joint, in quotes")
    twice = [role for role in fields if list(fields.values()).count(fields[role]) > 1]
    if twice:
        raise EdgeposeError(f"{path}: {' and '.join(twice[:2])} are the same joint")
    return Mapping(fields, unit, up)


def _unit(path: Path, value: Any) -> str | float | None:
    if value is None or (isinstance(value, str) and value in UNITS):
        return value
    if isinstance(value, int | float) and not isinstance(value, bool) and 1e-6 < value < 1e3:
        return float(value)
    raise EdgeposeError(f"{path}: unit must be one of {', '.join(UNITS)}, or its length in metres")


def _up(path: Path, value: Any) -> Array | None:
    if value is None:
        return None
    axis = str(value).lower()
    if axis.lstrip("+-") not in _AXES or len(axis) > 2:
        raise EdgeposeError(f"{path}: up must be x, y, z, -x, -y or -z")
    return (-1.0 if axis[0] == "-" else 1.0) * np.eye(3)[_AXES[axis.lstrip("+-")]]
