import numpy as np
import pytest

from edgepose import rotations as rot
from edgepose.pipeline.dropout import extrapolate_dropouts
from edgepose.placements import PLACEMENTS, ROOT


@pytest.fixture
def walk():
    """A body (30, 6, 3, 3) that turns as one, and accelerations (30, 6, 3)."""
    random = np.random.default_rng(3)
    bones = rot.rotvec_to_matrix(random.normal(size=(6, 3)))
    turns = rot.rotation_about_axis("y", np.linspace(0.0, 2.0, 30))[:, None]
    return turns @ bones, random.normal(size=(30, 6, 3))


def through(orientation, acceleration, held):
    result, before = [], None
    for frame in zip(orientation, acceleration, held, strict=True):
        before, a = extrapolate_dropouts(*frame, before)
        result.append((before, a))
    return [np.stack(column) for column in zip(*result, strict=True)]


def test_a_silent_bone_turns_with_the_pelvis(walk):
    true, acceleration = walk
    measured, held = true.copy(), np.zeros((30, 6), bool)
    head, arm = PLACEMENTS.index("head"), PLACEMENTS.index("left_forearm")
    for sensor, start in ((head, 10), (arm, 20)):
        measured[start:, sensor], held[start:, sensor] = measured[start, sensor], True
    given = measured.copy()
    orientation, a = through(measured, acceleration, held)
    np.testing.assert_allclose(orientation, true, atol=1e-12)
    np.testing.assert_array_equal(a[held], np.repeat(acceleration[:, ROOT : ROOT + 1], 6, 1)[held])
    np.testing.assert_array_equal(a[~held], acceleration[~held])
    np.testing.assert_array_equal(measured, given)  # the frames themselves are not changed


def test_a_silent_lower_leg_stays_upright_when_the_wearer_bends(walk):
    _, acceleration = walk
    bend = rot.rotation_about_axis("x", np.interp(np.arange(30), [10, 20], [0.0, 1.5]))
    turn = rot.rotation_about_axis("y", np.interp(np.arange(30), [20, 29], [0.0, 2.0]))
    measured = np.repeat((turn @ bend)[:, None], 6, axis=1)
    leg, arm = PLACEMENTS.index("right_lower_leg"), PLACEMENTS.index("right_forearm")
    held = np.zeros((30, 6), bool)
    held[5:, [leg, arm]] = True
    measured[5:, [leg, arm]] = np.eye(3)
    orientation, _ = through(measured, acceleration, held)
    np.testing.assert_allclose(orientation[:, leg], turn, atol=1e-12)
    np.testing.assert_allclose(orientation[:, arm], turn @ bend, atol=1e-12)


def test_headings_do_not_drift_with_a_pelvis_that_circles(walk):
    _, acceleration = walk
    around = np.linspace(0.0, 6.0 * np.pi, 30)
    lean = rot.rotvec_to_matrix(0.3 * np.stack([np.cos(around), 0.0 * around, np.sin(around)], axis=-1))
    measured = np.repeat(lean[:, None], 6, axis=1)
    for silent in (PLACEMENTS.index("left_lower_leg"), ROOT):
        held = np.zeros((30, 6), bool)
        held[5:, silent] = True
        orientation, _ = through(np.where(held[..., None, None], measured[4], measured), acceleration, held)
        np.testing.assert_allclose(orientation[5:, silent], np.stack([measured[4, silent]] * 25), atol=1e-12)


def test_what_measures_again_counts_at_once(walk):
    true, acceleration = walk
    held = np.zeros((30, 6), bool)
    held[5:15, 0] = True
    measured = true.copy()
    measured[15:, 0] = measured[15:, 0] @ rot.rotation_about_axis("x", 1.0)  # it bent meanwhile
    orientation, _ = through(measured, acceleration, held)
    np.testing.assert_array_equal(orientation[15:], measured[15:])


def test_a_silent_pelvis_turns_with_the_lower_legs(walk):
    true, acceleration = walk
    held = np.zeros((30, 6), bool)
    held[5:, [0, ROOT]] = True  # the arm goes on with the pelvis that goes on with the legs
    held[20:, PLACEMENTS.index("left_lower_leg")] = True
    measured = np.where(held[..., None, None], true[4], true)
    orientation, a = through(measured, acceleration, held)
    np.testing.assert_allclose(orientation, true, atol=1e-12)
    assert not a[5:, [0, ROOT]].any()


def test_without_pelvis_and_legs_nothing_moves(walk):
    true, acceleration = walk
    held = np.zeros((30, 6), bool)
    held[5:, [2, 3, ROOT]] = True
    measured = np.where(held[..., None, None], true[4], true)
    orientation, _ = through(measured, acceleration, held)
    np.testing.assert_allclose(orientation, measured, atol=1e-12)
