"""Reader of a user's own SMPL model file; only joint offsets and sensor points are taken from it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from edgepose.errors import FileFormatError
from edgepose.placements import PLACEMENTS
from edgepose.skeleton import MAX_HEIGHT, MIN_HEIGHT, PARENTS, Array, Body, default_body
from edgepose.utils.safe_npz import open_npz
from edgepose.utils.safe_pickle import InertObject, numbers, read_pickle

_WHAT = "SMPL model file (.npz or .pkl)"
_ADVICE = (
    "which no SMPL model needs; it was not run. Use the file as downloaded from SMPL's site, or save its "
    "arrays as .npz"
)
SPARSE = ("csc_matrix", "csr_matrix", "csc_array", "csr_array")
MIN_BONE, MAX_BONE = 0.005, 1.0
"""Shortest and longest believable distance between a joint and its parent, metres."""

_MAX_VALUE = 1e6  # in millimetres, all coordinates and weights are smaller


# --- arrays -------------------------------------------------------------------------------------------------


def _floats(value: Any, name: str, path: Path) -> Array:
    """Return a value of the file as an array; raise FileFormatError if its numbers are absurd."""
    array = numbers(value, name, path).astype(float)
    if array.size and np.abs(array).max() > _MAX_VALUE:
        raise FileFormatError(f"{path}: {name} contains {np.abs(array).max():.3g}, which no body has")
    return array


def _is_known(module: str, name: str) -> bool:
    """Return whether SMPL's pickles contain objects of a class, from which arrays can be taken."""
    chumpy = module.partition(".")[0] == "chumpy"
    return chumpy or (module.startswith("scipy.sparse") and name in SPARSE)


def _regressor(value: Any, n_vertices: int, path: Path) -> Array:
    """Return a dense (24, V) joint regressor from a dense or sparse one."""
    name, shape = "J_regressor", (len(PARENTS), n_vertices)
    if not (isinstance(value, InertObject) and type(value).__name__ in SPARSE):
        dense = _floats(value, name, path)
        _check_shape(dense.shape, shape, name, path)
        return dense
    state = value.state if isinstance(value.state, dict) else {}
    data = _floats(state.get("data"), f"{name}.data", path)
    indices, indptr = (numbers(state.get(key), f"{name}.{key}", path) for key in ("indices", "indptr"))
    # The name of the shape depends on the version of scipy.
    found = numbers(state.get("_shape", state.get("shape")), f"{name}.shape", path)
    _check_shape(tuple(found.tolist()), shape, name, path)
    by_column = type(value).__name__.startswith("csc")
    n_major, n_minor = shape[::-1] if by_column else shape
    broken = FileFormatError(f"{path}: {name} is not a valid sparse matrix")
    if data.ndim != 1 or indices.shape != data.shape or indptr.shape != (n_major + 1,):
        raise broken
    if indices.dtype.kind == "f" or indptr.dtype.kind == "f":
        raise broken
    indices, indptr = indices.astype(np.int64), indptr.astype(np.int64)
    counts = np.diff(indptr)
    if indptr[0] != 0 or indptr[-1] != len(data) or np.any(counts < 0):
        raise broken
    if np.any((indices < 0) | (indices >= n_minor)):
        raise broken
    dense = np.zeros((n_major, n_minor))
    np.add.at(dense, (np.repeat(np.arange(n_major), counts), indices), data)
    return dense.T if by_column else dense


def _check_shape(found: tuple[Any, ...], wanted: tuple[int, ...], name: str, path: Path) -> None:
    if found != wanted:
        raise FileFormatError(
            f"{path}: {name} has shape {found} instead of {wanted}; "
            "SMPL with 24 joints is needed, not SMPL-H or SMPL-X"
        )


def _joints(model: Mapping[Any, Any], vertices: Array | None, path: Path) -> Array:
    """Return the joint positions (24, 3) of the zero pose, metres."""
    if "J" in model:
        joints = _floats(model["J"], "J", path)
    elif "J_regressor" in model and vertices is not None:
        joints = _regressor(model["J_regressor"], len(vertices), path) @ vertices
    else:
        raise FileFormatError(f"{path}: needs J, or J_regressor and v_template")
    _check_shape(joints.shape, (len(PARENTS), 3), "J", path)
    return joints


