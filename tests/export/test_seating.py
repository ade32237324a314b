"""Sitting made on captured upper bodies."""

from pathlib import Path

import numpy as np
import pytest

from edgepose import rotations as rot
from edgepose.skeleton import default_body, forward_kinematics, local_from_global
from edgepose_export.mocap import Motion, read_motion, resample
from edgepose_export.synthesis.sitting import seated
from edgepose_export.synthesis.virtual_imus import virtual_imus

CLIP = Path(__file__).parents[2] / "tools" / "data" / "09_12.bvh"
BODY = default_body(1.8)


@pytest.fixture(scope="module")
def upper() -> Motion:
    return resample(read_motion(CLIP))


def positions(motion: Motion) -> np.ndarray:
    return forward_kinematics(local_from_global(motion.rotations), BODY.offsets, motion.translation)[1]


def thigh_deg(motion: Motion) -> np.ndarray:
    """Inclination (T, 2) of both thighs, 90 when they are level."""
    return np.degrees(np.arccos(motion.rotations[:, [1, 2], 1, 1]))


@pytest.mark.parametrize("seed", range(6))
def test_the_wearer_sits_and_stands_on_feet_that_stay_where_they_are(upper: Motion, seed: int) -> None:
    take = seated(upper, BODY, np.random.default_rng(seed))
    assert 25 * 60 - 1 <= len(take.rotations) <= 50 * 60 + 1
    assert np.allclose(take.rotations @ rot.transpose(take.rotations), np.eye(3), atol=1e-9)
    assert np.allclose(np.linalg.det(take.rotations), 1.0)
    thighs = thigh_deg(take)
    standing, low = (thighs < 25).all(axis=1), (thighs > 55).all(axis=1)
    assert standing.mean() > 0.05
    assert low.mean() > 0.2
    assert thighs.max() < 125
    place = positions(take)
    # The bones reach from the pelvis to the floor in every frame.
    assert np.abs(place[:, [7, 8], 1]).max() < 0.02
    assert np.abs(np.diff(place[:, [7, 8]], axis=0)).max() * 60 < 0.8
    # The pelvis is higher standing than sitting by about a thigh.
    fall = np.median(place[standing, 0, 1]) - np.median(place[low, 0, 1])
    assert 0.2 < fall < 0.6


def test_nothing_jerks(upper: Motion) -> None:
    take = seated(upper, BODY, np.random.default_rng(7))
    legs = [0, 1, 2, 4, 5]
    turns = rot.geodesic_angle(take.rotations[1:, legs], take.rotations[:-1, legs]) * 60
    assert turns.max() < 6.0
    force = virtual_imus(take, BODY).force[:, [2, 3, 5]]
    assert np.linalg.norm(force, axis=-1).max() < 30.0


def test_knees_bend_forwards_only(upper: Motion) -> None:
    take = seated(upper, BODY, np.random.default_rng(3))
    knees = local_from_global(take.rotations)[:, [4, 5]]
    assert (rot.matrix_to_rotvec(knees)[..., 0] > -1e-6).all()


def test_a_seat_tilts_the_pelvis_back(upper: Motion) -> None:
    tilts = []
    for seed in range(8):
        take = seated(upper, BODY, np.random.default_rng(seed))
        still = np.r_[False, (np.abs(np.diff(take.translation[:, 1])) * 60 < 0.02)]
        low = (np.abs(thigh_deg(take) - 88) < 15).all(axis=1) & still
        tilts += np.degrees(np.arcsin(take.rotations[low, 0, 2, 1])).tolist()  # forwards positive
    assert -30 < np.median(tilts) < -10


def test_a_seed_gives_the_same_take_again(upper: Motion) -> None:
    first, second, other = (seated(upper, BODY, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert np.array_equal(first.rotations, second.rotations)
    assert len(first.rotations) != len(other.rotations)


def test_a_single_frame_is_an_upper_body_too(upper: Motion) -> None:
    frame = upper._replace(rotations=upper.rotations[:1], translation=upper.translation[:1])
    assert np.isfinite(seated(frame, BODY, np.random.default_rng(0)).rotations).all()
