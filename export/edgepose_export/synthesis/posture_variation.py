"""Variation of postures, so that training covers more people than were captured."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from edgepose.placements import BONES, ROOT
from edgepose.pose import CONTACTS
from edgepose.skeleton import JOINTS, PARENTS
from edgepose_export.networks.normalisation import rotations_of
from edgepose_export.synthesis.body_shapes import LEVERS, Shapes
from edgepose_export.training.dataset import RATE, Batch

BEFORE, AFTER = 2, 1
"""Frames that `vary_bodies` needs before and after those it returns, because accelerations are second
differences, averaged over two frames.
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
"""Standard deviations of a joint's rotation vector about its bone's X, Y, Z, degrees, by the last part of its
name ("spine" stands for all three). The bend of knees and elbows does not change: that they never bend the
wrong way tells a thigh from a straight shank.
"""

SWAY_HZ = 0.7
"""Highest frequency of changes within a sequence."""


def _deviations() -> Tensor:
    """Return standard deviations (24, 3), radians; zero for joints that do not vary."""
    result = torch.zeros(len(JOINTS), 3)
    for joint, name in enumerate(JOINTS):
        kind = name.rpartition("_")[2].rstrip("123")
        if kind in DEVIATIONS:
            result[joint] = torch.deg2rad(torch.tensor(DEVIATIONS[kind]))
    return result


DEVIATION = _deviations()
VARIED = tuple(torch.nonzero(DEVIATION.any(dim=-1)).flatten().tolist())


def vary_bodies(
    batch: Batch, take: Tensor, posture: float, shapes: Shapes | None, generator: torch.Generator
) -> Batch:
    """Return sequences of wearers who hold their joints differently and have other bodies.

    The sensors measure the new motion. The pelvis moves as before, or in proportion to the legs of the other
    body, so feet slide a little. Sensors have to be aligned with their bones.

    Args:
        batch: see `Batch`, with `BEFORE` more frames before and `AFTER` more frames after those returned.
        take: (B, T) index of each frame's take; accelerations at the seam of two takes do not change.
        posture: factor on `DEVIATIONS`.
        shapes: the other bodies; None for those of the batch.
        generator: source of the random numbers.

    Returns:
        The batch without the additional frames.
    """
    relative = other_postures(batch.relative, posture, generator) if posture else batch.relative
    return moved(batch, take, relative, shapes)


def other_postures(relative: Tensor, size: float, generator: torch.Generator) -> Tensor:
    """Return root-relative rotations (B, T, 24, 3, 3) of wearers who hold their joints differently.

    Each joint gets an extra rotation that is mostly constant and sways slowly. Its children follow.
    """
    shape = (len(relative), 1, len(VARIED), 3)
    constant, sway = torch.randn(2, *shape, generator=generator)
    frequency, phase = torch.rand(2, *shape, generator=generator)
    t = torch.arange(relative.shape[1])[:, None, None] / RATE
    wave = 2.0**0.5 * torch.sin(2.0 * math.pi * (SWAY_HZ * frequency * t + phase))
    course = 0.8 * constant + 0.6 * sway * wave
    extra = dict(zip(VARIED, rotations_of(size * DEVIATION[list(VARIED)] * course).unbind(2), strict=True))
    new = [relative[:, :, 0]]
    accumulated = [torch.eye(3)]  # rotation of each bone from its old to its new orientation
    for joint in range(1, len(PARENTS)):
        before, change = relative[:, :, joint], accumulated[PARENTS[joint]]
        if joint in extra:
            change = change @ before @ extra[joint] @ before.mT
        new.append(change @ before)
        accumulated.append(change)
    return torch.stack(new, dim=2)


def moved(batch: Batch, take: Tensor, relative: Tensor, shapes: Shapes | None = None) -> Batch:
    """Return the sequences that sensors measure when bones get new root-relative rotations (B, T, 24, 3, 3).

    The pelvis moves as in the batch, scaled by the other bodies' factors. Contacts stay. The other arguments
    and the result are those of `vary_bodies`.
    """
    orientation, acceleration, before, place = batch
    wanted = slice(BEFORE, relative.shape[1] - AFTER)
    acceleration, place = acceleration[:, wanted], place[:, wanted]
    root = orientation[:, :, ROOT, None]
    if shapes is None:
        shift = _rotated(relative - before, LEVERS)
    else:
        scale = shapes.scale[:, None, None]
        # The old positions scaled are part of the acceleration scaled.
        shift = _rotated(relative, shapes.levers) - _rotated(before, scale[..., None] * LEVERS)
        acceleration = acceleration * scale[..., None]
        place = torch.cat([place[..., : len(CONTACTS)], place[..., len(CONTACTS) :] * scale], dim=-1)
    shift = (root @ shift.unsqueeze(-1)).squeeze(-1)
    # Accelerations are made as in `synthesis.virtual_imus` and `dataset.read_take`.
    change = (shift[:, :-2] + shift[:, 2:] - 2.0 * shift[:, 1:-1]) * RATE**2
    change = change * (take[:, :-2] == take[:, 2:])[..., None, None]
    change = 0.5 * (change[:, 1:] + change[:, :-1])
    bones = (root @ relative[:, :, list(BONES[:ROOT])])[:, wanted]
    orientation = torch.cat([bones, orientation[:, wanted, ROOT:]], dim=2)
    return Batch(orientation, acceleration + change, relative[:, wanted], place)


def _rotated(relative: Tensor, levers: Tensor) -> Tensor:
    """Return positions (B, T, 6, 3) of sensors relative to the pelvis, in its frame.

    Args:
        relative: (B, T, 24, 3, 3) root-relative rotations.
        levers: (6, 24, 3) or (B, 6, 24, 3), see `levers_of`.
    """
    return torch.einsum(f"btjxy,{'b' * (levers.dim() == 4)}ijy->btix", relative, levers)
