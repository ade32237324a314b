"""Sensors on clothing, and cheap chips, as training imitates them."""

import numpy as np
import pytest
import torch

from edgepose.calibration import GRAVITY
from edgepose.placements import PLACEMENTS, ROOT
from edgepose_export.networks.normalisation import rotations_of
from edgepose_export.synthesis import loose_wear as wear
from edgepose_export.synthesis.augmentation import Augmentation, augment
from edgepose_export.training.dataset import Batch

ALL = Augmentation(
    mirror=0.0, swing_deg=3.0, slip_deg=8.0, drift_deg=2.0, tilt_walk_deg=1.0, acceleration_bias=0.1
)
FRAMES = 240


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def batch(sequences: int = 60, frames: int = FRAMES) -> Batch:
    """Sensors that stand in random orientations and shake at 2 Hz, 6 m/s^2 rms."""
    orientation = rotations_of(torch.randn(sequences, 1, 6, 3, generator=generator(1))).expand(
        -1, frames, -1, -1, -1
    )
    axis = torch.nn.functional.normalize(torch.randn(sequences, 1, 6, 3, generator=generator(2)), dim=-1)
    wave = 6.0 * 2**0.5 * torch.sin(2 * torch.pi * 2.0 * torch.arange(frames) / 60.0)
    pose = torch.eye(3).expand(sequences, frames, 24, 3, 3)
    return Batch(orientation, axis * wave[:, None, None], pose, torch.zeros(sequences, frames, 10))


