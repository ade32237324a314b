"""Reader for BVH files: any hierarchy, any channel order, position channels at any joint."""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError, FileFormatError
from edgepose.formats.joint_tree import JointTree, fail, numbers
from edgepose.pose import tidy_rate
from edgepose.rotations import euler_to_matrix
from edgepose.utils.safe_npz import check_size

Array = NDArray[np.float64]

_CHANNELS = {
    f"{axis}{kind}": (kind, index) for index, axis in enumerate("xyz") for kind in ("position", "rotation")
}

FRAME_TIMES = (1e-5, 1e2)
"""Shortest and longest plausible time of a frame, seconds."""

_SLOWEST_S = 5.0  # programs that write the rate instead write 10 or more
_LONGEST_LINE = 1 << 20  # characters; a frame of 1000 joints has fewer than 50,000
_MOST_JOINTS = 10_000
_JOINT_BYTES = 8 * (9 + 3)  # memory for a joint of a frame

_Channel = tuple[str, int]  # "position" or "rotation", axis
_END_SITE = -1  # stands for an end site among open joints; its offset is not needed
_MISSING: list[Any] = []  # OFFSET or CHANNELS before its line is read


def read_bvh(path: str | Path) -> JointTree:
    """Read all frames of a BVH file, lengths in the file's own unit (the format does not name it).

    Rotation channels are multiplied in the order in which they are listed. Position channels of a joint
    replace its offset: files with both repeat the offset in the channels.

    Raises:
        FileFormatError: the file cannot be read, breaks the format, is cut short, or lacks a finite number
            where one is needed.
    """
    tree, problem = salvage_bvh(path)
    if problem is not None:
        raise FileFormatError(problem)
    return tree


def salvage_bvh(path: str | Path) -> tuple[JointTree, str | None]:
    """Read the frames before the first bad one, and one line on the problem; see `read_bvh`.

    Raises:
        FileFormatError: no frame is usable.
    """
    path = Path(path)
    try:
        with path.open(encoding="utf-8-sig") as file:
            lines = enumerate(iter(partial(file.readline, _LONGEST_LINE), ""), start=1)
            hierarchy = _read_hierarchy(path, lines)
            frame_time, table, problem = _motion(path, lines, sum(map(len, hierarchy.channels)))
        check_size(path, len(table) * len(hierarchy.names) * _JOINT_BYTES)
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise FileFormatError(f"{path}: not a text file, so not BVH") from None
    names, offsets = tuple(hierarchy.names), np.array(hierarchy.offsets)
    rotations, positions = _apply_channels(table, offsets, hierarchy.channels)
    tree = JointTree(names, tuple(hierarchy.parents), offsets, rotations, positions, tidy_rate(frame_time))
    return tree, problem


def _apply_channels(
    table: Array, offsets: Array, channels: Sequence[Sequence[_Channel]]
) -> tuple[Array, Array]:
    """Convert channel values (T, width) to local rotations (T, J, 3, 3) and positions (T, J, 3)."""
    rotations = np.broadcast_to(np.eye(3), (len(table), len(offsets), 3, 3)).copy()
    positions = np.broadcast_to(offsets, (len(table), len(offsets), 3)).copy()
    column = 0
    by_order: dict[str, tuple[list[int], list[int]]] = {}  # rotation order -> joints, columns
    for joint, kinds in enumerate(channels):
        rotating = [column + i for i, (kind, _) in enumerate(kinds) if kind == "rotation"]
        for i, (kind, axis) in enumerate(kinds):
            if kind == "position":
                positions[:, joint, axis] = table[:, column + i]
        if rotating:
            order = "".join("xyz"[axis] for kind, axis in kinds if kind == "rotation")
            joints, columns = by_order.setdefault(order, ([], []))
            joints.append(joint)
            columns.extend(rotating)
        column += len(kinds)
    for order, (joints, columns) in by_order.items():
        angles = np.radians(table[:, columns]).reshape(len(table), len(joints), len(order))
        rotations[:, joints] = euler_to_matrix(angles, order)
    return rotations, positions