# --- the body -----------------------------------------------------------------------------------------------


def _sensors(offsets: Array) -> tuple[Array, float]:
    """Estimate the sensor points (6, 3) and stature of a body from its bones and the default body."""
    default = default_body()

    def ratio(*joints: int) -> float:
        rows = list(joints)
        length, default_length = (np.linalg.norm(o[rows].sum(axis=0)) for o in (offsets, default.offsets))
        return float(length / default_length)

    # The bone under each sensor; the head has no joint beyond it and is scaled like the trunk.
    trunk = (3, 6, 9, 12)
    scales = dict(
        zip(PLACEMENTS, (ratio(20), ratio(21), ratio(7), ratio(8), ratio(*trunk), ratio(*trunk)), strict=True)
    )
    legs = (ratio(4) + ratio(5) + ratio(7) + ratio(8)) / 4
    height = default.height_m * (legs + ratio(*trunk, 15)) / 2
    return default.sensors * np.array([scales[name] for name in PLACEMENTS])[:, None], height


def read_smpl(path: str | Path) -> Body:
    """Read the body from an SMPL model file, .npz or .pkl, for which the user has a licence.

    Joints are the file's `J`, or `J_regressor @ v_template`. Stature is the height of `v_template`, or
    follows from the bones. Sensor points are the default body's, scaled with the bones. No code in the file
    is run.

    Raises:
        FileFormatError: the file cannot be read, contains code, or is not a 24-joint SMPL model in metres.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            zipped = file.read(2) == b"PK"
        model = _read_npz(path) if zipped else read_pickle(path, _WHAT, _ADVICE, _is_known)
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read: {error.strerror or error}") from error
    if "kintree_table" in model:
        tree = numbers(model["kintree_table"], "kintree_table", path)
        _check_shape(tree.shape, (2, len(PARENTS)), "kintree_table", path)
        # The root's parent is -1 as an unsigned number.
        if tree[0, 1:].tolist() != list(PARENTS[1:]):
            raise FileFormatError(f"{path}: kintree_table does not have SMPL's order of joints")

    vertices = None
    if "v_template" in model:
        vertices = _floats(model["v_template"], "v_template", path)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or not len(vertices):
            raise FileFormatError(f"{path}: v_template has shape {vertices.shape} instead of (vertices, 3)")
    joints = _joints(model, vertices, path)
    offsets = np.zeros_like(joints)
    offsets[1:] = joints[1:] - joints[list(PARENTS[1:])]
    sensors, height = _sensors(offsets)
    if vertices is not None:
        height = float(np.ptp(vertices[:, 1]))
    if not MIN_HEIGHT <= height <= MAX_HEIGHT:
        raise FileFormatError(f"{path}: the body is {height:.3g} m tall; SMPL models are in metres with Y up")
    lengths = np.linalg.norm(offsets[1:], axis=1)
    if lengths.min() < MIN_BONE:
        joint = 1 + int(np.argmin(lengths))
        raise FileFormatError(f"{path}: joint {joint} coincides with its parent; these are not SMPL's joints")
    if lengths.max() > MAX_BONE:
        joint = 1 + int(np.argmax(lengths))
        raise FileFormatError(
            f"{path}: joint {joint} is {lengths.max():.3g} m from its parent; these are not SMPL's joints"
        )
    return Body(offsets, sensors, height)


def _read_npz(path: Path) -> dict[Any, Any]:
    wanted = ("J", "J_regressor", "v_template", "kintree_table")
    try:
        with open_npz(path) as file:
            # With J in the file the regressor, which may be a pickled sparse matrix, is not needed.
            names = [
                name
                for name in wanted
                if name in file.files and not (name == "J_regressor" and "J" in file.files)
            ]
            return {name: file[name] for name in names}
    except (OSError, FileFormatError):
        raise
    except Exception as error:  # a broken archive can raise any exception
        reason = str(error).partition("\n")[0]
        raise FileFormatError(f"{path}: not a readable {_WHAT}: {reason}") from error