def turn_deg(before: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
    cosine = ((before.mT @ after).diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    return torch.rad2deg(torch.arccos(cosine.double().clamp(-1, 1)))


def ones(data: Batch) -> torch.Tensor:
    return torch.ones(len(data.orientation))


@pytest.mark.parametrize(
    "field", ["swing_deg", "slip_deg", "drift_deg", "tilt_walk_deg", "acceleration_bias"]
)
def test_each_disturbance_spares_the_truth_and_the_aligned(field: str) -> None:
    data = batch(400, 30)
    kept = [part.clone() for part in data]
    sizes = Augmentation(mirror=0.0, aligned=0.5, **{field: getattr(ALL, field)})
    got = augment(data, sizes, generator())
    assert got.relative is data.relative
    assert got.place is data.place
    assert all(torch.equal(a, b) for a, b in zip(data, kept, strict=True))
    torch.testing.assert_close(got.orientation @ got.orientation.mT, torch.eye(3).expand_as(got.orientation))
    moved = (got.orientation - data.orientation).abs().amax((1, 2, 3, 4))
    shaken = (got.acceleration - data.acceleration).abs().amax((1, 2, 3))
    untouched = (moved < 1e-6) & (shaken < 1e-5)
    assert 0.43 < untouched.float().mean() < (0.75 if field == "slip_deg" else 0.57)
    assert torch.isfinite(got.acceleration).all()
    assert (shaken[~untouched].max() == 0) == (field == "slip_deg")
    assert (moved.max() == 0) == (field == "acceleration_bias")


def test_a_walkers_sensors_swing_by_the_size_asked_for() -> None:
    data = batch()
    sizes = torch.full((60, 6), np.radians(2.0))
    angle, extra = wear.swing(data.orientation, data.acceleration, sizes, generator())
    rms = np.degrees(angle.square().sum(-1).mean().sqrt().item())
    # Shaking at 2 Hz is a little below the resonance; forces along the lever do not swing it.
    assert 1.6 < rms < 3.0
    # The sensor moves relative to the bone as a mass on the lever.
    travel = extra.square().sum(-1).mean().sqrt().item()
    assert (
        0.5 * wear.SWING_LEVER < travel / (np.radians(rms) * (2 * np.pi * 2.0) ** 2) < 3.0 * wear.SWING_LEVER
    )
    assert np.degrees(angle.norm(dim=-1).max().item()) < wear.SWING_LIMIT_DEG
    hard = wear.swing(data.orientation, 30 * data.acceleration, sizes, generator())[0]
    assert 14.0 < np.degrees(hard.norm(dim=-1).max().item()) <= wear.SWING_LIMIT_DEG + 1e-3


def test_a_sensor_swings_on_after_a_blow_and_comes_to_rest() -> None:
    data = batch()
    blow = torch.zeros_like(data.acceleration)
    blow[:, 60:63] = 40.0 * torch.tensor([1.0, 0.0, 0.0])
    angle, extra = wear.swing(data.orientation, blow, torch.full((60, 6), 0.05), generator())
    size = angle.norm(dim=-1).mean((0, 2))
    assert size[:60].max() < 0.03 * size.max()
    assert size[62:80].max() > 0.05
    assert size[180:].max() < 0.02 * size.max()
    assert torch.isfinite(extra).all()


def test_a_slow_push_leaves_the_sensor_behind() -> None:
    """A pendulum lags: it goes against the acceleration of the bone."""
    data = batch()
    push = torch.tensor([2.0, 0.0, 0.0]).expand_as(data.acceleration)
    angle = wear.swing(data.orientation, push, torch.full((60, 6), 0.05), generator())[0][:, 200]
    direction = torch.nn.functional.normalize(torch.randn(60, 1, 6, 3, generator=generator()), dim=-1)[:, 0]
    swung = (data.orientation[:, 0] @ torch.linalg.cross(angle, direction)[..., None])[..., 0]
    assert (swung[..., 0] < 1e-4).all()
    assert swung[..., 0].mean() < -0.005


def test_slips_are_large_along_the_segment_and_of_some_sensors() -> None:
    course = wear.slip(torch.full((2000, 6), np.radians(8.0)), FRAMES, generator())
    last = np.degrees(course[:, -1].numpy())
    slipped = np.abs(last).max(axis=-1) > 0
    assert slipped.mean() < wear.SLIPPING
    assert slipped.mean(axis=0).min() > 0.6 * wear.SLIPPING
    forearm, shank = PLACEMENTS.index("right_forearm"), PLACEMENTS.index("left_lower_leg")
    for sensor, axis in ((forearm, 0), (shank, 1), (ROOT, 1)):
        spread = last[slipped[:, sensor], sensor].std(axis=0)
        assert spread.argmax() == axis
        assert spread[axis] == pytest.approx(8.0, rel=0.15)
    change = np.degrees(np.linalg.norm(np.diff(course.numpy(), axis=1), axis=-1)) * 60
    assert change.max() > 100.0  # at once, within some frames
    assert np.median(change[change > 0]) < 20.0  # or slowly


def test_headings_drift_from_the_pelvis_and_some_of_them_far() -> None:
    data = batch(1500, 60)
    orientation, acceleration = wear.drifted(
        data.orientation, data.acceleration, 1.5, 0.0, ones(data), generator()
    )
    turn = orientation @ data.orientation.mT
    torch.testing.assert_close(turn[..., 1, :], torch.tensor([0.0, 1.0, 0.0]).expand_as(turn[..., 1, :]))
    torch.testing.assert_close(acceleration, (turn @ data.acceleration[..., None])[..., 0], rtol=0, atol=1e-4)
    error = turn_deg(data.orientation, orientation)
    assert error[:, :, ROOT].max() < 0.1
    first = error[:, 0, :ROOT].flatten()
    assert 1.0 < first.median() < 2.5
    assert 2.0 < first.quantile(0.95) / first.median() < 8.0
    assert first.max() <= wear.MOST_DRIFT_DEG + 0.1
    within = turn_deg(orientation[:, :1], orientation)[:, -1, :ROOT]
    assert 0.02 < within.mean() < 0.5


def test_gravity_leaks_into_accelerations_as_sensors_tilt() -> None:
    data = batch(800, 120)
    still = torch.zeros_like(data.acceleration)
    orientation, acceleration = wear.drifted(data.orientation, still, 0.0, 0.6, ones(data), generator())
    error = turn_deg(data.orientation, orientation)
    assert error[:, 0].square().mean().sqrt().item() == pytest.approx(0.6 * 2**0.5, rel=0.1)
    torch.testing.assert_close(
        acceleration.norm(dim=-1), GRAVITY * torch.deg2rad(error).float(), rtol=0.02, atol=0.02
    )
    # A true sensor's force is that of gravity, wherever it believes up to be.
    force = acceleration + torch.tensor([0.0, GRAVITY, 0.0])
    torch.testing.assert_close(force.norm(dim=-1), torch.full_like(force[..., 0], GRAVITY))
    moved = turn_deg(orientation[:, :1], orientation)[:, -1].square().mean().sqrt().item()
    assert moved == pytest.approx(0.6 * 2**0.5 * (2.0 / wear.TILT_S) ** 0.5, rel=0.15)


def test_biases_stay_with_the_sensor() -> None:
    data = batch(800, 120)
    bias = wear.biased(data.orientation, torch.zeros_like(data.acceleration), 0.1, ones(data), generator())
    own = (data.orientation.mT @ bias[..., None])[..., 0]
    assert own.std().item() == pytest.approx(0.1, rel=0.05)
    change = (own[:, -1] - own[:, 0]).std().item()
    assert change == pytest.approx(0.1 * (2.0 / 60.0) ** 0.5, rel=0.1)


def test_random_walks_spread_with_the_root_of_time() -> None:
    walk = wear.random_walk((3000, 4), 241, generator())
    assert walk.shape == (3000, 241, 4)
    assert (walk[:, 0] == 0).all()
    for frame, expected in ((60, 1.0), (120, 2**0.5), (240, 2.0)):
        assert walk[:, frame].std().item() == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_short_sequences(frames: int) -> None:
    got = augment(batch(8, frames), ALL, generator())
    assert got.orientation.shape == (8, frames, 6, 3, 3)
    assert all(torch.isfinite(part).all() for part in got)


def test_the_same_seed_gives_the_same_batch() -> None:
    first, again, other = (augment(batch(8), ALL, generator(seed)) for seed in (3, 3, 4))
    assert torch.equal(first.orientation, again.orientation)
    assert torch.equal(first.acceleration, again.acceleration)
    assert not torch.equal(first.acceleration, other.acceleration)