class _Hierarchy:
    """Parser of the lines up to MOTION.

    Attributes:
        names: joint names.
        parents: index of each joint's parent, -1 for the root.
        offsets: (3,) of each joint.
        channels: channels of each joint, in the order of the columns.
    """

    def __init__(self, path: Path) -> None:
        """Start before HIERARCHY; `path` is for messages."""
        self.names: list[str] = []
        self.parents: list[int] = []
        self.offsets: list[list[float]] = []
        self.channels: list[list[_Channel]] = []
        self._path = path
        self._open: list[int] = []  # joints and end sites whose braces are open
        self._pending: int | None = None  # a joint or end site before its opening brace

    def parse(self, number: int, words: list[str]) -> bool:
        """Take the words of a line, counted from 1; return whether it is MOTION, the end of the hierarchy."""
        key, rest = words[0].upper(), words[1:]
        if key == "{":
            if self._pending is None:
                fail(self._path, number, "a brace opens without a joint")
            self._open.append(self._pending)
            self._pending = None
        elif self._pending is not None:
            fail(self._path, number, "an opening brace was expected")
        elif key == "}":
            self._close(number)
        elif key in ("ROOT", "JOINT"):
            self._begin_joint(number, key, " ".join(rest))
        elif key == "END":
            if not self._open or self._open[-1] == _END_SITE:
                fail(self._path, number, "an end site outside a joint")
            self._pending = _END_SITE
        elif key == "OFFSET" and self._open:
            values = numbers(self._path, number, rest, 3)
            if self._open[-1] != _END_SITE:
                self.offsets[self._open[-1]] = values
        elif key == "CHANNELS" and self._open and self._open[-1] != _END_SITE:
            self.channels[self._open[-1]] = self._parse_channels(number, rest)
        elif key == "MOTION":
            if self._open or not self.names:
                fail(self._path, number, "MOTION before the hierarchy is closed")
            return True
        else:
            fail(self._path, number, f"{words[0]!r} is not expected here")
        return False

    def _close(self, number: int) -> None:
        if not self._open:
            fail(self._path, number, "a brace closes that was not opened")
        joint = self._open.pop()
        if joint != _END_SITE and (self.offsets[joint] is _MISSING or self.channels[joint] is _MISSING):
            fail(self._path, number, f"joint {self.names[joint]} has no OFFSET or no CHANNELS")

    def _begin_joint(self, number: int, key: str, name: str) -> None:
        if (key == "ROOT") != (not self.names) or (key == "JOINT") != bool(self._open):
            fail(self._path, number, f"{key} at this place: one ROOT is expected, with each JOINT inside it")
        if not name or name in self.names:
            fail(self._path, number, f"joint name {name!r} is missing or used twice")
        if self._open[-1:] == [_END_SITE]:
            fail(self._path, number, "a joint inside an end site")
        if len(self.names) == _MOST_JOINTS:
            fail(self._path, number, f"more than {_MOST_JOINTS} joints")
        self._pending = len(self.names)
        self.names.append(name)
        self.parents.append(self._open[-1] if self._open else -1)
        self.offsets.append(_MISSING)
        self.channels.append(_MISSING)

    def _parse_channels(self, number: int, words: list[str]) -> list[_Channel]:
        kinds = [_CHANNELS.get(word.lower()) for word in words[1:]]
        known = [kind for kind in kinds if kind is not None]
        if (
            not words
            or words[0] != str(len(known))
            or len(known) != len(kinds)
            or len(set(known)) != len(known)
        ):
            fail(
                self._path,
                number,
                "CHANNELS needs their count, then that many different names such as Xrotation",
            )
        return known


def _read_hierarchy(path: Path, lines: Iterator[tuple[int, str]]) -> _Hierarchy:
    """Parse the lines up to MOTION."""
    hierarchy = _Hierarchy(path)
    filled = ((number, words) for number, line in lines if (words := line.split()))
    number, words = next(filled, (0, [""]))
    if not number:
        raise FileFormatError(f"{path}: empty file")
    if words[0].upper() != "HIERARCHY":
        fail(path, number, "not a BVH file: HIERARCHY was expected")
    for number, words in filled:
        if hierarchy.parse(number, words):
            return hierarchy
    raise FileFormatError(f"{path}: ends within the hierarchy, before MOTION")


def _frame_time(path: Path, line: int, words: list[str]) -> float:
    """Parse the seconds from frame to frame, in a line counted from 1."""
    seconds = numbers(path, line, words, 1)[0]
    if seconds > _SLOWEST_S:
        hint = f"; if this is a rate, write {1.0 / seconds:.6f}"
        fail(path, line, f"a frame time of {seconds:g} s is not plausible{hint}")
    if seconds < FRAME_TIMES[0]:
        fail(path, line, f"a frame time of {seconds:g} s is not possible")
    return seconds


def _motion(path: Path, lines: Iterator[tuple[int, str]], width: int) -> tuple[float, Array, str | None]:
    """Read frame time (s), channel values (T, width) before the first bad row, and the problem with it."""
    filled = ((number, line, words) for number, line in lines if (words := line.split()))
    at_count, count_line, _ = next(filled, (0, "", []))
    at_time, time_line, _ = next(filled, (0, "", []))
    if not time_line:
        raise FileFormatError(f"{path}: ends before the first frame")
    key, _, count = count_line.partition(":")
    count = count.strip()
    if key.strip().lower() != "frames" or not count.isdecimal() or len(count) > 15:
        fail(path, at_count, "'Frames: <count>' was expected")
    key, _, time = time_line.partition(":")
    if key.lower().split() != ["frame", "time"]:
        fail(path, at_time, "'Frame Time: <seconds>' was expected")
    frame_time = _frame_time(path, at_time, time.split())
    announced = int(count)
    values, frames, whole, problem = array("d"), 0, True, None
    try:
        for number, line, words in filled:
            if len(words) != width:
                fail(path, number, f"a frame needs {width} numbers, this line has {len(words)}")
            values.extend(numbers(path, number, words, width))
            frames, whole = frames + 1, line.endswith("\n")
        if frames != announced or not frames:
            cut = " (cut short?)" if frames < announced else ""
            problem = f"{path}: {announced} frames are announced, {frames} are there{cut}"
            # A last row without line end may lack digits.
            frames -= frames < announced and not whole
    except EdgeposeError as error:
        problem = str(error)
    except UnicodeDecodeError:
        problem = f"{path}: not a text file after frame {frames}"
    if not frames:
        raise FileFormatError(problem)
    return frame_time, np.frombuffer(values)[: frames * width].reshape(frames, width), problem
