"""Paths of the two real wearers, see `real_wearers`: nobody measured them, but what they did is known.

The walker goes out, turns, and comes back to the start. The sitter stands, sits on a chair and stands up.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from edgepose.analysis.metrics import aligned
from edgepose_export.evaluation.paths import BOTH, estimates, soles, streamed
from edgepose_export.evaluation.real_wearers import SITTER, WALKER, Wearer, read_sitter, read_walker
from edgepose_export.training.dataset import RATE

Array = NDArray[np.float64]

LEGEND = """\
out, back: from the place of the N-pose to the farthest point, and from there to
    the place of the last N-pose; apart: distance of the two places
height: range of the pelvis' height while walking, mean over a second each
lowered: pelvis on the chair below the standing one; risen: standing again below
    the first standing; feet: height of the higher sole on the chair"""


class RealPath(NamedTuple):
    """An estimated path.

    Attributes:
        wearer: the recording.
        pelvis: (T, 3) positions, metres.
        feet: (T, 2, 3) positions of the soles below the ankles, metres.
    """

    wearer: Wearer
    pelvis: Array
    feet: Array

    def height(self, span: tuple[float, float]) -> float:
        """Return the mean height of the pelvis in a time, metres."""
        return float(self.pelvis[self.wearer.during(span), 1].mean())


Models = Mapping[str, tuple[torch.jit.ScriptModule, Mapping[str, Any]]]
"""Archives with their metadata, by the name of their rows."""


def real_paths(models: Models, folder: Path) -> dict[str, tuple[RealPath, RealPath]]:
    """Return the paths of walker and sitter by model; models that estimate no places are left out.

    Raises:
        EdgeposeError: a recording is missing or cannot be used.
    """
    wearers = read_walker(folder), read_sitter(folder)
    paths = {}
    for name, (module, metadata) in models.items():
        if "place" in metadata:
            walker, sitter = (_path(wearer, module, metadata["future"]) for wearer in wearers)
            paths[name] = walker, sitter
    return paths


def _path(wearer: Wearer, module: torch.jit.ScriptModule, future: int) -> RealPath:
    poses, place = streamed(module, wearer.take, future)
    pelvis = estimates(poses, place, wearer.time_s, only=BOTH)[BOTH]
    return RealPath(wearer, pelvis, pelvis[:, None] + soles(poses))


def walker_row(path: RealPath) -> dict[str, float]:
    """Return the measures of the walker's path by column."""
    first, last = WALKER.parts["N-pose, start"], WALKER.parts["N-pose, end"]
    level = path.pelvis[:, [0, 2]]
    start, end = (level[path.wearer.during(span)].mean(axis=0) for span in (first, last))
    walking = path.wearer.during((first[1], last[0]))
    far = level[np.argmax(np.linalg.norm(level - start, axis=1))]
    out, back = (float(np.linalg.norm(far - place)) for place in (start, end))
    second = round(RATE)
    heights = np.convolve(path.pelvis[walking, 1], np.full(second, 1.0 / second), "valid")
    return {
        "out, m": out,
        "back, m": back,
        "difference, %": 100.0 * abs(out - back) / (0.5 * (out + back)),
        "apart, m": float(np.linalg.norm(end - start)),
        "height, cm": 100.0 * float(np.ptp(heights)),
    }


def sitter_row(path: RealPath) -> dict[str, float]:
    """Return the measures of the sitter's path by column."""
    standing, sitting, later, again = (path.height(span) for span in SITTER.parts.values())
    seated = path.wearer.during(SITTER.parts["sitting"])
    return {
        "standing, m": standing,
        "sitting, m": sitting,
        "after 20 s, m": later,
        "up again, m": again,
        "lowered, m": standing - sitting,
        "risen, cm": 100.0 * (standing - again),
        "feet, cm": 100.0 * float(path.feet[seated, :, 1].max(axis=1).mean()),
    }


def cells(rows: Mapping[str, Mapping[str, float]]) -> list[list[str]]:
    """Return the cells of a table: a head, and a row for each model."""
    return [
        ["", *next(iter(rows.values()))],
        *([name, *(_number(*item) for item in row.items())] for name, row in rows.items()),
    ]


def format_table(title: str, rows: Mapping[str, Mapping[str, float]]) -> str:
    """Format a table with one line per model."""
    return "\n".join([title, *aligned(cells(rows))])


def _number(column: str, value: float) -> str:
    return f"{value:.2f}" if column.endswith(" m") else f"{value:.1f}"
