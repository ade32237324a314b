"""Kneeling and sitting on the ground made on captured upper bodies."""

from pathlib import Path

import numpy as np
import pytest

from edgepose import rotations as rot
from edgepose.skeleton import default_body, forward_kinematics, local_from_global
from edgepose_export.mocap import Motion, read_motion, resample
from edgepose_export.synthesis.floor import LENGTH_S, on_the_floor
from edgepose_export.synthesis.virtual_imus import virtual_imus

WALK = Path(__file__).parents[1] / "data" / "mocap" / "dataset-2_walk_normal_001.bvh"
BODY = default_body(1.8)
THIGH, SHANK = np.linalg.norm(BODY.offsets[[4, 7]], axis=1)


@pytest.fixture(scope="module")
def takes() -> list[Motion]:
    upper = resample(read_motion(WALK))
    return [on_the_floor(upper, BODY, np.random.default_rng(seed)) for seed in (1, 5, 10, 12)]


def positions(motion: Motion) -> np.ndarray:
    return forward_kinematics(local_from_global(motion.rotations), BODY.offsets, motion.translation)[1]


def test_takes_are_long_and_hold_rotations(takes: list[Motion]) -> None:
    for take in takes:
        assert LENGTH_S[0] * 60 - 1 <= len(take.rotations) <= LENGTH_S[1] * 60 + 1
        assert np.allclose(take.rotations @ rot.transpose(take.rotations), np.eye(3), atol=1e-9)
        assert np.allclose(np.linalg.det(take.rotations), 1.0)


def test_wearers_stand_kneel_on_one_and_both_knees_and_sit_on_heels_and_ground(takes: list[Motion]) -> None:
    joints = np.concatenate([positions(take) for take in takes])
    knees = joints[:, [4, 5], 1] < 0.15 * THIGH
    height = joints[:, [1, 2], 1].mean(axis=1)
    shares = {
        "standing": (height > 0.95 * (THIGH + SHANK)).mean(),
        "one knee": (knees.sum(axis=1) == 1).mean(),
        "both knees": (knees.all(axis=1) & (height > 0.85 * THIGH)).mean(),
        "heels": (knees.all(axis=1) & (np.abs(height - 0.4 * THIGH) < 0.2 * THIGH)).mean(),
        "ground": (height < 0.15 * THIGH).mean(),
    }
    assert all(share > 0.01 for share in shares.values()), shares


def test_the_body_stays_together_and_above_the_floor(takes: list[Motion]) -> None:
    for take in takes:
        joints = positions(take)
        # Hips, knees and ankles; a standing foot's ankle is at height 0, some 7 cm above the floor.
        assert joints[:, [1, 2, 4, 5, 7, 8], 1].min() > -0.08
        assert joints[..., 1].min() > -0.25  # hands and toes do not feel the floor
        knees = rot.matrix_to_rotvec(local_from_global(take.rotations)[:, [4, 5]])
        assert (knees[..., 0] > -1e-6).all()  # forwards only
        assert np.degrees(knees[..., 0].max()) < 165.0
        assert np.abs(np.diff(joints[:, [7, 8]], axis=0)).max() * 60 < 2.5


def test_nothing_jerks(takes: list[Motion]) -> None:
    legs = [0, 1, 2, 4, 5]
    for take in takes:
        turns = rot.geodesic_angle(take.rotations[1:, legs], take.rotations[:-1, legs]) * 60
        assert turns.max() < 8.0
        force = virtual_imus(take, BODY).force[:, [2, 3, 5]]
        assert np.linalg.norm(force, axis=-1).max() < 40.0


def test_a_seed_gives_the_same_take_again(takes: list[Motion]) -> None:
    again = on_the_floor(resample(read_motion(WALK)), BODY, np.random.default_rng(5))
    assert np.array_equal(again.rotations, takes[1].rotations)
    assert len(takes[0].rotations) != len(takes[1].rotations)
