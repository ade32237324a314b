"""What a motion-capture file holds before its skeleton is known: a tree of joints and their local poses."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import FileFormatError

Array = NDArray[np.float64]


LARGEST = 1e6
"""Numbers of a file beyond this are taken for damage: no angle and no length in any unit comes near."""


class JointTree(NamedTuple):
    """Poses of one skeleton over time. Lengths are in the unit of the file that was read (see the reader)."""

    names: tuple[str, ...]
    """Joint names (J); each joint comes after its parent."""
    parents: tuple[int, ...]
    """Index of each joint's parent; -1 for the root, which is joint 0."""
    offsets: Array
    """(J, 3) joint position in its parent's frame when all angles are zero."""
    rotations: Array
    """(T, J, 3, 3) rotation of each joint's frame against its parent's; the root's against the world."""
    positions: Array
    """(T, J, 3) joint position in its parent's frame; the root's in the world."""
    rate: float
    """Frames per second."""


def forward(tree: JointTree) -> tuple[Array, Array]:
    """Global joint rotations (T, J, 3, 3) and positions (T, J, 3) in the file's world and unit."""
    rotations = np.empty_like(tree.rotations)
    positions = np.empty_like(tree.positions)
    for j, parent in enumerate(tree.parents):
        if parent < 0:
            rotations[:, j] = tree.rotations[:, j]
            positions[:, j] = tree.positions[:, j]
        else:
            rotations[:, j] = rotations[:, parent] @ tree.rotations[:, j]
            moved = rotations[:, parent] @ tree.positions[:, j, :, None]
            positions[:, j] = positions[:, parent] + moved[..., 0]
    return rotations, positions


def fail(path: Path, line: int, problem: str) -> NoReturn:
    """Raise the error for a problem in a line, counted from 1."""
    raise FileFormatError(f"{path}, line {line}: {problem}")


def numbers(path: Path, line: int, words: list[str], count: int) -> list[float]:
    """The numbers of a line, counted from 1.

    Raises:
        FileFormatError: a word is no number, is not finite or beyond `LARGEST`, or there are more or fewer.
    """
    try:
        values = [float(word) for word in words]
    except ValueError:
        fail(path, line, "a number was expected")
    if len(values) != count:
        fail(path, line, f"{count} numbers were expected, {len(values)} found")
    if not all(abs(value) < LARGEST for value in values):
        fail(path, line, "a number is not finite, or far too large")
    return values
