"""What all formats of poses share."""

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
"""Seconds, and numbers of frames, beyond this are taken for damage."""


@dataclass(frozen=True)
class PoseFormat(FileFormat):
    """A format of poses; the module of each format ends with its `FORMAT`.

    Attributes:
        read: returns the poses before the first bad one, and one line on what is bad or None. Raises
            EdgeposeError if no pose is usable.
        holds_poses: whether a file with one of the suffixes holds poses and not a recording of sensors; by
            default all do.
    """

    read: Callable[[Path], tuple[PoseSequence, str | None]]
    holds_poses: Callable[[Path], bool] = lambda path: True


def all_new(count: int) -> tuple[list[frozenset[str]], list[bool]]:
    """`held` and `warming_up` of poses of which nothing is known to be missing."""
    return [frozenset()] * count, [False] * count


def is_absurd(values: NDArray[Any], most: float = LARGEST) -> NDArray[np.bool_]:
    """Which of the numbers are NaN, or too large to be true."""
    return ~(np.abs(values.astype(np.float64)) <= most)
