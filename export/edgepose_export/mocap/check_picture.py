"""Pictures of skeletons beside the SMPL body that follows them, for a person to look at."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose.analysis.figures import INK, PREDICTION, REFERENCE, require_matplotlib, save_picture
from edgepose.errors import EdgeposeError
from edgepose.formats.joint_tree import forward
from edgepose.rotations import geodesic_angle, rotation_about_axis, transpose, yaw_of_matrix
from edgepose.skeleton import PARENTS, Body, forward_kinematics, local_from_global

from .amc import find_asf
from .motion import Motion
from .rest_pose import to_y_up
from .retargeting import Source

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

_FRAMES = ("first", "middle", "most bent")
_VIEWS = (("front", 0, 1.0), ("left side", 2, -1.0))  # axis to the right of the picture, and its sign
_ROW_IN, _COLUMN_IN, _DPI = 2.1, 1.25, 100
_REACH_M = 1.05
_LONGEST_LINE, _MOST_LINES = 1 << 12, 1 << 17
_LIMB_COLOURS = {"left": PREDICTION["left"], "right": PREDICTION["right"]}


class Row(NamedTuple):
    """Stick figures of one take, as they stand for the viewer: pelvis at the origin, facing +Z."""

    title: str
    frames: tuple[int, ...]
    source: Array
    """(F, J, 3) joints of the skeleton, metres."""
    source_bones: list[tuple[int, int, str]]
    """Joints at both ends, and colour."""
    target: Array
    """(F, 24, 3) joints of the body, metres."""
    target_bones: list[tuple[int, int, str]]


def skeleton_key(path: Path) -> str:
    """Return what two files of one skeleton have in common, without reading the motion.

    That is the text of a BVH file's hierarchy without the root's offset, or the skeleton file of an AMC file.

    Raises:
        EdgeposeError: the file cannot be read.
    """
    if path.suffix.lower() == ".amc":
        return str(find_asf(path))
    lines: list[str] = []
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            for line in islice(iter(lambda: file.readline(_LONGEST_LINE), ""), _MOST_LINES):
                words = line.split()
                if words[:1] == ["MOTION"]:
                    break
                lines.append(" ".join(words))
    except OSError as error:
        raise EdgeposeError(f"{path}: cannot be read: {error.strerror or error}") from None
    offset = next((i for i, line in enumerate(lines) if line.startswith("OFFSET")), None)
    return "\n".join(lines if offset is None else lines[:offset] + lines[offset + 1 :])


def figures_of(title: str, source: Source, motion: Motion, body: Body) -> Row:
    """Return the figures of a take in its first, middle and most bent frame."""
    bent = geodesic_angle(local_from_global(motion.rotations)[:, 1:], np.eye(3)).sum(axis=1)
    frames = (0, len(bent) // 2, int(bent.argmax()))
    picked = list(frames)
    tree = source.tree._replace(
        rotations=source.tree.rotations[picked], positions=source.tree.positions[picked]
    )
    joints = source.metre * forward(tree)[1] @ to_y_up(source.up).T
    joints -= joints[:, [source.roles.pelvis]]
    to_front = rotation_about_axis("y", -yaw_of_matrix(motion.rotations[picked, 0]))
    return Row(
        title,
        frames,
        joints @ transpose(to_front),
        _source_bones(source),
        _body_joints(motion, picked, body) @ transpose(to_front),
        [(joint, parent, _colour(_side_of(joint))) for joint, parent in enumerate(PARENTS) if parent >= 0],
    )


def _body_joints(motion: Motion, frames: Sequence[int], body: Body) -> Array:
    """Return joints (F, 24, 3) of a body with the source's leg length."""
    offsets = body.offsets
    if motion.leg_length:
        offsets = offsets * (motion.leg_length / body.leg_length_m)
    joints = forward_kinematics(local_from_global(motion.rotations[list(frames)]), offsets)[1]
    return np.asarray(joints - joints[:, :1])


def _side_of(joint: int) -> str:
    if joint in (0, 3, 6, 9, 12, 15):
        return ""
    return "left" if joint in (1, 4, 7, 10, 13, 16, 18, 20, 22) else "right"


def _colour(side: str) -> str:
    return _LIMB_COLOURS.get(side, REFERENCE["right"])


def _source_bones(source: Source) -> list[tuple[int, int, str]]:
    parents = source.tree.parents
    bones = []
    for joint, parent in enumerate(parents):
        if parent < 0 or joint == source.roles.pelvis:
            continue
        colour = REFERENCE["left"]
        for side, joints in (("left", source.roles.left), ("right", source.roles.right)):
            if joint in joints:
                colour = _colour(side)
        if joint in (*source.roles.spine, source.roles.neck, source.roles.head):
            colour = _colour("")
        bones.append((joint, parent, colour))
    return bones


def draw_check(rows: Sequence[Row], path: Path, overwrite: bool) -> None:
    """Draw takes, one a row: for each frame and view the skeleton, and right of it the body.

    Raises:
        EdgeposeError: matplotlib is missing, or the picture cannot be written.
    """
    require_matplotlib("a picture")
    from matplotlib.figure import Figure

    columns = 2 * len(_VIEWS) * len(_FRAMES)
    figure = Figure(figsize=(columns * _COLUMN_IN, len(rows) * _ROW_IN), dpi=_DPI)
    axes = figure.subplots(len(rows), columns, squeeze=False)
    for line, entry in zip(axes, rows, strict=True):
        _draw_row(line, entry)
    figure.subplots_adjust(0.005, 0.005, 0.995, 1 - 0.35 / (len(rows) * _ROW_IN), 0.02, 0.2)
    save_picture(figure, path, overwrite=overwrite)


def _draw_row(line: Sequence[Axes], entry: Row) -> None:
    from matplotlib.collections import LineCollection

    column = 0
    for index, name in enumerate(_FRAMES):
        for view, axis, sign in _VIEWS:
            for joints, bones in (
                (entry.source[index], entry.source_bones),
                (entry.target[index], entry.target_bones),
            ):
                ax = line[column]
                points = np.stack([sign * joints[:, axis], joints[:, 1]], axis=1)
                segments = [points[[start, end]] for start, end, _ in bones]
                ax.add_collection(
                    LineCollection(segments, colors=[colour for *_, colour in bones], linewidths=1.6)
                )
                ax.set(xlim=(-_REACH_M * 0.6, _REACH_M * 0.6), ylim=(-_REACH_M, _REACH_M), aspect="equal")
                ax.axis("off")
                column += 1
            line[column - 2].set_title(
                f"{name} ({entry.frames[index]}), {view}", fontsize=6, color=INK, loc="left", pad=1
            )
    line[0].text(0, 1.09, entry.title, transform=line[0].transAxes, fontsize=8, color=INK)
