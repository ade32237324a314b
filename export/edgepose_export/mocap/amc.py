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
"""Frames per second of CMU's recordings; the format has no field for the rate."""

_INCH = 0.0254
_FREEDOMS = ("rx", "ry", "rz", "tx", "ty", "tz")


class Skeleton(NamedTuple):
    """An ASF skeleton in its zero pose, in which all frames are parallel to the world's."""

    names: tuple[str, ...]
    """The root, then the bones; each after its parent."""
    parents: tuple[int, ...]
    offsets: Array
    """(J, 3) start of each bone minus start of its parent, metres; for the root its position."""
    axes: Array
    """(J, 3, 3) frames that the bones' angles refer to."""
    freedoms: tuple[tuple[str, ...], ...]
    """Values that the motion holds for each bone, in order: rx, ry, rz, tx, ty, tz."""
    metre: float
    """Metres in one unit of length of the file."""
    radian: float
    """Radians in one unit of angle of the skeleton file."""


class _Bone(NamedTuple):
    vector: Array
    axis: Array
    freedoms: tuple[str, ...]


_Fields = dict[str, tuple[int, list[str]]]
"""Line number and words by keyword."""


def find_asf(path: str | Path) -> Path:
    """Return the skeleton file of a motion file: 07.asf for 07_01.amc, or the only skeleton in its folder.

    Raises:
        EdgeposeError: there is none, or there are several and none has the right name.
    """
    path = Path(path)
    found = sorted(file for file in path.parent.glob("*") if file.suffix.lower() == ".asf")
    named = [file for file in found if file.stem in (path.stem, path.stem.split("_")[0])]
    for candidates in (named, found):
        if len(candidates) == 1:
            return candidates[0]
    raise EdgeposeError(f"{path}: needs its skeleton, {path.stem.split('_')[0]}.asf, in the same folder")


def read_amc(path: str | Path, skeleton: str | Path | None = None, rate: float = AMC_RATE) -> JointTree:
    """Read all frames of an AMC file, with lengths in metres.

    Args:
        path: the motion.
        skeleton: its ASF file; None looks beside the motion, see `find_asf`.
        rate: frames per second, which the file does not state.

    Raises:
        EdgeposeError: a file cannot be read, is malformed or truncated, or holds a number that is not finite.
    """
    path = Path(path)
    body = read_asf(find_asf(path) if skeleton is None else skeleton)
    radian, columns = _read_columns(path, body)
    frames = len(next(iter(columns.values()), ()))
    rotations = np.broadcast_to(np.eye(3), (frames, len(body.names), 3, 3)).copy()
    positions = np.broadcast_to(body.offsets, (frames, len(body.names), 3)).copy()
    for joint, (name, freedoms) in enumerate(zip(body.names, body.freedoms, strict=True)):
        if not freedoms:
            continue
        table = np.array(columns[name])
        angles = [i for i, freedom in enumerate(freedoms) if freedom[0] == "r"]
        # The rotation listed first is applied first, so it is the last factor of the product.
        order = "".join(freedoms[i][1] for i in reversed(angles))
        rotation = euler_to_matrix(table[:, angles[::-1]] * radian, order) if angles else np.eye(3)
        rotations[:, joint] = body.axes[joint] @ rotation @ transpose(body.axes[joint])
        for i, freedom in enumerate(freedoms):
            if freedom[0] == "t":
                positions[:, joint, "xyz".index(freedom[1])] += table[:, i] * body.metre
    return JointTree(body.names, body.parents, body.offsets, rotations, positions, rate)


def _read_columns(path: Path, body: Skeleton) -> tuple[float, dict[str, list[list[float]]]]:
    """Return the radians in one unit of angle, and for each moving bone its values frame by frame."""
    counts = {
        name: len(freedoms) for name, freedoms in zip(body.names, body.freedoms, strict=True) if freedoms
    }
    columns: dict[str, list[list[float]]] = {name: [] for name in counts}
    radian = body.radian
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
                fail(path, number, f"expected frame {last + 1}, found {key}")
            last = int(key)
            frames += 1
            missing = set(counts)
        elif not frames:
            fail(path, number, "expected a frame number")
        elif key not in counts:
            fail(path, number, f"bone {key!r} is not in the skeleton, or has no degree of freedom there")
        elif key not in missing:
            fail(path, number, f"bone {key!r} occurs twice in a frame")
        else:
            missing.remove(key)
            columns[key].append(numbers(path, number, words[1:], counts[key]))
    if not frames:
        raise EdgeposeError(f"{path}: no frames")
    if missing:
        raise EdgeposeError(f"{path}: ends within frame {last} (cut short?)")
    return radian, columns


def read_asf(path: str | Path) -> Skeleton:
    """Read the skeleton in an ASF file.

    Raises:
        EdgeposeError: the file cannot be read, is malformed or truncated, or a number in it is not finite.
    """
    reader = _AsfReader(Path(path))
    for number, words in _lines(reader.path):
        reader.feed(number, words)
    return reader.skeleton()


