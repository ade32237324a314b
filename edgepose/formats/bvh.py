"""Reader for BVH files: any hierarchy, any channel order, position channels at any joint."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError, FileFormatError
from edgepose.formats.joint_tree import JointTree, fail, numbers
from edgepose.pose import tidy_rate
from edgepose.rotations import euler_to_matrix
from edgepose.utils.safe_npz import check_size

Array = NDArray[np.float64]

_CHANNELS = {
    f"{axis}{kind}": (kind, "xyz".index(axis.lower())) for axis in "XYZ" for kind in ("position", "rotation")
}

FRAME_TIMES = (1e-5, 1e2)
"""Shortest and longest time of a frame that is believed, seconds."""

_LONGEST_LINE = 1 << 20  # characters; that of a frame of 1000 joints has less than 50,000
_MOST_JOINTS = 10_000
_JOINT_BYTES = 8 * (9 + 3)  # that a joint of a frame takes


def read_bvh(path: str | Path) -> JointTree:
    """All frames of a BVH file, lengths in the file's own unit (the format names none).

    Rotation channels are multiplied in the order in which they are listed. Position channels of a joint
    replace its offset: files that write both, write the offset into the channels again.

    Raises:
        FileFormatError: the file cannot be read, breaks the format, is cut short, or holds no finite number
            where one is needed.
    """
    tree, problem = salvage_bvh(path)
    if problem is not None:
        raise FileFormatError(problem)
    return tree


def salvage_bvh(path: str | Path) -> tuple[JointTree, str | None]:
    """The frames before the first bad one, and one line on what is wrong with the file; see `read_bvh`.

    Raises:
        FileFormatError: no frame is good.
    """
    path = Path(path)
    try:
        with path.open(encoding="utf-8-sig") as file:
            lines = enumerate(iter(partial(file.readline, _LONGEST_LINE), ""), start=1)
            names, parents, offsets, channels = _hierarchy(path, lines)
            frame_time, table, problem = _motion(path, lines, sum(map(len, channels)))
        check_size(path, len(table) * len(names) * _JOINT_BYTES)
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise FileFormatError(f"{path}: not a text file, so not BVH") from None
    rotations = np.broadcast_to(np.eye(3), (len(table), len(names), 3, 3)).copy()
    positions = np.broadcast_to(offsets, (len(table), len(names), 3)).copy()
    column = 0
    turning: dict[str, tuple[list[int], list[int]]] = {}  # rotation order -> joints, first columns
    for joint, kinds in enumerate(channels):
        turns = [column + i for i, (kind, _) in enumerate(kinds) if kind == "rotation"]
        for i, (kind, axis) in enumerate(kinds):
            if kind == "position":
                positions[:, joint, axis] = table[:, column + i]
        if turns:
            order = "".join("xyz"[axis] for kind, axis in kinds if kind == "rotation")
            joints, columns = turning.setdefault(order, ([], []))
            joints.append(joint)
            columns.extend(turns)
        column += len(kinds)
    for order, (joints, columns) in turning.items():
        angles = np.radians(table[:, columns]).reshape(len(table), len(joints), len(order))
        rotations[:, joints] = euler_to_matrix(angles, order)
    tree = JointTree(tuple(names), tuple(parents), offsets, rotations, positions, tidy_rate(frame_time))
    return tree, problem


def _hierarchy(
    path: Path, lines: Iterator[tuple[int, str]]
) -> tuple[list[str], list[int], Array, list[list[tuple[str, int]]]]:
    """Names, parents, offsets (J, 3), channels (kind, axis) of each joint, from the lines up to MOTION."""
    names: list[str] = []
    parents: list[int] = []
    offsets: list[list[float] | None] = []
    channels: list[list[tuple[str, int]] | None] = []
    open_joints: list[int] = []  # -1 stands for an end site, which holds an offset that nothing here needs
    pending: int | None = None  # a joint that is named and not opened by its brace yet
    seen_header = False
    for number, line in lines:
        words = line.split()
        if not words:
            continue
        key, rest = words[0], words[1:]
        if not seen_header:
            if key != "HIERARCHY":
                fail(path, number, "not a BVH file: HIERARCHY was expected")
            seen_header = True
        elif key == "{":
            if pending is None:
                fail(path, number, "a brace opens without a joint")
            open_joints.append(pending)
            pending = None
        elif pending is not None:
            fail(path, number, "an opening brace was expected")
        elif key == "}":
            if not open_joints:
                fail(path, number, "a brace closes that was not opened")
            joint = open_joints.pop()
            if joint >= 0 and (offsets[joint] is None or channels[joint] is None):
                fail(path, number, f"joint {names[joint]} has no OFFSET or no CHANNELS")
        elif key in ("ROOT", "JOINT"):
            if (key == "ROOT") != (not names) or (key == "JOINT") != bool(open_joints):
                fail(path, number, f"{key} at this place: one ROOT is expected, with each JOINT inside it")
            name = " ".join(rest)
            if not name or name in names:
                fail(path, number, f"joint name {name!r} is missing or used twice")
            if open_joints[-1:] == [-1]:
                fail(path, number, "a joint inside an end site")
            if len(names) == _MOST_JOINTS:
                fail(path, number, f"more than {_MOST_JOINTS} joints")
            pending = len(names)
            names.append(name)
            parents.append(open_joints[-1] if open_joints else -1)
            offsets.append(None)
            channels.append(None)
        elif key == "End":
            if not open_joints or open_joints[-1] == -1:
                fail(path, number, "an end site outside a joint")
            pending = -1
        elif key == "OFFSET" and open_joints:
            values = numbers(path, number, rest, 3)
            if open_joints[-1] >= 0:
                offsets[open_joints[-1]] = values
        elif key == "CHANNELS" and open_joints and open_joints[-1] >= 0:
            kinds = [_CHANNELS.get(word) for word in rest[1:]]
            known = [kind for kind in kinds if kind is not None]
            if (
                not rest
                or rest[0] != str(len(known))
                or len(known) != len(kinds)
                or len(set(known)) != len(known)
            ):
                fail(
                    path,
                    number,
                    "CHANNELS needs their count, then that many different names such as Xrotation",
                )
            channels[open_joints[-1]] = known
        elif key == "MOTION":
            if open_joints or not names:
                fail(path, number, "MOTION before the hierarchy is closed")
            table = np.array([offset for offset in offsets if offset is not None])
            return names, parents, table, [kinds for kinds in channels if kinds is not None]
        else:
            fail(path, number, f"{key!r} is not expected here")
    raise FileFormatError(
        f"{path}: ends within the hierarchy, before MOTION" if seen_header else f"{path}: empty file"
    )


def _motion(path: Path, lines: Iterator[tuple[int, str]], width: int) -> tuple[float, Array, str | None]:
    """Frame time in seconds, the table (T, width) of channel values as printed before the first bad row, and
    what is wrong with the rest.
    """
    filled = ((number, line, words) for number, line in lines if (words := line.split()))
    at_count, _, count = next(filled, (0, "", []))
    at_time, _, time = next(filled, (0, "", []))
    if not time:
        raise FileFormatError(f"{path}: ends before the first frame")
    if len(count) != 2 or count[0] != "Frames:" or not count[1].isdecimal() or len(count[1]) > 15:
        fail(path, at_count, "'Frames: <count>' was expected")
    if time[:2] != ["Frame", "Time:"]:
        fail(path, at_time, "'Frame Time: <seconds>' was expected")
    frame_time = numbers(path, at_time, time[2:], 1)[0]
    if not FRAME_TIMES[0] < frame_time < FRAME_TIMES[1]:
        fail(path, at_time, f"a frame time of {frame_time:g} s is not possible")
    announced = int(count[1])
    values, frames, whole, problem = array("d"), 0, True, None
    try:
        for number, line, words in filled:
            if len(words) != width:
                fail(path, number, f"a frame needs {width} numbers, this line has {len(words)}")
            values.extend(numbers(path, number, words, width))
            frames, whole = frames + 1, line.endswith("\n")
        if frames != announced or not frames:
            problem = f"{path}: {announced} frames are announced, {frames} are there (cut short?)"
            # Digits may be missing in the last row, which nobody can see.
            frames -= frames < announced and not whole
    except EdgeposeError as error:
        problem = str(error)
    except UnicodeDecodeError:
        problem = f"{path}: not a text file after frame {frames}"
    if not frames:
        raise FileFormatError(problem)
    return frame_time, np.frombuffer(values)[: frames * width].reshape(frames, width), problem
