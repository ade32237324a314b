"""The ground under a path that drifts: level, with steps, without stances."""

from itertools import pairwise

import numpy as np
import pytest

from edgepose.sip.ground import grounded

RATE = 60.0


def walk(grounds, drift, pelvis=0.9):
    """A walker's stances of 0.4 s on alternate feet on grounds of these heights, with a path that drifts.

    Returns the true height of the pelvis, the drifting one, the ankles' heights in it, and who stands.
    """
    ramps = [np.linspace(a, b, 12) for a, b in pairwise([*grounds, grounds[-1]])]
    ground = np.concatenate(
        [part for g, r in zip(grounds, ramps, strict=True) for part in (np.full(24, g), r)]
    )
    frames = len(ground)
    true = pelvis + ground + 0.02 * np.sin(np.arange(frames) / 6.0)
    path = true + drift * np.arange(frames) / RATE
    standing = np.zeros((frames - 1, 2))
    heights = np.full((frames, 2), 0.3)
    for k, height in enumerate(grounds):
        rows = slice(36 * k, 36 * k + 24)
        standing[rows, k % 2] = 1.0
        heights[rows, k % 2] = height
    return true, path, heights + (path - true)[:, None], standing


def acceleration(height):
    result = np.full(len(height), np.nan)
    result[1:-1] = np.diff(height, 2) * RATE**2
    return result


@pytest.mark.parametrize("drift", [-0.08, 0.0, 0.05])
def test_level_ground_stays_level(drift):
    true, path, heights, standing = walk([0.0] * 166, drift)  # 100 s
    assert abs(path[-1] - true[-1]) == pytest.approx(abs(drift) * 100.0, rel=0.01)
    found = grounded(path, heights, acceleration(true), standing, RATE)
    assert np.abs(found - true).max() < 0.02


@pytest.mark.parametrize("stairs", [[0.17 * k for k in range(9)], [0.2, 0.2, 0.0, 0.0, -0.2]])
def test_steps_are_climbed(stairs):
    grounds = [0.0] * 6 + stairs + [stairs[-1]] * 6
    true, path, heights, standing = walk(grounds, -0.01)
    found = grounded(path, heights, acceleration(true), standing, RATE)
    assert np.abs(found - true).max() < 0.07


def test_a_jump_and_a_biased_acceleration():
    true, path, heights, standing = walk([0.0] * 20, 0.05)
    flight = slice(36 * 10, 36 * 12)  # more than a second without a foot on the ground
    standing[flight] = 0.0
    found = grounded(path, heights, acceleration(true) + 0.1, standing, RATE)
    outside = np.r_[0 : flight.start, flight.stop : len(true)]
    assert np.abs(found - true)[outside].max() < 0.03
    assert np.abs(found - true)[flight].max() < 0.06


def test_without_stances_the_path_stays():
    path = np.linspace(0.0, 1.0, 50)
    unknown = np.full(50, np.nan)
    np.testing.assert_array_equal(grounded(path, np.zeros((50, 2)), unknown, np.zeros((49, 2)), RATE), path)


def test_guessed_stances_climb_no_steps():
    true, path, heights, standing = walk([0.0] * 6 + [0.3] * 6, 0.0)
    found = grounded(path, heights, acceleration(true), standing, RATE, steps=False)
    assert np.abs(found[-24:] - 0.9).max() < 0.1
