"""The same motion in other postures: training sees more bodies than were captured."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from edgepose.placements import BONES, ROOT
from edgepose.skeleton import JOINTS, PARENTS, default_body
from edgepose_export.dataset import RATE

Batch = tuple[Tensor, Tensor, Tensor]
"""Orientations R_TB (B, T, 6, 3, 3), accelerations in T (B, T, 6, 3), m/s^2, and true rotations seen from the
root (B, T, 24, 3, 3).
"""

DEVIATIONS = {
    "spine": (3.0, 2.0, 2.0),
    "neck": (5.0, 3.0, 3.0),
    "head": (4.0, 3.0, 3.0),
    "collar": (2.0, 3.0, 3.0),
    "shoulder": (8.0, 6.0, 6.0),
    "elbow": (6.0, 6.0, 4.0),
    "hip": (6.0, 4.0, 4.0),
    "knee": (6.0, 2.0, 2.0),
}
"""Standard deviations of a joint's rotation vector about its bone's X, Y, Z, degrees, by the end of its name
("spine" begins three names).
"""

SWAY_HZ = 0.7
"""Highest frequency of what changes within a sequence."""

IMPOSSIBLE = 150.0
"""Change of an acceleration, m/s^2, that only the seam of two takes makes."""


def _deviations() -> Tensor:
    """(24, 3) radians; zero for joints that keep their posture."""
    result = torch.zeros(len(JOINTS), 3)
    for joint, name in enumerate(JOINTS):
        kind = name.rpartition("_")[2].rstrip("123")
        if kind in DEVIATIONS:
            result[joint] = torch.deg2rad(torch.tensor(DEVIATIONS[kind]))
    return result


def _levers() -> Tensor:
    """(6, 24, 3) metres: sums of rotated levers over the bones are the sensors' places from the pelvis."""
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


def rotations_of(vectors: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3), radians (Rodrigues)."""
    angle = vectors.norm(dim=-1, keepdim=True).unsqueeze(-1)
    zero = torch.zeros_like(vectors[..., 0])
    x, y, z = vectors.unbind(-1)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    sine, versine = torch.sinc(angle / math.pi), 0.5 * torch.sinc(angle / (2.0 * math.pi)).square()
    return torch.eye(3) + sine * skew + versine * (skew @ skew)


def other_postures(batch: Batch, size: float, generator: torch.Generator) -> Batch:
    """Sequences whose wearers hold their joints otherwise: each joint is turned by a rotation that is mostly
    constant and sways slowly, its children go with it, and the sensors measure what they then would.

    Sensors have to be aligned with their bones.

    Args:
        batch: see `Batch`.
        size: factor on `DEVIATIONS`.
        generator: of the random numbers.
    """
    relative = batch[2]
    frames = relative.shape[1]
    shape = (len(relative), 1, len(VARIED), 3)
    constant, sway = torch.randn(2, *shape, generator=generator)
    frequency, phase = torch.rand(2, *shape, generator=generator)
    t = torch.arange(frames)[:, None, None] / RATE
    course = 0.8 * constant + 0.6 * sway * torch.sin(2.0 * math.pi * (SWAY_HZ * frequency * t + phase))
    turns = dict(zip(VARIED, rotations_of(size * DEVIATION[list(VARIED)] * course).unbind(2), strict=True))
    new = [relative[:, :, 0]]
    for joint in range(1, len(PARENTS)):
        parent = PARENTS[joint]
        bone = new[parent] @ (relative[:, :, parent].mT @ relative[:, :, joint])
        new.append(bone @ turns[joint] if joint in turns else bone)
    return moved(batch, torch.stack(new, dim=2))


def moved(batch: Batch, relative: Tensor) -> Batch:
    """What sensors measure whose wearer's pelvis moves as in a batch, the other bones by other root-relative
    rotations (B, T, 24, 3, 3).
    """
    orientation, acceleration, before = batch
    root = orientation[:, :, ROOT, None]
    way = torch.einsum("btjxy,ijy->btix", relative - before, LEVERS)
    way = (root @ way.unsqueeze(-1)).squeeze(-1)
    # As `synthesis.virtual_imus` and `dataset.read_take` make accelerations.
    change = (way[:, :-2] + way[:, 2:] - 2.0 * way[:, 1:-1]) * RATE**2
    change = torch.cat([change[:, :1], change, change[:, -1:]], dim=1)
    change = torch.where(change.norm(dim=-1, keepdim=True) > IMPOSSIBLE, 0.0, change)
    change = torch.cat([change[:, :1], 0.5 * (change[:, 1:] + change[:, :-1])], dim=1)
    bones = root @ relative[:, :, list(BONES[:ROOT])]
    return torch.cat([bones, orientation[:, :, ROOT:]], dim=2), acceleration + change, relative
