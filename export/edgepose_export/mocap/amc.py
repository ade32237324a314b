"""Reader for Acclaim motion capture: a skeleton (ASF) and its motion (AMC)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError
from edgepose.formats.joint_tree import JointTree, fail, numbers
from edgepose.rotations import euler_to_matrix, transpose

Array = NDArray[np.float64]

AMC_RATE = 120.0
"""Frames per second of the CMU recordings; the format has no field for it."""

_INCH = 0.0254
_FREEDOMS = ("rx", "ry", "rz", "tx", "ty", "tz")


class Skeleton(NamedTuple):
    """An ASF skeleton in its zero pose; frames are parallel to the world's there."""

    names: tuple[str, ...]
    """The root, then the bones; each after its parent."""
    parents: tuple[int, ...]
    offsets: Array
    """(J, 3) start of each bone minus start of its parent, metres; for the root its position."""
    axes: Array
    """(J, 3, 3) frames in which the bones' angles are given."""
    freedoms: tuple[tuple[str, ...], ...]
    """Values that the motion gives for each bone, in order: rx, ry, rz, tx, ty, tz."""
    metre: float
    """Metres in one unit of length of the file."""
    radian: float
    """Radians in one unit of angle of the skeleton file."""


class _Bone(NamedTuple):
    vector: Array
    axis: Array
    freedoms: tuple[str, ...]


def find_asf(path: str | Path) -> Path:
    """The skeleton beside a motion file: 07_01.amc belongs to 07.asf, or to the only skeleton in its folder.

    Raises:
        EdgeposeError: there is none, or it is not clear which.
    """
    path = Path(path)
    found = sorted(file for file in path.parent.glob("*") if file.suffix.lower() == ".asf")
    named = [file for file in found if file.stem in (path.stem, path.stem.split("_")[0])]
    for candidates in (named, found):
        if len(candidates) == 1:
            return candidates[0]
    raise EdgeposeError(f"{path}: needs its skeleton, {path.stem.split('_')[0]}.asf, in the same folder")


def read_amc(path: str | Path, skeleton: str | Path | None = None, rate: float = AMC_RATE) -> JointTree:
    """All frames of an AMC file, lengths in metres.

    Args:
        path: the motion.
        skeleton: its ASF file; None looks beside the motion, see `find_asf`.
        rate: frames per second, which the file does not say.

    Raises:
        EdgeposeError: a file cannot be read, breaks the format, is cut short, or holds a number that is not
            finite.
    """
    path = Path(path)
    body = read_asf(find_asf(path) if skeleton is None else skeleton)
    joint_of = {name: joint for joint, name in enumerate(body.names)}
    moving = {name for name, freedoms in zip(body.names, body.freedoms, strict=True) if freedoms}
    radian = body.radian
    columns: dict[str, list[list[float]]] = {name: [] for name in moving}
    frames = last = 0
    missing: set[str] = set()
    for number, words in _lines(path):
        key = words[0]
        if key.startswith(":"):
            units = {":DEGREES": math.pi / 180, ":RADIANS": 1.0}
            radian = units.get(key.upper(), radian)
        elif key.isdecimal() and len(key) < 16 and len(words) == 1:
            if missing:
                fail(path, number, f"frame {last} lacks {min(missing)}")
            if frames and int(key) != last + 1:  # excerpts do not start at 1
                fail(path, number, f"frame {last + 1} was expected, this is {key}")
            last = int(key)
            frames += 1
            missing = set(moving)
        elif not frames:
            fail(path, number, "a frame number was expected")
        elif key not in moving:
            fail(path, number, f"bone {key!r} has no freedom in the skeleton, or is not in it")
        elif key not in missing:
            fail(path, number, f"bone {key!r} twice in a frame")
        else:
            missing.remove(key)
            columns[key].append(numbers(path, number, words[1:], len(body.freedoms[joint_of[key]])))
    if missing or not frames:
        raise EdgeposeError(
            f"{path}: ends within frame {last} (cut short?)" if frames else f"{path}: no frames"
        )

    rotations = np.broadcast_to(np.eye(3), (frames, len(body.names), 3, 3)).copy()
    positions = np.broadcast_to(body.offsets, (frames, len(body.names), 3)).copy()
    for name in moving:
        joint, freedoms = joint_of[name], body.freedoms[joint_of[name]]
        table = np.array(columns[name])
        turns = [i for i, freedom in enumerate(freedoms) if freedom[0] == "r"]
        # The first listed angle turns first, so it stands last in the product.
        order = "".join(freedoms[i][1] for i in reversed(turns))
        turn = euler_to_matrix(table[:, turns[::-1]] * radian, order) if turns else np.eye(3)
        rotations[:, joint] = body.axes[joint] @ turn @ transpose(body.axes[joint])
        for i, freedom in enumerate(freedoms):
            if freedom[0] == "t":
                positions[:, joint, "xyz".index(freedom[1])] += table[:, i] * body.metre
    return JointTree(body.names, body.parents, body.offsets, rotations, positions, rate)


