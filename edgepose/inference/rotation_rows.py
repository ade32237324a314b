"""The rotations that an archive's poses are made of, as rows of one array."""

from __future__ import annotations

from collections.abc import Sequence

from edgepose.placements import BONES, ROOT
from edgepose.skeleton import PARENTS

SEEN = 9
"""Matrices of a frame seen from the root.

The rows of 0 to 5 are the columns of the sensors' orientations, those of 6 and 7 the accelerations of the six
sensors, all in the root's frame. 8 is the root's orientation R_TB.
"""

SEEN_ROOT = 8
"""Index of the root's orientation among them."""


def rotation_rows(joints: Sequence[int], passed: bool) -> tuple[list[int], list[int]]:
    """Return for each of SMPL's 24 joints the rows of its own rotation and of its parent's.

    The rows are [frames seen from the root..., the predicted rotations..., the identity]. All are transposed
    apart from the root's orientation, which counts as the parent of joint 0. Feet, toes, wrists and hands
    have their parent's rotation.

    Args:
        joints: the joints that the network predicts, in its order.
        passed: whether bones with a sensor take its orientation.
    """
    rows = {joint: SEEN + i for i, joint in enumerate(joints)}
    if passed:
        rows |= {bone: i for i, bone in enumerate(BONES[:ROOT])}
    own = [SEEN + len(joints)]
    for joint in range(1, len(PARENTS)):
        own.append(rows.get(joint, own[PARENTS[joint]]))
    return own, [SEEN_ROOT, *(own[parent] for parent in PARENTS[1:])]
