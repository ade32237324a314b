"""The same motion in other postures: training sees more bodies than were captured."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from edgepose.placements import BONES, ROOT
from edgepose.skeleton import JOINTS, PARENTS, default_body
from edgepose_export.networks.normalisation import rotations_of
from edgepose_export.training.dataset import RATE

Batch = tuple[Tensor, Tensor, Tensor]
"""Orientations R_TB (B, T, 6, 3, 3), accelerations in T (B, T, 6, 3), m/s^2, and true rotations seen from the
root (B, T, 24, 3, 3).
"""

BEFORE, AFTER = 2, 1
"""Frames that `vary_postures` needs around those that it gives: accelerations are second differences, and
means over two frames.
"""

DEVIATIONS = {
    "spine": (3.0, 2.0, 2.0),
    "neck": (5.0, 3.0, 3.0),
    "head": (4.0, 3.0, 3.0),
    "collar": (2.0, 3.0, 3.0),
    "shoulder": (8.0, 6.0, 6.0),
    "elbow": (6.0, 0.0, 3.0),
    "hip": (6.0, 4.0, 4.0),
    "knee": (0.0, 2.0, 2.0),
}
"""Standard deviations of a joint's rotation vector about its bone's X, Y, Z, degrees, by the end of its name
("spine" begins three names). Knees and elbows are bent as far as they were: that they do not bend the wrong
way tells a thigh from a straight shank.
"""

SWAY_HZ = 0.7
"""Highest frequency of what changes within a sequence."""


def _deviations() -> Tensor:
    """(24, 3) radians; zero for joints that keep their posture."""
    result = torch.zeros(len(JOINTS), 3)
    for joint, name in enumerate(JOINTS):
        kind = name.rpartition("_")[2].rstrip("123")
        if kind in DEVIATIONS:
            result[joint] = torch.deg2rad(torch.tensor(DEVIATIONS[kind]))
    return result


def _levers() -> Tensor:
    """(6, 24, 3) metres: the sums of rotated levers over the bones are the sensors' places, seen from the
    pelvis, on the default body.
    """
    body = default_body()
    offsets, sensors = torch.tensor(body.offsets).float(), torch.tensor(body.sensors).float()
    result = torch.zeros(len(BONES), len(PARENTS), 3)
    for sensor, bone in enumerate(BONES):
        result[sensor, bone] = sensors[sensor]
        while bone:
            result[sensor, PARENTS[bone]] += offsets[bone]
            bone = PARENTS[bone]
    return result


DEVIATION, LEVERS = _deviations(), _levers()
VARIED = tuple(torch.nonzero(DEVIATION.any(dim=-1)).flatten().tolist())


def vary_postures(batch: Batch, take: Tensor, size: float, generator: torch.Generator) -> Batch:
    """Sequences whose wearers hold their joints otherwise: each joint is turned by a rotation that is mostly
    constant and sways slowly, its children go with it, and the sensors measure what they then would.

    The pelvis moves as it did, so feet slide. Sensors have to be aligned with their bones.

    Args:
        batch: see `Batch`, with `BEFORE` and `AFTER` more frames than are wanted.
        take: (B, T) numbers of the takes that its frames are of; accelerations at the seam of two stay.
        size: factor on `DEVIATIONS`.
        generator: of the random numbers.

    Returns:
        The frames that are wanted.
    """
    relative = batch[2]
    shape = (len(relative), 1, len(VARIED), 3)
    constant, sway = torch.randn(2, *shape, generator=generator)
    frequency, phase = torch.rand(2, *shape, generator=generator)
    t = torch.arange(relative.shape[1])[:, None, None] / RATE
    wave = 2.0**0.5 * torch.sin(2.0 * math.pi * (SWAY_HZ * frequency * t + phase))
    course = 0.8 * constant + 0.6 * sway * wave
    turns = dict(zip(VARIED, rotations_of(size * DEVIATION[list(VARIED)] * course).unbind(2), strict=True))
    new = [relative[:, :, 0]]
    carried = [torch.eye(3)]  # by which turn each bone is moved
    for joint in range(1, len(PARENTS)):
        before, turn = relative[:, :, joint], carried[PARENTS[joint]]
        if joint in turns:
            turn = turn @ before @ turns[joint] @ before.mT
        new.append(turn @ before)
        carried.append(turn)
    return moved(batch, take, torch.stack(new, dim=2))


def moved(batch: Batch, take: Tensor, relative: Tensor) -> Batch:
    """What sensors measure whose wearer's pelvis moves as in a batch, the other bones by other root-relative
    rotations (B, T, 24, 3, 3); other arguments and result as in `vary_postures`.
    """
    orientation, acceleration, before = batch
    root = orientation[:, :, ROOT, None]
    way = torch.einsum("btjxy,ijy->btix", relative - before, LEVERS)
    way = (root @ way.unsqueeze(-1)).squeeze(-1)
    # As `synthesis.virtual_imus` and `dataset.read_take` make accelerations.
    change = (way[:, :-2] + way[:, 2:] - 2.0 * way[:, 1:-1]) * RATE**2
    change = change * (take[:, :-2] == take[:, 2:])[..., None, None]
    change = 0.5 * (change[:, 1:] + change[:, :-1])
    wanted = slice(BEFORE, relative.shape[1] - AFTER)
    bones = (root @ relative[:, :, list(BONES[:ROOT])])[:, wanted]
    orientation = torch.cat([bones, orientation[:, wanted, ROOT:]], dim=2)
    return orientation, acceleration[:, wanted] + change, relative[:, wanted]