def read_asf(path: str | Path) -> Skeleton:
    """The skeleton in an ASF file.

    Raises:
        EdgeposeError: the file cannot be read, breaks the format, is cut short, or holds a number that is not
            finite.
    """
    path = Path(path)
    metre, radian = _INCH, math.pi / 180
    section = ""
    root: dict[str, tuple[int, list[str]]] = {}
    current: dict[str, tuple[int, list[str]]] | None = None
    bones: dict[str, _Bone] = {}
    parent_of: dict[str, str] = {}
    closed = False
    for number, words in _lines(path):
        key = words[0].lower()
        if key.startswith(":"):
            section = key
            closed = False
        elif section == ":units" and key == "length":
            scale = numbers(path, number, words[1:], 1)[0]
            if scale <= 0:
                fail(path, number, "the length unit must be positive")
            metre = _INCH / scale  # lengths are inches times this number
        elif section == ":units" and key == "angle":
            radian = 1.0 if words[1:2] == ["rad"] else math.pi / 180
        elif section == ":root":
            root[key] = (number, words[1:])
        elif section == ":bonedata":
            if key == "begin":
                current = {}
            elif key == "end" and current is not None:
                name, bone = _bone(path, number, current, metre, radian)
                if name in bones or name == "root":
                    fail(path, number, f"bone {name!r} is defined twice")
                bones[name] = bone
                current = None
            elif current is None:
                fail(path, number, "a bone must begin with 'begin'")
            else:
                current.setdefault(key, (number, words[1:]))
        elif section == ":hierarchy":
            if key == "end":
                closed = True
            elif key != "begin":
                for child in words[1:]:
                    if child not in bones or child in parent_of:
                        fail(path, number, f"bone {child!r} is not defined, or has two parents")
                    if words[0] != "root" and words[0] not in parent_of:
                        fail(path, number, f"bone {words[0]!r} has no parent before this line")
                    parent_of[child] = words[0]
    if not closed or section != ":hierarchy":
        raise EdgeposeError(f"{path}: ends before its hierarchy is closed")

    names = ("root", *parent_of)  # in order of the hierarchy: parents first
    parents = (-1, *(names.index(parent) for parent in parent_of.values()))
    number, order = root.get("order", (0, []))
    freedoms = tuple(word.lower() for word in order)
    if sorted(freedoms) != sorted(_FREEDOMS):
        fail(path, number, "the root's order must name TX TY TZ RX RY RZ")
    number, axis = root.get("axis", (0, ["XYZ"]))
    at, angles = root.get("orientation", (0, ["0", "0", "0"]))
    root_axis = _axis(path, number, [*angles, *axis], radian)
    at, place = root.get("position", (0, ["0", "0", "0"]))
    start = np.array(numbers(path, at, place, 3)) * metre
    vectors = [np.zeros(3) if parent == "root" else bones[parent].vector for parent in parent_of.values()]
    return Skeleton(
        names,
        parents,
        np.array([start, *vectors]),
        np.array([root_axis, *(bones[name].axis for name in parent_of)]),
        (freedoms, *(bones[name].freedoms for name in parent_of)),
        metre,
        radian,
    )


def _bone(
    path: Path, number: int, fields: dict[str, tuple[int, list[str]]], metre: float, radian: float
) -> tuple[str, _Bone]:
    """Name and shape of a bone from the lines between its begin and its end."""
    for key in ("name", "direction", "length", "axis"):
        if key not in fields or not fields[key][1]:
            fail(path, number, f"a bone without {key}")
    name = fields["name"][1][0]
    direction = np.array(numbers(path, *fields["direction"], 3))
    length = numbers(path, *fields["length"], 1)[0]
    at, words = fields.get("dof", (number, []))
    freedoms = tuple(word.lower() for word in words)
    if any(word not in _FREEDOMS for word in freedoms) or len(set(freedoms)) != len(freedoms):
        fail(path, at, f"dof of bone {name!r}: only rx, ry, rz, tx, ty, tz are known")
    return name, _Bone(direction * length * metre, _axis(path, *fields["axis"], radian), freedoms)


def _axis(path: Path, number: int, words: list[str], radian: float) -> Array:
    """Rotation matrix of three angles and the order in which they turn, such as XYZ."""
    order = words[-1].lower()
    if sorted(order) != ["x", "y", "z"]:
        fail(path, number, "three angles and their order, such as XYZ, were expected")
    angles = np.array(numbers(path, number, words[:-1], 3)) * radian
    return euler_to_matrix(angles[::-1], order[::-1])


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    """Line numbers, from 1, and words of the lines that hold something."""
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise EdgeposeError(f"{path}: cannot be read: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise EdgeposeError(f"{path}: not a text file, so neither ASF nor AMC") from None
    numbered = (
        (number, line.split("#")[0].split()) for number, line in enumerate(text.splitlines(), start=1)
    )
    return [(number, words) for number, words in numbered if words]