class _AsfReader:
    """Reader of an ASF file's lines, one section after the other."""

    def __init__(self, path: Path) -> None:
        """Start before the first section; `path` is for error messages."""
        self.path = path
        self._section = ""
        self._metre, self._radian = _INCH, math.pi / 180
        self._root: _Fields = {}
        self._open_bone: _Fields | None = None
        self._bones: dict[str, _Bone] = {}
        self._parent_of: dict[str, str] = {}
        self._hierarchy_closed = False

    def feed(self, number: int, words: list[str]) -> None:
        """Take the words of the next line."""
        key = words[0].lower()
        if key.startswith(":"):
            self._section = key
            self._hierarchy_closed = False
        elif self._section == ":units":
            self._read_unit(number, key, words[1:])
        elif self._section == ":root":
            self._root[key] = (number, words[1:])
        elif self._section == ":bonedata":
            self._read_bone(number, key, words[1:])
        elif self._section == ":hierarchy":
            if key == "end":
                self._hierarchy_closed = True
            elif key != "begin":
                self._read_children(number, words[0], words[1:])

    def _read_unit(self, number: int, key: str, words: list[str]) -> None:
        if key == "length":
            scale = numbers(self.path, number, words, 1)[0]
            if scale <= 0:
                fail(self.path, number, "the length unit must be positive")
            self._metre = _INCH / scale  # lengths are inches times this number
        elif key == "angle":
            self._radian = 1.0 if words[:1] == ["rad"] else math.pi / 180

    def _read_bone(self, number: int, key: str, words: list[str]) -> None:
        if key == "begin":
            self._open_bone = {}
        elif self._open_bone is None:
            fail(self.path, number, "a bone must begin with 'begin'")
        elif key == "end":
            name, bone = _bone(self.path, number, self._open_bone, self._metre, self._radian)
            if name in self._bones or name == "root":
                fail(self.path, number, f"bone {name!r} is defined twice")
            self._bones[name] = bone
            self._open_bone = None
        else:
            self._open_bone.setdefault(key, (number, words))

    def _read_children(self, number: int, parent: str, children: list[str]) -> None:
        for child in children:
            if child not in self._bones or child in self._parent_of:
                fail(self.path, number, f"bone {child!r} is not defined, or has two parents")
            if parent != "root" and parent not in self._parent_of:
                fail(self.path, number, f"bone {parent!r} has no parent before this line")
            self._parent_of[child] = parent

    def skeleton(self) -> Skeleton:
        """Return the skeleton once all lines have been fed.

        Raises:
            EdgeposeError: the file ended too early, or its root is malformed.
        """
        if not self._hierarchy_closed or self._section != ":hierarchy":
            raise EdgeposeError(f"{self.path}: ends before its hierarchy is closed")
        names = ("root", *self._parent_of)  # in order of the hierarchy: parents first
        parents = (-1, *(names.index(parent) for parent in self._parent_of.values()))
        number, order = self._root.get("order", (0, []))
        freedoms = tuple(word.lower() for word in order)
        if sorted(freedoms) != sorted(_FREEDOMS):
            fail(self.path, number, "the root's order must name TX TY TZ RX RY RZ")
        number, axis = self._root.get("axis", (0, ["XYZ"]))
        _, angles = self._root.get("orientation", (0, ["0", "0", "0"]))
        root_axis = _axis(self.path, number, [*angles, *axis], self._radian)
        number, position = self._root.get("position", (0, ["0", "0", "0"]))
        start = np.array(numbers(self.path, number, position, 3)) * self._metre
        bones = [self._bones[name] for name in self._parent_of]
        vectors = [
            np.zeros(3) if parent == "root" else self._bones[parent].vector
            for parent in self._parent_of.values()
        ]
        return Skeleton(
            names,
            parents,
            np.array([start, *vectors]),
            np.array([root_axis, *(bone.axis for bone in bones)]),
            (freedoms, *(bone.freedoms for bone in bones)),
            self._metre,
            self._radian,
        )


def _bone(path: Path, number: int, fields: _Fields, metre: float, radian: float) -> tuple[str, _Bone]:
    """Return name and shape of a bone from the lines between its begin and its end."""
    for key in ("name", "direction", "length", "axis"):
        if key not in fields or not fields[key][1]:
            fail(path, number, f"a bone without {key}")
    name = fields["name"][1][0]
    direction = np.array(numbers(path, *fields["direction"], 3))
    length = numbers(path, *fields["length"], 1)[0]
    at, words = fields.get("dof", (number, []))
    freedoms = tuple(word.lower() for word in words)
    if any(word not in _FREEDOMS for word in freedoms) or len(set(freedoms)) != len(freedoms):
        fail(path, at, f"dof of bone {name!r} may hold only rx, ry, rz, tx, ty, tz, each once")
    return name, _Bone(direction * length * metre, _axis(path, *fields["axis"], radian), freedoms)


def _axis(path: Path, number: int, words: list[str], radian: float) -> Array:
    """Return the rotation matrix of three angles that are applied in an order such as XYZ."""
    order = words[-1].lower()
    if sorted(order) != ["x", "y", "z"]:
        fail(path, number, "expected three angles and their order, such as XYZ")
    angles = np.array(numbers(path, number, words[:-1], 3)) * radian
    return euler_to_matrix(angles[::-1], order[::-1])


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    """Return line number, from 1, and words of each line that is not empty."""
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
