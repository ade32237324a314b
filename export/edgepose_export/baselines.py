"""Trivial answers that a network must beat: they stand beside every result."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.placements import BONES, ROOT
from edgepose.skeleton import JOINTS, PARENTS, UNOBSERVED, forward_kinematics, local_from_global
from edgepose_export.dataset import Take

Array = NDArray[np.float64]

_BETWEEN = {
    # unobserved joint: (nearest sensors' bones along the body, share of the way from the first to the second)
    1: (0, 4, 1 / 2), 2: (0, 5, 1 / 2),
    3: (0, 15, 1 / 5), 6: (0, 15, 2 / 5), 9: (0, 15, 3 / 5), 12: (0, 15, 4 / 5),
    13: (0, 15, 3 / 5), 14: (0, 15, 3 / 5),
    16: (9, 18, 1 / 2), 17: (9, 19, 1 / 2),
}  # fmt: skip
"""Thighs halfway between pelvis and shank, trunk and neck in equal steps from pelvis to head, collars with
the chest, upper arms halfway between chest and forearm."""


def _mean(matrices: Array) -> Array:
    """Chordal mean rotations of (N, ..., 3, 3) over the first axis."""
    return rot.nearest_rotation(matrices.mean(0))


def _measured(take: Take) -> Array:
    """Global rotations (T, 24, 3, 3) in T with the measured bones in place, the rest undefined."""
    poses = np.full((len(take.orientation), 24, 3, 3), np.nan)
    poses[:, list(BONES)] = take.orientation
    return poses


def _local(poses: Array) -> Array:
    """Local rotations of global ones; feet, toes, wrists and hands first take their parents' rotation."""
    for joint, parent in enumerate(PARENTS):
        if JOINTS[joint].endswith(("ankle", "foot", "wrist", "hand")):
            poses[:, joint] = poses[:, parent]
    return local_from_global(poses)


def interpolated(take: Take, offsets: Array | None = None) -> Array:
    """Local poses (T, 24, 3, 3): measured bones, the others interpolated from the nearest sensors.

    Args:
        take: whose sensors are used.
        offsets: (24, 3, 3) turned in behind each interpolated rotation, see `Baselines.offsets`.
    """
    poses = _measured(take)
    for joint, (first, second, share) in sorted(_BETWEEN.items(), key=lambda item: item[0]):
        a, b = (rot.matrix_to_quat(poses[:, bone]) for bone in (first, second))
        poses[:, joint] = rot.quat_to_matrix(rot.slerp(a, b, np.full(len(a), share)))
    if offsets is not None:
        poses[:, list(UNOBSERVED)] = poses[:, list(UNOBSERVED)] @ offsets[list(UNOBSERVED)]
    return _local(poses)


class Baselines(NamedTuple):
    """What the baselines know of the training takes.

    Attributes:
        mean_pose: (24, 3, 3) mean local rotations.
        offsets: (24, 3, 3) mean rotation from each interpolated joint's guess to its truth, in its frame.
    """

    mean_pose: Array
    offsets: Array


def learn(takes: list[Take], every: int = 10) -> Baselines:
    """Means over every tenth frame of the training takes."""
    locals_, offsets = [], []
    for take in takes:
        part = take._replace(orientation=take.orientation[::every], pose=take.pose[::every])
        locals_.append(part.pose.astype(float))
        offsets.append(rot.transpose(_globals(interpolated(part))) @ _globals(locals_[-1]))
    return Baselines(_mean(np.concatenate(locals_)), _mean(np.concatenate(offsets)))


def _globals(local: Array) -> Array:
    return forward_kinematics(local, np.zeros((24, 3)))[0]


NAMES = (
    "mean pose",
    "measured bones, others interpolated",
    "measured bones, others interpolated + mean offsets",
)
"""The baselines, in the order of `poses`."""


def poses(take: Take, baselines: Baselines) -> dict[str, Array]:
    """Local poses (T, 24, 3, 3) of each baseline, by its name; all of them know the root's orientation."""
    mean = np.tile(baselines.mean_pose, (len(take.pose), 1, 1, 1))
    mean[:, 0] = take.orientation[:, ROOT]
    results = (mean, interpolated(take), interpolated(take, baselines.offsets))
    return dict(zip(NAMES, results, strict=True))
