"""Wearers who are calibrated with straighter arms."""

from __future__ import annotations

import pytest
import torch

from edgepose.skeleton import JOINTS
from edgepose_export.mocap.straight_pose import straight_pose
from edgepose_export.mocap.zeroing import STANDING_DEG
from edgepose_export.networks.normalisation import rotations_of
from edgepose_export.synthesis import straight_arms
from edgepose_export.training.dataset import Batch

ARMS = [i for i, name in enumerate(JOINTS) if name.endswith(("shoulder", "elbow", "wrist", "hand"))]
OTHERS = [i for i in range(len(JOINTS)) if i not in ARMS]


def sequences(poses: torch.Tensor, count: int) -> Batch:
    """Return sequences of 4 frames in which wearers keep a pose (24, 3, 3), with their sensors aligned."""
    relative = poses.expand(count, 4, 24, 3, 3)
    return Batch(
        relative[:, :, [18, 19, 4, 5, 15, 0]],
        torch.zeros(count, 4, 6, 3),
        relative,
        torch.zeros(count, 4, 10),
    )


def angle(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    trace = (a * b).sum((-1, -2))
    return torch.rad2deg(torch.arccos(((trace - 1.0) / 2.0).clamp(-1.0, 1.0)))


def test_arms_at_ease_are_bent_for_wearers_who_were_calibrated_straight(monkeypatch):
    """Standing at ease is then the posture in which people stand, as seen from straight arms."""
    monkeypatch.setattr(torch, "rand", lambda *shape, generator: torch.ones(shape))
    monkeypatch.setattr(straight_arms, "SHARE", 1.5)
    at_ease = torch.tensor(straight_pose()).float()

    seen = straight_arms.with_straight_arms(sequences(at_ease, 2), 1.0, torch.Generator())

    bent = rotations_of(torch.deg2rad(torch.tensor(STANDING_DEG)).float()) @ at_ease
    assert angle(seen.relative[:, :, ARMS], bent[ARMS]).max() < 0.1
    assert angle(seen.relative[0, 0, 18], at_ease[18]) > 30.0  # elbow bend and pronation
    assert torch.equal(seen.relative[:, :, OTHERS], sequences(at_ease, 2).relative[:, :, OTHERS])


@pytest.mark.parametrize("size", [0.5, 1.0])
def test_sensors_agree_with_their_bones(size):
    poses = rotations_of(torch.randn(24, 3, generator=torch.Generator().manual_seed(1)))
    generator = torch.Generator().manual_seed(2)

    seen = straight_arms.with_straight_arms(sequences(poses, 40), size, generator)

    assert angle(seen.orientation[:, :, :2], seen.relative[:, :, [18, 19]]).max() < 0.1
    moved = angle(seen.relative[:, 0, 18], poses[18])
    assert 8 <= (moved < 0.05).sum() <= 32  # about half of the wearers stand at ease
    assert moved.max() < size * 45.0
    assert torch.equal(seen.acceleration, torch.zeros(40, 4, 6, 3))
