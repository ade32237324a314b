"""BVH output: a skeleton and its joint angles over time, for Blender and other animation programs."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError
from edgepose.formats.bvh_names import BVH_NAMES
from edgepose.pose import PoseFrame
from edgepose.rotations import matrix_to_euler_zxy
from edgepose.sinks.base import Sink, SinkContext
from edgepose.sinks.pose_file import PoseFileSink
from edgepose.sinks.spooled import SpooledSink
from edgepose.skeleton import JOINTS, PARENTS, Body, default_body, grounded_pelvis_position
from edgepose.utils.growing_files import GrowingFile
from edgepose.utils.output_targets import FileTarget, is_stream

Array = NDArray[np.float64]

BLOCK = 600
"""Largest number of poses kept in memory before they are written."""

TIPS = {10: (0, 0, 6), 11: (0, 0, 6), 15: (0, 18, 0), 22: (8, 0, 0), 23: (-8, 0, 0)}
"""End points of the bones without a joint at their end: joint, and tip in its frame, cm."""

_COUNT = "Frames: "
_DIGITS = 10
"""Width of the number of frames, which is updated in place."""


def hierarchy(offsets: Array, names: Sequence[str] = JOINTS) -> str:
    """Return the skeleton part of a file; offsets (24, 3) in cm, row 0 the pelvis' position; 24 names."""
    children: dict[int, list[int]] = {joint: [] for joint in range(len(JOINTS))}
    for joint, parent in enumerate(PARENTS[1:], start=1):
        children[parent].append(joint)

    def lines(joint: int, depth: int) -> list[str]:
        indent = "  " * depth
        channels = "3 " if joint else "6 Xposition Yposition Zposition "
        result = [
            f"{indent}{'JOINT' if joint else 'ROOT'} {names[joint]}",
            f"{indent}{{",
            f"{indent}  OFFSET {_text(offsets[joint])}",
            f"{indent}  CHANNELS {channels}Zrotation Xrotation Yrotation",
        ]
        for child in children[joint]:
            result += lines(child, depth + 1)
        if joint in TIPS:
            tip = _text(np.array(TIPS[joint], float))
            result += [f"{indent}  End Site", f"{indent}  {{", f"{indent}    OFFSET {tip}", f"{indent}  }}"]
        return [*result, f"{indent}}}"]

    return "\n".join(["HIERARCHY", *lines(0, 0), ""])


def _text(numbers: Array) -> str:
    return " ".join(f"{number:.4f}" for number in numbers)


def depth_first() -> list[int]:
    """Return the joints in the order in which a file lists them."""
    order: list[int] = []

    def visit(joint: int) -> None:
        order.append(joint)
        for child, parent in enumerate(PARENTS):
            if parent == joint:
                visit(child)

    visit(0)
    return order


class BvhSink(PoseFileSink):
    """Writes poses to a BVH file, which is valid after every write to the disk, about once a second.

    The body frame T is the file's world frame: X to the wearer's left, Y up, Z forward; lengths in cm.
    """

    def __init__(
        self,
        path: str | Path,
        rate: float = 60.0,
        body: Body | None = None,
        names: str = "smpl",
        *,
        overwrite: bool = True,
    ) -> None:
        """Open the file and write the skeleton.

        Args:
            path: file to write; it appears with the first poses.
            rate: frames per second.
            body: body whose bone lengths are written; None for the default body.
            names: names of the joints, a key of `BVH_NAMES`.
            overwrite: replace an existing file.

        Raises:
            EdgeposeError: the file cannot be written.
        """
        offsets = (body or default_body()).offsets.copy()
        self._offsets = offsets
        self._channels = np.array(depth_first())
        self._before = np.zeros((len(JOINTS), 3))
        self._poses: list[PoseFrame] = []
        self._count = 0
        if is_stream(path):
            raise EdgeposeError(
                f"cannot write BVH to {path}: it must be a file on a disk, because the number of frames at "
                "its start is filled in at the end"
            )
        output = GrowingFile(path, "poses", overwrite=overwrite)
        self._file = output.file
        head = f"{hierarchy(offsets * 100, BVH_NAMES[names])}MOTION\n{_COUNT}"
        self._count_at = len(head)
        super().__init__(output, f"{head}{0:<{_DIGITS}}\nFrame Time: {1 / rate:.8f}\n".encode())

    def _add(self, pose: PoseFrame) -> bool:
        self._poses.append(pose)
        return len(self._poses) >= BLOCK

    def _write_collected(self) -> None:
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
            # Overwriting in place works even on a full disk.
            with contextlib.suppress(OSError):
                self._file.seek(self._count_at)
                self._file.write(f"{self._count:<{_DIGITS}}".encode())
            self._file.seek(end)

    def _rows(self, poses: Sequence[PoseFrame]) -> bytes:
        """Return the lines of channel values for poses."""
        rotations = np.stack([pose.rotations for pose in poses])
        angles = matrix_to_euler_zxy(rotations)
        # Without jumps of 360 degrees, because programs interpolate between frames.
        angles = np.unwrap(np.concatenate([self._before[None], angles]), axis=0)[1:]
        self._before = angles[-1]
        positions = grounded_pelvis_position(rotations, self._offsets)
        for i, pose in enumerate(poses):
            if pose.translation is not None:
                positions[i] = pose.translation
        values = np.degrees(angles[:, self._channels]).reshape(len(poses), -1)
        table = np.concatenate([100.0 * positions, values], axis=1)
        line = " ".join(["%.4f"] * table.shape[1]) + "\n"
        return "".join(line % tuple(row) for row in table.tolist()).encode()


def open_sink(target: FileTarget, context: SinkContext) -> Sink:
    """Open a `BvhSink`; a device or pipe gets the file once it is complete."""
    settings = context.rate, context.body, target.option
    if target.path != "-" and is_stream(target.path):
        return SpooledSink(target.path, lambda part: BvhSink(part, *settings), context.stopped)
    return BvhSink(target.path, *settings, overwrite=context.overwrite)
