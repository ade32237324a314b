"""Base of all pose formats."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgepose.formats.joint_tree import LARGEST
from edgepose.formats.registered import FileFormat
from edgepose.pose import PoseSequence

LARGEST_TIME = 1e12
"""Larger times, in seconds, and frame numbers count as damage."""


@dataclass(frozen=True)
class PoseFormat(FileFormat):
    """A format of poses; the module of each format ends with its `FORMAT`.

    Attributes:
        read: returns the good poses, and one line on the problem, or None. Raises
            EdgeposeError if no pose is usable.
        holds_poses: whether a file with one of the suffixes contains poses and not a recording of sensors; by
            default all do.
        read_in: like `read`, with the unit of the file's lengths, if the format has no fixed one.
    """

    read: Callable[[Path], tuple[PoseSequence, str | None]]
    holds_poses: Callable[[Path], bool] = lambda path: True
    read_in: Callable[[Path, str | None], tuple[PoseSequence, str | None]] | None = None


def all_new(count: int) -> tuple[list[frozenset[str]], list[bool]]:
    """Return `held` and `warming_up` of `count` complete poses."""
    return [frozenset()] * count, [False] * count


def is_absurd(values: NDArray[Any], most: float = LARGEST) -> NDArray[np.bool_]:
    """Return which of the numbers are NaN or implausibly large."""
    return ~(np.abs(values.astype(np.float64)) <= most)
