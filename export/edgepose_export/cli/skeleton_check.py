"""The picture of `edgepose synthesize --check`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from edgepose.analysis.figures import check_picture
from edgepose.cli.terminal.messages import say
from edgepose.errors import EdgeposeError
from edgepose.skeleton import Body
from edgepose_export.mocap import Mapping, fault, read_source
from edgepose_export.mocap.check_picture import Row, draw_check, figures_of, skeleton_key
from edgepose_export.mocap.retargeting import retarget

MOST_SKELETONS = 40
"""Skeletons in a picture, which is 2.1 inches high for each."""


def draw_skeletons(
    files: Sequence[tuple[Path, Path]],
    picture: Path,
    body: Body,
    *,
    t_pose: Path | None,
    mapping: Mapping | None,
    overwrite: bool,
) -> None:
    """Draw one take of each skeleton in some files; a take that cannot be read makes way for the next.

    Args:
        files: folder and path of each file; AMASS files are left out, because they hold no skeleton.
        picture: file to write.
        body: body that follows the skeletons.
        t_pose: T-pose of the files.
        mapping: what is known about the skeletons.
        overwrite: whether `picture` may be replaced.

    Raises:
        EdgeposeError: no file can be drawn, or the picture cannot be written.
    """
    check_picture(picture, "--check", overwrite)
    rows: dict[str, Row] = {}
    problems: dict[str, str] = {}
    for root, path in files:
        if path.suffix.lower() == ".npz":
            continue
        key = ""
        try:
            key = skeleton_key(path)
            if key in rows or len(rows) == MOST_SKELETONS:
                continue
            title = str(path.relative_to(root) if root != path else path.name)
            source = read_source(path, t_pose, mapping)
            motion = retarget(source)
            problem = fault(motion)
            if problem:
                raise EdgeposeError(f"{path}: {problem}")
            rows[key] = figures_of(title, source, motion, body)
            problems.pop(key, None)
        except EdgeposeError as error:
            problems.setdefault(key, str(error))
    for problem in problems.values():
        say(f"not drawn: {problem}")
    if not rows:
        raise EdgeposeError("no skeleton to draw: AMASS files hold none, others cannot be read")
    draw_check(list(rows.values()), picture, overwrite)
    what = "1 skeleton" if len(rows) == 1 else f"{len(rows)} skeletons"
    say(f"{what} drawn to {picture}{' (no more fit)' if len(rows) == MOST_SKELETONS else ''}")
