"""What training does to a batch so that a network bears a real wearer."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from edgepose.placements import PLACEMENTS, ROOT
from edgepose.skeleton import JOINTS


def _swapped(names: tuple[str, ...]) -> list[int]:
    other = {"left": "right", "right": "left"}
    sides = [name.partition("_") for name in names]
    return [
        names.index("_".join([other[side], rest])) if side in other else i
        for i, (side, _, rest) in enumerate(sides)
    ]


SENSOR_MIRROR = _swapped(PLACEMENTS)
JOINT_MIRROR = _swapped(JOINTS)


class Augmentation(NamedTuple):
    """Sizes of the disturbances; one draw a sequence unless said.

    Attributes:
        mirror: share of sequences whose left and right are exchanged.
        misalignment_deg: deviation of each sensor's error against its bone, a rotation vector's each
            component (a calibration pose that was not quite the pose).
        heading_deg: deviation of each sensor's heading against the pelvis sensor.
        acceleration_noise: deviation of white noise on each frame's accelerations, m/s^2.
        acceleration_scale: deviation of each sensor's scale error.
        aligned: share of sequences without misalignment and heading errors, so that a network trusts sensors
            that agree with each other.
        pelvis_pitch_deg: deviation of a turn of the pelvis about its own X axis, of bone and sensor alike: as
            if another actor's skeleton, in whom the trunk leans otherwise against the pelvis, did the same.
            `Trainer` leaves sequences with made sitting alone, which the pelvis' pitch tells from standing.
    """

    mirror: float = 0.5
    misalignment_deg: float = 0.0
    heading_deg: float = 0.0
    acceleration_noise: float = 0.0
    acceleration_scale: float = 0.0
    aligned: float = 0.0
    pelvis_pitch_deg: float = 0.0


def mirror(orientation: Tensor, acceleration: Tensor, relative: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Left and right exchanged by a reflection in the plane X = 0 of T; shapes (..., 6, 3, 3), (..., 6, 3),
    (..., 24, 3, 3).
    """
    flip = torch.tensor([-1.0, 1.0, 1.0])
    signs = flip[:, None] * flip
    return (
        orientation[..., SENSOR_MIRROR, :, :] * signs,
        acceleration[..., SENSOR_MIRROR, :] * flip,
        relative[..., JOINT_MIRROR, :, :] * signs,
    )


def small_rotations(vectors: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3), radians."""
    zero = torch.zeros_like(vectors[..., 0])
    x, y, z = vectors.unbind(-1)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    return torch.linalg.matrix_exp(skew)


def augment(
    batch: tuple[Tensor, Tensor, Tensor], how: Augmentation, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Disturbed copies of sequences (B, T, 6, 3, 3), (B, T, 6, 3) and, mirrored and with other pelvises only,
    their true poses (B, T, 24, 3, 3).
    """
    orientation, acceleration, relative = batch
    size = len(orientation)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

    if how.mirror:
        chosen = torch.rand(size, generator=generator) < how.mirror
        mirrored = mirror(orientation[chosen], acceleration[chosen], relative[chosen])
        orientation, acceleration, relative = orientation.clone(), acceleration.clone(), relative.clone()
        orientation[chosen], acceleration[chosen], relative[chosen] = mirrored
    if how.pelvis_pitch_deg:
        pitch = torch.zeros(size, 1, 3)
        pitch[..., 0] = torch.deg2rad(how.pelvis_pitch_deg * normal(size, 1))
        turn = small_rotations(pitch)
        orientation, relative = orientation.clone(), relative.clone()
        orientation[:, :, ROOT] = orientation[:, :, ROOT] @ turn
        relative[:, :, 1:] = turn.mT.unsqueeze(2) @ relative[:, :, 1:]
    turned = (
        (torch.rand(size, generator=generator) >= how.aligned).float() if how.aligned else torch.ones(size)
    )
    if how.misalignment_deg:
        angles = how.misalignment_deg * normal(size, 1, 6, 3) * turned[:, None, None, None]
        error = small_rotations(torch.deg2rad(angles))
        orientation = orientation @ error
    if how.heading_deg:
        vertical = torch.zeros(size, 1, 6, 3)
        vertical[..., :-1, 1] = torch.deg2rad(how.heading_deg * normal(size, 1, 5) * turned[:, None, None])
        turn = small_rotations(vertical)
        orientation = turn @ orientation
        acceleration = (turn @ acceleration.unsqueeze(-1)).squeeze(-1)
    if how.acceleration_scale:
        acceleration = acceleration * (1.0 + how.acceleration_scale * normal(size, 1, 6, 1))
    if how.acceleration_noise:
        acceleration = acceleration + how.acceleration_noise * normal(*acceleration.shape)
    return orientation, acceleration, relative
