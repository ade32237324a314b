"""Rests made in captured motion."""

from pathlib import Path

import numpy as np
import pytest

from edgepose import rotations as rot
from edgepose.skeleton import default_body, forward_kinematics, local_from_global
from edgepose_export.mocap import Motion, read_motion, resample
from edgepose_export.synthesis.rests import LENGTH_S, REST_S, with_rests
from edgepose_export.synthesis.virtual_imus import virtual_imus

CLIP = Path(__file__).parents[2] / "tools" / "data" / "09_12.bvh"
BODY = default_body(1.8)


@pytest.fixture(scope="module")
def captured() -> Motion:
    return resample(read_motion(CLIP))


def crouching(captured: Motion) -> Motion:
    """Six seconds: standing, down to a squat and up again, with the arms of a captured take."""
    frames = 360
    depth = np.sin(np.pi * np.arange(frames) / (frames - 1)) ** 2
    rotations = captured.rotations[np.zeros(frames, int)].copy()
    rotations[:, :] = np.eye(3)
    rotations[:, 16:] = captured.rotations[0, 16:]
    for thigh, shank, foot in ((1, 4, 7), (2, 5, 8)):
        rotations[:, thigh] = rot.rotation_about_axis("x", -np.radians(100.0) * depth)
        rotations[:, shank] = rot.rotation_about_axis("x", np.radians(40.0) * depth)
        rotations[:, foot] = np.eye(3)
    joints = forward_kinematics(local_from_global(rotations), BODY.offsets)[1]
    translation = np.zeros((frames, 3))
    translation[:, 1] = -joints[:, 7, 1]
    return captured._replace(rotations=rotations, translation=translation)


def positions(motion: Motion) -> np.ndarray:
    return forward_kinematics(local_from_global(motion.rotations), BODY.offsets, motion.translation)[1]


def rests(motion: Motion) -> np.ndarray:
    """Frames (T - 1,) in which the body moves by less than 6 cm/s."""
    speed = np.diff(positions(motion), axis=0) * motion.rate
    return np.sqrt(np.square(speed).sum(-1).mean(-1)) < 0.06


def runs(still: np.ndarray) -> np.ndarray:
    """Lengths of the runs of true values."""
    edges = np.flatnonzero(np.diff(np.r_[False, still, False].astype(int)))
    return edges[1::2] - edges[::2]


@pytest.mark.parametrize("seed", range(4))
def test_the_wearer_rests_and_goes_on(captured: Motion, seed: int) -> None:
    take = with_rests(captured, BODY, np.random.default_rng(seed))
    assert LENGTH_S[0] * 60 - 1 <= len(take.rotations) <= LENGTH_S[1] * 60 + 1
    assert np.allclose(take.rotations @ rot.transpose(take.rotations), np.eye(3), atol=1e-9)
    assert np.allclose(np.linalg.det(take.rotations), 1.0)
    still = rests(take)
    assert 0.3 < still.mean() < 0.95
    long = runs(still) / 60
    long = long[long > 0.3]
    assert len(long) >= 2
    assert long.max() < REST_S[1] + 1.5
    assert (long[1:-1] > REST_S[0] - 0.8).sum() >= 0.7 * len(long[1:-1])


def test_a_rest_has_a_sway_that_is_small_and_slow(captured: Motion) -> None:
    take = with_rests(captured, BODY, np.random.default_rng(1))
    still = rests(take)
    turns = np.degrees(rot.geodesic_angle(take.rotations[1:], take.rotations[:-1]))[still] * 60
    assert 0.1 < np.median(turns[:, 15]) < 5.0  # the head is never quite still
    assert turns[:, [1, 2, 4, 5]].mean() < turns[:, [16, 17, 18, 19]].mean()
    starts = np.flatnonzero(np.diff(np.r_[False, still].astype(int)) == 1)
    ends = starts + runs(still)
    longest = np.argmax(ends - starts)
    rest = take.rotations[starts[longest] + 20 : ends[longest] - 20]
    spread = np.degrees(rot.geodesic_angle(rest, rest[len(rest) // 2]))
    assert 0.3 < spread[:, 15].max() < 12.0
    assert spread[:, 0].max() < 4.0
    feet = positions(take)[starts[longest] + 20 : ends[longest] - 20, [7, 8]]
    assert np.ptp(feet, axis=0).max() < 0.05


def test_nothing_jerks(captured: Motion) -> None:
    """Slowing down and going on are as smooth as the captured motion."""
    before = np.linalg.norm(virtual_imus(captured, BODY).force, axis=-1).max(axis=0)
    for seed in range(4):
        take = with_rests(captured, BODY, np.random.default_rng(seed))
        force = np.linalg.norm(virtual_imus(take, BODY).force, axis=-1).max(axis=0)
        assert (force < 1.25 * before + 3.0).all()


def test_rests_are_where_the_body_is_low(captured: Motion) -> None:
    motion = crouching(captured)
    limit = 0.7 * motion.translation[0, 1]
    low, rises = [], []
    for seed in range(12):
        take = with_rests(motion, BODY, np.random.default_rng(seed))
        down = take.translation[1:, 1] < limit
        low.append(down[rests(take)].mean())
        rises.append((np.diff(down.astype(int)) == -1).sum())
    # Captured, the body is lower for 40 % of the time, and never at rest there.
    assert 0.35 < (motion.translation[:, 1] < limit).mean() < 0.45
    assert 0.45 < np.mean(low) < 0.8
    assert np.mean(rises) > 1.5


def test_takes_go_on_forwards_and_backwards(captured: Motion) -> None:
    frames = len(captured.rotations)
    straight = np.stack([np.zeros(frames), captured.translation[:, 1], np.arange(frames) / 60.0], axis=1)
    motion = captured._replace(translation=straight)  # 1 m/s along Z
    takes = [with_rests(motion, BODY, np.random.default_rng(seed)) for seed in range(4)]
    speed = np.concatenate([np.diff(take.translation[:, 2]) * 60.0 for take in takes])
    assert (speed > 0.8).mean() > 0.05
    assert (speed < -0.8).mean() > 0.05
    assert np.abs(speed).max() < 1.2


def test_a_seed_gives_the_same_take_again(captured: Motion) -> None:
    first, second, other = (with_rests(captured, BODY, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert np.array_equal(first.rotations, second.rotations)
    assert len(first.rotations) != len(other.rotations)


@pytest.mark.parametrize("frames", [1, 2, 20])
def test_a_short_take_is_long_enough(captured: Motion, frames: int) -> None:
    short = captured._replace(
        rotations=captured.rotations[:frames], translation=captured.translation[:frames]
    )
    take = with_rests(short, BODY, np.random.default_rng(0))
    assert len(take.rotations) >= 20 * 60
    assert np.isfinite(take.rotations).all()
    assert np.isfinite(take.translation).all()
