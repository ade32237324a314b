"""Wearers who are calibrated with straighter arms than actors stand with.

Actors are zeroed where they stand at ease: elbows bent by 15 deg, hands pronated, arms a little off the body
(see `mocap.zeroing`). Wearers are asked for straight arms, and most come closer to them. All bones of an arm
then have another zero.
"""

from __future__ import annotations

import torch

from edgepose.placements import BONES
from edgepose.skeleton import JOINTS
from edgepose_export.mocap.straight_pose import straight_pose
from edgepose_export.mocap.zeroing import STANDING_DEG
from edgepose_export.networks.normalisation import rotations_of
from edgepose_export.training.dataset import Batch

SHARE = 0.5
"""Share of the sequences whose wearers stand straighter than at ease."""

_ARMS = [i for i, name in enumerate(JOINTS) if name.endswith(("shoulder", "elbow", "wrist", "hand"))]
_SENSORS = [i for i, bone in enumerate(BONES) if bone in _ARMS]
_ANGLES = torch.deg2rad(torch.tensor(STANDING_DEG[_ARMS])).float()
_REST = torch.tensor(straight_pose()[_ARMS]).float()


def with_straight_arms(batch: Batch, size: float, generator: torch.Generator) -> Batch:
    """Return sequences of wearers some of whom were calibrated with straighter arms.

    Args:
        batch: sequences.
        size: greatest share, drawn for each axis, of the way from arms at ease to straight arms.
        generator: source of the random numbers.
    """
    chosen = torch.rand(len(batch.orientation), 1, 1, generator=generator) < SHARE
    shares = size * chosen * torch.rand(len(batch.orientation), 1, 3, generator=generator)
    frames = (_REST.mT @ rotations_of(shares * _ANGLES) @ _REST).unsqueeze(1)
    relative, orientation = batch.relative.clone(), batch.orientation.clone()
    relative[:, :, _ARMS] = relative[:, :, _ARMS] @ frames
    sensors = frames[:, :, [_ARMS.index(BONES[i]) for i in _SENSORS]]
    orientation[:, :, _SENSORS] = orientation[:, :, _SENSORS] @ sensors
    return batch._replace(orientation=orientation, relative=relative)
