"""Trivial baselines that a network must beat, shown with every result."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.inference.features import network_input
from edgepose.placements import BONES, ROOT
from edgepose.skeleton import JOINTS, PARENTS, UNOBSERVED, global_rotations, local_from_global
from edgepose_export.mocap.straight_pose import straight_pose
from edgepose_export.training.dataset import Take

Array = NDArray[np.float64]

NEIGHBOURS = 8

MOST_FRAMES = 50_000
"""Training frames, evenly spaced, among which nearest neighbours are searched: 55 MB."""

_BETWEEN = {
    # joint without a sensor: (the two nearest bones with one, share of the way from the first to the second)
    1: (0, 4, 1 / 2), 2: (0, 5, 1 / 2),
    3: (0, 15, 1 / 5), 6: (0, 15, 2 / 5), 9: (0, 15, 3 / 5), 12: (0, 15, 4 / 5),
    13: (0, 15, 3 / 5), 14: (0, 15, 3 / 5),
    16: (9, 18, 1 / 2), 17: (9, 19, 1 / 2),
}  # fmt: skip
"""Thighs are halfway between pelvis and shank, trunk and neck in equal steps from pelvis to head, collars
like the chest, upper arms halfway between chest and forearm."""

_FOLLOWED = {1: 4, 2: 5, 3: 0, 6: 0, 9: 0, 12: 15, 13: 0, 14: 0, 16: 18, 17: 19}
"""Bone with a sensor that each joint without one follows: thighs the shanks, upper arms the forearms, the
back and the collars the pelvis, the neck the head."""


def _measured(take: Take) -> Array:
    """Return global rotations (T, 24, 3, 3) in T: those of the measured bones; the others are NaN."""
    poses = np.full((len(take.orientation), 24, 3, 3), np.nan)
    poses[:, list(BONES)] = take.orientation
    return poses


def _local(poses: Array) -> Array:
    """Convert global rotations to local ones, with feet, toes, wrists and hands at rest."""
    for joint, parent in enumerate(PARENTS):
        if JOINTS[joint].endswith(("ankle", "foot", "wrist", "hand")):
            poses[:, joint] = poses[:, parent]
    return local_from_global(poses)


def interpolated(take: Take, offsets: Array | None = None) -> Array:
    """Return local poses (T, 24, 3, 3): measured bones, and the others interpolated from the nearest sensors.

    Args:
        take: the take whose sensors are used.
        offsets: (24, 3, 3) right factors for the interpolated rotations, see `Baselines.offsets`.
    """
    poses = _measured(take)
    for joint, (first, second, share) in sorted(_BETWEEN.items(), key=lambda item: item[0]):
        a, b = (rot.matrix_to_quat(poses[:, bone]) for bone in (first, second))
        poses[:, joint] = rot.quat_to_matrix(rot.slerp(a, b, np.full(len(a), share)))
    if offsets is not None:
        poses[:, list(UNOBSERVED)] = poses[:, list(UNOBSERVED)] @ offsets[list(UNOBSERVED)]
    return _local(poses)


def following(take: Take) -> Array:
    """Return local poses (T, 24, 3, 3): measured bones, and the others oriented like the bone they follow."""
    poses = _measured(take)
    poses[:, list(_FOLLOWED)] = poses[:, list(_FOLLOWED.values())]
    return _local(poses)


def straight(take: Take) -> Array:
    """Return local poses (T, 24, 3, 3): the straight pose, oriented as the pelvis sensor is."""
    return _constant(local_from_global(straight_pose()), take)


def interpolated_from_straight(take: Take) -> Array:
    """Return local poses (T, 24, 3, 3) as `interpolated`, with the offsets that fit the straight pose."""
    pose = straight_pose()
    held = take._replace(orientation=pose[None, list(BONES)])
    return interpolated(take, rot.transpose(global_rotations(interpolated(held))[0]) @ pose)


class Baselines(NamedTuple):
    """The training data of the baselines.

    Attributes:
        mean_pose: (24, 3, 3) mean local rotations.
        offsets: (24, 3, 3) mean rotation from each interpolated joint to the true one, in its own frame.
        inputs: (N, 60) float32 network inputs of single frames, at most `MOST_FRAMES`.
        poses: (N, 24, 3, 3) float32 local rotations of these frames.
    """

    mean_pose: Array
    offsets: Array
    inputs: NDArray[np.float32]
    poses: NDArray[np.float32]


def learn(takes: Iterable[Take], every: int = 10) -> Baselines:
    """Compute means over every tenth frame of the training takes and keep single frames, a take at a time."""
    sums, count = np.zeros((2, 24, 3, 3)), 0
    kept: list[tuple[NDArray[np.intp], NDArray[np.float32], NDArray[np.float32]]] = []
    seen, stride = 0, 1
    for take in takes:
        part = take._replace(orientation=take.orientation[::every], pose=take.pose[::every])
        local = part.pose.astype(float)
        sums += (
            local.sum(0),
            (rot.transpose(global_rotations(interpolated(part))) @ global_rotations(local)).sum(0),
        )
        count += len(local)
        frames = np.arange(seen, seen + len(take.pose))
        seen += len(frames)
        chosen = frames % stride == 0
        kept.append((frames[chosen], _inputs(take)[chosen], take.pose[chosen]))
        while sum(len(numbers) for numbers, *_ in kept) > MOST_FRAMES:
            stride *= 2
            kept = [tuple(x[row[0] % stride == 0] for x in row) for row in kept]  # type: ignore[misc]
    mean_pose, offsets = rot.nearest_rotation(sums / count)
    _, inputs, poses = (np.concatenate(column) for column in zip(*kept, strict=True))
    return Baselines(mean_pose, offsets, inputs, poses)


def _inputs(take: Take) -> NDArray[np.float32]:
    orientation, acceleration = torch.tensor(take.orientation), torch.tensor(take.acceleration)
    return network_input(orientation.float(), acceleration.float()).numpy()


def _constant(pose: Array, take: Take) -> Array:
    """Return one local pose (24, 3, 3) for every frame of a take, oriented as the pelvis sensor is."""
    poses = np.tile(pose, (len(take.orientation), 1, 1, 1))
    poses[:, 0] = take.orientation[:, ROOT]
    return poses


def with_measured_bones(take: Take, pose: Array) -> Array:
    """Return local poses (T, 24, 3, 3): measured bones, all other joints as in a local pose (24, 3, 3)."""
    poses = _measured(take)
    for joint, parent in enumerate(PARENTS):
        if joint not in BONES:
            poses[:, joint] = poses[:, parent] @ pose[joint]
    return local_from_global(poses)


def nearest(take: Take, trained: Baselines) -> Array:
    """Return local poses (T, 24, 3, 3): means of the training frames with the nearest inputs."""
    scale = trained.inputs.std(0).clip(1e-3)
    known = torch.from_numpy(trained.inputs / scale)
    rows = []
    for part in torch.from_numpy(_inputs(take) / scale).split(256):
        distances = torch.cdist(part, known)
        rows.append(distances.topk(min(NEIGHBOURS, len(known)), largest=False).indices)
    poses = rot.nearest_rotation(trained.poses[torch.cat(rows).numpy()].astype(float).mean(1))
    poses[:, 0] = take.orientation[:, ROOT]
    return poses


METHODS: dict[str, Callable[[Take, Baselines], Array]] = {
    "mean pose": lambda take, trained: _constant(trained.mean_pose, take),
    "frozen calibration pose": lambda take, _: straight(take),
    "measured bones, others' mean local pose": lambda take, trained: with_measured_bones(
        take, trained.mean_pose
    ),
    "measured bones, others interpolated": lambda take, _: interpolated(take),
    "measured bones, others interpolated + mean offsets": lambda take, trained: interpolated(
        take, trained.offsets
    ),
    f"{NEIGHBOURS} nearest neighbours of the frame": nearest,
}
"""Functions that return local poses (T, 24, 3, 3), by the baseline's name; all use the root's orientation."""
