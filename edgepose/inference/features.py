"""Network inputs, and poses from network outputs, in torch: one implementation for training and archives.

All functions are scriptable and take any leading dimensions. T is the body frame, R_TB a segment's
orientation in it, and "root" the pelvis sensor.
"""

from __future__ import annotations

import torch
from torch import Tensor

from edgepose.placements import PLACEMENTS, ROOT

INPUTS = 60
"""Inputs per frame: five rotation matrices, then five accelerations."""

ACCELERATIONS = 15

# Scripted code cannot read module globals; it relies on the root being the last placement.
assert len(PLACEMENTS) - 1 == ROOT


def root_relative(orientation: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor]:
    """Orientations and accelerations of the limb and head sensors relative to the root (DIP eq. 9 and 10).

    Args:
        orientation: (..., 6, 3, 3) segment orientations R_TB in the order of PLACEMENTS.
        acceleration: (..., 6, 3) accelerations without gravity in T, m/s^2.

    Returns:
        (..., 5, 3, 3) `inv(R_root) R_s` and (..., 5, 3) `inv(R_root) (a_s - a_root)`.
    """
    root = orientation[..., -1:, :, :].transpose(-1, -2)
    relative = torch.matmul(root, orientation[..., :-1, :, :])
    difference = acceleration[..., :-1, :] - acceleration[..., -1:, :]
    return relative, torch.matmul(root, difference.unsqueeze(-1)).squeeze(-1)


def network_input(orientation: Tensor, acceleration: Tensor) -> Tensor:
    """The vector x_t (..., 60) of DIP 4.3: five row-major matrices, five accelerations, not z-scored.

    The arguments are those of `root_relative`.
    """
    relative, difference = root_relative(orientation, acceleration)
    return torch.cat([relative.flatten(-3), difference.flatten(-2)], dim=-1)


def rotation_from_6d(x: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) from 6D vectors x (..., 6) (Zhou et al. 2019).

    The halves of x, orthonormalised, are the first two columns.
    """
    first = torch.nn.functional.normalize(x[..., :3], dim=-1)
    second = x[..., 3:]
    second = second - (first * second).sum(-1, keepdim=True) * first
    second = torch.nn.functional.normalize(second, dim=-1)
    return torch.stack([first, second, torch.linalg.cross(first, second)], dim=-1)


def rotation_to_6d(r: Tensor) -> Tensor:
    """The first two columns (..., 6) of rotation matrices (..., 3, 3)."""
    return r[..., :2].transpose(-1, -2).flatten(-2)


def nearest_rotation(m: Tensor) -> Tensor:
    """Nearest rotation matrices (..., 3, 3), determinant +1, to any matrices in the Frobenius norm."""
    u, _, vt = torch.linalg.svd(m)
    sign = torch.det(torch.matmul(u, vt)).sign()
    u = torch.cat([u[..., :2], u[..., 2:] * sign[..., None, None]], dim=-1)
    return torch.matmul(u, vt)


def local_rotations(relative: Tensor, root: Tensor, parents: Tensor) -> Tensor:
    """Local rotations (..., 24, 3, 3) from joint rotations relative to the root.

    Args:
        relative: (..., 24, 3, 3) global joint rotations in the root's frame; joint 0 is the identity.
        root: (..., 3, 3) the root's orientation R_TB, which becomes joint 0.
        parents: (23,) parents of the joints 1 to 23.
    """
    above = relative.index_select(-3, parents).transpose(-1, -2)
    return torch.cat([root.unsqueeze(-3), torch.matmul(above, relative[..., 1:, :, :])], dim=-3)
