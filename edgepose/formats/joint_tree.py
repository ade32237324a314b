"""Content of a motion-capture file with any skeleton: a tree of joints and their local poses."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import FileFormatError

Array = NDArray[np.float64]


LARGEST = 1e6
"""Larger numbers in a file count as damage: no angle or length in any unit comes near."""


class JointTree(NamedTuple):
    """Poses of one skeleton over time; lengths are in the unit of the file (see the reader)."""

    names: tuple[str, ...]
    """Joint names (J); each joint comes after its parent."""
    parents: tuple[int, ...]
    """Index of each joint's parent; -1 for the root, which is joint 0."""
    offsets: Array
    """(J, 3) joint position in its parent's frame if all angles are zero."""
    rotations: Array
    """(T, J, 3, 3) rotation of each joint's frame against its parent's; the root's against the world."""
    positions: Array
    """(T, J, 3) joint position in its parent's frame; the root's in the world."""
    rate: float
    """Frames per second."""


def forward(tree: JointTree) -> tuple[Array, Array]:
    """Compute global joint rotations (T, J, 3, 3) and positions (T, J, 3) in the file's world and unit."""
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
    """Raise a FileFormatError for a problem in a line, counted from 1."""
    raise FileFormatError(f"{path}, line {line}: {problem}")


def numbers(path: Path, line: int, words: list[str], count: int) -> list[float]:
    """Parse the `count` numbers of a line, counted from 1.

    Raises:
        FileFormatError: a word is not a number, is not finite or beyond `LARGEST`, or the count differs.
    """
    try:
        values = [float(word.replace(",", ".")) for word in words]  # some programs write decimal commas
    except ValueError:
        fail(path, line, "a number was expected")
    if len(values) != count:
        fail(path, line, f"{count} numbers were expected, {len(values)} found")
    if not all(abs(value) < LARGEST for value in values):
        fail(path, line, "a number is not finite, or far too large")
    return values
