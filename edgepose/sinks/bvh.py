"""BVH output: a skeleton and its joint angles over time, for Blender and other animation programs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edgepose.formats.bvh_names import BVH_NAMES
from edgepose.pose import PoseFrame, pelvis_positions
from edgepose.rotations import matrix_to_euler_zxy
from edgepose.sinks.base import Sink, SinkContext
from edgepose.sinks.row_file import COUNT, RowFileSink
from edgepose.sinks.spooled import open_file_sink
from edgepose.skeleton import (
    JOINTS,
    PARENTS,
    TIPS,
    Body,
    default_body,
    standing_pelvis_position,
)
from edgepose.utils.output_targets import FileTarget

Array = NDArray[np.float64]

UNITS = {"cm": 100.0, "m": 1.0}
"""Units of lengths, per metre."""

_DIGITS = {"cm": 4, "m": 6}


def hierarchy(offsets: Array, names: Sequence[str] = JOINTS, unit: str = "cm") -> str:
    """Return the skeleton part of a file.

    Args:
        offsets: (24, 3) metres, row 0 the pelvis' position.
        names: of the 24 joints.
        unit: of lengths in the file, a key of `UNITS`.
    """
    children: dict[int, list[int]] = {joint: [] for joint in range(len(JOINTS))}
    for joint, parent in enumerate(PARENTS[1:], start=1):
        children[parent].append(joint)

    def text(metres: ArrayLike) -> str:
        return " ".join(f"{number:.{_DIGITS[unit]}f}" for number in UNITS[unit] * np.asarray(metres))

    def lines(joint: int, depth: int) -> list[str]:
        indent = "  " * depth
        channels = "3 " if joint else "6 Xposition Yposition Zposition "
        result = [
            f"{indent}{'JOINT' if joint else 'ROOT'} {names[joint]}",
            f"{indent}{{",
            f"{indent}  OFFSET {text(offsets[joint])}",
            f"{indent}  CHANNELS {channels}Zrotation Xrotation Yrotation",
        ]
        for child in children[joint]:
            result += lines(child, depth + 1)
        if joint in TIPS:
            tip = text(TIPS[joint])
            result += [f"{indent}  End Site", f"{indent}  {{", f"{indent}    OFFSET {tip}", f"{indent}  }}"]
        return [*result, f"{indent}}}"]

    return "\n".join(["HIERARCHY", *lines(0, 0), ""])


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


class BvhSink(RowFileSink):
    """Writes poses to a BVH file.

    The body frame T is the file's world frame: X to the wearer's left, Y up, Z forward.
    """

    def __init__(
        self,
        path: str | Path,
        rate: float = 60.0,
        body: Body | None = None,
        names: str = "smpl",
        unit: str = "cm",
        start: str = "motion",
        *,
        overwrite: bool = True,
    ) -> None:
        """Open the file and write the skeleton.

        Args:
            path: file to write; it appears with the first poses.
            rate: frames per second.
            body: body whose bone lengths are written; None for the default body.
            names: names of the joints, a key of `BVH_NAMES`.
            unit: of lengths, a key of `UNITS`.
            start: "motion", or "t-pose" for a T-pose before the first pose, where the wearer starts.
            overwrite: replace an existing file.

        Raises:
            EdgeposeError: the file cannot be written.
        """
        self._offsets = (body or default_body()).offsets.copy()
        self._channels = np.array(depth_first())
        self._before = np.zeros((len(JOINTS), 3))
        self._scale = UNITS[unit]
        self._needs_t_pose = start == "t-pose"
        self._format = f"%.{_DIGITS[unit]}f %.{_DIGITS[unit]}f %.{_DIGITS[unit]}f" + " %.4f" * 72 + "\n"
        skeleton = hierarchy(self._offsets, BVH_NAMES[names], unit)
        head = f"{skeleton}MOTION\nFrames: {COUNT}\nFrame Time: {1 / rate:.8f}\n"
        super().__init__(path, "BVH", head, overwrite=overwrite)

    def _lines(self, poses: Sequence[PoseFrame]) -> bytes:
        rotations = np.stack([pose.rotations for pose in poses])
        positions = pelvis_positions(poses, self._offsets)
        if self._needs_t_pose:
            self._needs_t_pose = False
            standing = standing_pelvis_position(self._offsets)
            rotations = np.concatenate([np.broadcast_to(np.eye(3), (1, len(JOINTS), 3, 3)), rotations])
            positions = np.concatenate([[[positions[0, 0], standing[1], positions[0, 2]]], positions])
        angles = matrix_to_euler_zxy(rotations)
        # Without jumps of 360 degrees, because programs interpolate between frames.
        angles = np.unwrap(np.concatenate([self._before[None], angles]), axis=0)[1:]
        self._before = angles[-1]
        values = np.degrees(angles[:, self._channels]).reshape(len(angles), -1)
        table = np.concatenate([self._scale * positions, values], axis=1)
        return "".join(self._format % tuple(row) for row in table.tolist()).encode()


def open_sink(target: FileTarget, context: SinkContext) -> Sink:
    """Open a `BvhSink`; a device or pipe gets the file once it is complete."""
    names, unit, start = (target.option(key) for key in ("names", "unit", "start"))
    settings = context.rate, context.body, names, unit, start
    return open_file_sink(
        target.path, lambda path, overwrite: BvhSink(path, *settings, overwrite=overwrite), context
    )
