"""Poses as BVH, a skeleton and its angles over time, for Blender and other animation programs."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError
from edgepose.pose import PoseFrame
from edgepose.rotations import matrix_to_euler_zxy
from edgepose.sinks.base import Sink, SinkContext
from edgepose.sinks.pose_file import PoseFileSink
from edgepose.sinks.spooled import SpooledSink
from edgepose.skeleton import JOINTS, PARENTS, Body, default_body, standing_pelvis_position
from edgepose.utils.growing_files import GrowingFile
from edgepose.utils.output_targets import is_stream

Array = NDArray[np.float64]

BLOCK = 600
"""Poses that are held back at most."""

TIPS = {10: (0, 0, 6), 11: (0, 0, 6), 15: (0, 18, 0), 22: (8, 0, 0), 23: (-8, 0, 0)}
"""Where the bones without a joint at their end stop: joint, and tip in its frame, cm."""

_COUNT = "Frames: "
_DIGITS = 10
"""Room for the number of frames, which is known only at the end."""


def hierarchy(offsets: Array) -> str:
    """The part of a file that describes a skeleton; offsets (24, 3), row 0 the pelvis' place, in cm."""
    children: dict[int, list[int]] = {joint: [] for joint in range(len(JOINTS))}
    for joint, parent in enumerate(PARENTS[1:], start=1):
        children[parent].append(joint)

    def lines(joint: int, depth: int) -> list[str]:
        room = "  " * depth
        channels = "3 " if joint else "6 Xposition Yposition Zposition "
        result = [
            f"{room}{'JOINT' if joint else 'ROOT'} {JOINTS[joint]}",
            f"{room}{{",
            f"{room}  OFFSET {_text(offsets[joint])}",
            f"{room}  CHANNELS {channels}Zrotation Xrotation Yrotation",
        ]
        for child in children[joint]:
            result += lines(child, depth + 1)
        if joint in TIPS:
            tip = _text(np.array(TIPS[joint], float))
            result += [f"{room}  End Site", f"{room}  {{", f"{room}    OFFSET {tip}", f"{room}  }}"]
        return [*result, f"{room}}}"]

    return "\n".join(["HIERARCHY", *lines(0, 0), ""])


def _text(numbers: Array) -> str:
    return " ".join(f"{number:.4f}" for number in numbers)


def depth_first() -> list[int]:
    """Joints in the order in which a file lists them."""
    order: list[int] = []

    def visit(joint: int) -> None:
        order.append(joint)
        for child, parent in enumerate(PARENTS):
            if parent == joint:
                visit(child)

    visit(0)
    return order


class BvhSink(PoseFileSink):
    """Writes poses to a file, which is whole after every write to the disk, about once a second.

    The body frame T is the file's world: X to the wearer's left, Y up, Z forward; lengths in cm.
    """

    def __init__(
        self, path: str | Path, rate: float = 60.0, body: Body | None = None, *, overwrite: bool = True
    ) -> None:
        """Open the file and write the skeleton.

        Args:
            path: file to write; it appears with the first poses.
            rate: frames per second.
            body: whose bone lengths the file gets; the default body if None.
            overwrite: whether it may take the place of a file.

        Raises:
            EdgeposeError: the file cannot be written.
        """
        offsets = (body or default_body()).offsets.copy()
        self._standing = standing_pelvis_position(offsets)
        self._channels = np.array(depth_first())
        self._before = np.zeros((len(JOINTS), 3))
        self._poses: list[PoseFrame] = []
        self._count = 0
        if is_stream(path):
            raise EdgeposeError(
                f"cannot write BVH to {path}: it must be a file on a disk, as its start tells how long it is"
            )
        output = GrowingFile(path, "poses", overwrite=overwrite)
        self._file = output.file
        head = f"{hierarchy(offsets * 100)}MOTION\n{_COUNT}"
        self._count_at = len(head)
        super().__init__(output, f"{head}{0:<{_DIGITS}}\nFrame Time: {1 / rate:.8f}\n".encode())

    def _add(self, pose: PoseFrame) -> bool:
        self._poses.append(pose)
        return len(self._poses) >= BLOCK

    def _write_gathered(self) -> None:
        poses, self._poses = self._poses, []
        if not poses:
            return
        rows = self._rows(poses)
        start = self._file.tell()
        try:
            self._output.write(rows)
        finally:
            self._count += rows[: self._file.tell() - start].count(b"\n")
            end = self._file.seek(0, 2)
            # In its place, which needs no room on a full disk.
            with contextlib.suppress(OSError):
                self._file.seek(self._count_at)
                self._file.write(f"{self._count:<{_DIGITS}}".encode())
            self._file.seek(end)

    def _rows(self, poses: Sequence[PoseFrame]) -> bytes:
        """Lines of channel values."""
        angles = matrix_to_euler_zxy(np.stack([pose.rotations for pose in poses]))
        # Without leaps of a whole turn, because programs interpolate between frames.
        angles = np.unwrap(np.concatenate([self._before[None], angles]), axis=0)[1:]
        self._before = angles[-1]
        places = [self._standing if pose.translation is None else pose.translation for pose in poses]
        values = np.degrees(angles[:, self._channels]).reshape(len(poses), -1)
        table = np.concatenate([100.0 * np.array(places, float), values], axis=1)
        line = " ".join(["%.4f"] * table.shape[1]) + "\n"
        return "".join(line % tuple(row) for row in table.tolist()).encode()


def open_sink(target: str, context: SinkContext) -> Sink:
    """A `BvhSink`; a device or pipe gets the file when it is whole."""
    if target != "-" and is_stream(target):
        return SpooledSink(target, lambda part: BvhSink(part, context.rate, context.body), context.stopped)
    return BvhSink(target, context.rate, context.body, overwrite=context.overwrite)
