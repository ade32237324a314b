"""Contacts and velocities of bodies that move in known ways, and of captured ones."""

from pathlib import Path

import numpy as np
import pytest
import torch

from edgepose.pose import CONTACTS
from edgepose.rotations import rotation_about_axis
from edgepose.skeleton import JOINTS, PARENTS, default_body, forward_kinematics, local_from_global
from edgepose_export.mocap import read_motion, resample
from edgepose_export.networks.normalisation import turn_about_y
from edgepose_export.synthesis import sitting
from edgepose_export.synthesis.contacts import contacts, level_velocity
from edgepose_export.synthesis.virtual_imus import straight_pose, virtual_imus

CLIP = Path(__file__).parents[2] / "tools" / "data" / "09_12.bvh"
BODY = default_body()
RATE = 60.0
LEGS = {"left": [4, 7, 10], "right": [5, 8, 11]}


def ankles_toes_pelvis_wrists(got):
    """Shares of frames with contact, by kind of joint."""
    return [float(got[:, part].mean()) for part in (slice(0, 2), slice(2, 4), 4, slice(5, 7))]


def posed(frames=30, floor=0.3, **degrees):
    """Positions (T, 24, 3) of a body at rest, its lowest joint at a height.

    Keywords: global rotations about X, degrees, of joints and all below them in the tree; the straight pose
    otherwise.
    """
    rotations = straight_pose()
    for name, angle in degrees.items():
        for joint in [JOINTS.index(name), *below(JOINTS.index(name))]:
            rotations[joint] = rotation_about_axis("x", np.radians(angle)) @ straight_pose()[joint]
    joints = forward_kinematics(local_from_global(rotations), BODY.offsets)[1]
    joints[:, 1] += floor - joints[:, 1].min()
    return np.tile(joints, (frames, 1, 1))


def below(joint):
    children = [i for i, parent in enumerate(PARENTS) if parent == joint]
    return children + [more for child in children for more in below(child)]


@pytest.mark.parametrize(
    ("degrees", "expected"),
    [
        ({}, [1, 1, 0, 0]),  # standing
        ({"left_ankle": 40.0, "right_ankle": 40.0, "left_foot": 10.0, "right_foot": 10.0}, [0, 1, 0, 0]),
        # Hands and knees; the feet lie on the floor with their toes.
        (
            {"pelvis": 90.0, "left_hip": 0.0, "right_hip": 0.0, "left_knee": 90.0, "right_knee": 90.0}
            | {"left_collar": 0.0, "right_collar": 0.0},
            [0, 1, 0, 1],
        ),
        # Lying on the back, the thin arms beside the thick trunk; sitting on the floor, the hands beside.
        ({"pelvis": -90.0}, [1, 0, 1, 0]),
        ({"left_hip": -90.0, "right_hip": -90.0}, [1, 0, 1, 1]),
        # On a seat, and crouching with the centre of mass above the feet.
        ({"left_hip": -88.0, "right_hip": -88.0, "left_knee": 0.0, "right_knee": 0.0}, [1, 1, 1, 0]),
        (
            {"pelvis": 30.0, "left_hip": -60.0, "right_hip": -60.0}
            | {"left_knee": 32.0, "right_knee": 32.0, "left_ankle": 0.0, "right_ankle": 0.0},
            [1, 1, 0, 0],
        ),
    ],
    ids=["standing", "tiptoe", "hands-and-knees", "lying", "floor", "seat", "squat"],
)
def test_postures_at_rest(degrees, expected):
    got = contacts(posed(**degrees), RATE)
    assert got.dtype == np.uint8
    assert got.shape == (30, len(CONTACTS))
    assert ankles_toes_pelvis_wrists(got) == expected


def test_a_lifted_foot_is_not_in_contact():
    got = contacts(posed(left_hip=-40.0, left_knee=10.0), RATE)
    assert got.mean(axis=0).tolist() == [0, 1, 0, 1, 0, 0, 0]


@pytest.mark.parametrize("rate", [30.0, 60.0, 120.0])
@pytest.mark.parametrize("height", [0.08, 0.4])
def test_a_jump_has_no_contact_in_the_air(rate, height):
    """A rigid body that is thrown up and lands."""
    flight = 2.0 * np.sqrt(2.0 * height / 9.81)
    t = np.arange(round(2.0 * rate)) / rate - 0.7
    rise = np.where((t > 0) & (t < flight), 0.5 * 9.81 * t * (flight - t), 0.0)
    joints = posed(len(t)) + rise[:, None, None] * np.array([0.0, 1.0, 0.0])
    feet = contacts(joints, rate)[:, :4]
    in_air = (t > 0.02) & (t < flight - 0.02)
    away = (t < -0.08) | (t > flight + 0.08)
    assert not feet[in_air].any()
    assert feet[away].all()


def stepping(height, length=0.5, period=0.6, steps=7):
    """Positions of a body that climbs stairs, and whether each foot stands (T, 2).

    Only the legs below the knees step; the rest of the body glides along, without their bobbing.
    """
    frames = round(period * RATE)
    joints = posed((steps + 1) * frames)
    standing = np.ones((len(joints), 2), bool)
    travelled, raised = np.zeros((2, len(joints), 2, 3))
    for step in range(steps):
        foot, rows = step % 2, slice(step * frames, (step + 1) * frames)
        t = np.arange(frames) / frames
        share = t**3 * (10.0 - 15.0 * t + 6.0 * t * t)
        stride = 2.0 if 0 < step < steps - 1 else 1.0
        move = np.array([0.0, height, length]) * stride
        travelled[rows, foot] += share[:, None] * move
        raised[rows, foot, 1] = (abs(move[1]) + 0.1) * np.sin(np.pi * t) ** 2
        travelled[rows.stop :, foot] += move
        standing[rows, foot] = False
    for foot, leg in enumerate(LEGS.values()):
        joints[:, leg] += (travelled + raised)[:, foot, None]
    others = sorted(set(range(24)).difference(*LEGS.values()))
    joints[:, others] += travelled.mean(axis=1)[:, None]
    return joints, standing


@pytest.mark.parametrize("height", [0.0, 0.17, -0.17, 0.06])
def test_feet_stand_on_stairs_and_slopes(height):
    """The ground rises or falls with each step; nothing says where it is."""
    joints, standing = stepping(height)
    got = contacts(joints, RATE).astype(bool)
    for foot in range(2):
        for joint in (foot, foot + 2):
            assert (got[:, joint] == standing[:, foot]).mean() > 0.8
            assert got[standing[:, foot], joint].mean() > 0.95
    assert not got[:, 4:].any()


def test_a_foot_that_stays_is_in_contact_while_its_ground_rises():
    """The joints of a foot on its side are lower than those of one that stands; it may stay all the while."""
    t = np.arange(300) / RATE
    joints = posed(300)
    joints[..., 1] += np.clip(0.05 * (t - 1.0), 0.0, 0.12)[:, None]
    assert contacts(joints, RATE)[:, :4].all()


def test_neither_the_height_of_the_floor_nor_the_size_of_the_wearer_matters():
    joints, _ = stepping(0.17)
    expected = contacts(joints, RATE)
    assert np.array_equal(contacts(joints + np.array([3.0, -7.5, 2.0]), RATE), expected)
    assert (contacts(joints * 0.8, RATE) == expected).mean() > 0.97


def test_synthetic_sitting_is_on_a_seat_with_the_feet_on_the_floor():
    upper = resample(read_motion(CLIP))
    for seed in range(2):
        motion = sitting.seated(upper, BODY, np.random.default_rng(seed))
        got = contacts(virtual_imus(motion, BODY).joints, RATE)
        rng = np.random.default_rng(seed)
        course, _ = sitting._course(round(rng.uniform(*sitting.LENGTH_S) * RATE), RATE, rng)
        thigh = np.degrees(course[:, 0])
        still = np.r_[False, np.diff(thigh) == 0.0]
        seat = still & (thigh > 75.0)
        assert seat.mean() > 0.3
        assert got[seat, 4].mean() > 0.99
        assert not got[thigh < 70.0, 4].any()
        assert got[:, :4].mean() > 0.97
        assert not got[:, 5:].any()


def test_a_captured_walk_has_the_phases_of_walking():
    motion = resample(read_motion(CLIP), 120.0)
    got = contacts(virtual_imus(motion, BODY).joints, 120.0).astype(bool)
    left, right = got[:, 0] | got[:, 2], got[:, 1] | got[:, 3]
    for stance in (left, right):
        assert 0.5 < stance.mean() < 0.68
    assert 0.1 < (left & right).mean() < 0.3
    assert (left | right).mean() > 0.99
    assert not got[:, 4:].any()
    # Heels rise before toes.
    assert got[:, :2].mean() < got[:, 2:4].mean()
    slower = contacts(virtual_imus(resample(motion, 60.0), BODY).joints, 60.0)
    assert (slower == got[::2][: len(slower)]).mean() > 0.98


def test_velocity_is_that_in_the_level_frame_of_the_pelvis():
    """A wearer walks a circle of 2 m with 1 m/s and leans forwards, then climbs."""
    t = np.arange(300) / RATE
    heading = t / 2.0
    lean = rotation_about_axis("x", np.full(300, 0.4))
    pelvis = rotation_about_axis("y", heading) @ lean
    translation = np.stack([-2.0 * np.cos(heading), 0.3 * t, 2.0 * np.sin(heading)], axis=1)
    velocity = level_velocity(translation, pelvis, RATE)
    np.testing.assert_allclose(velocity[1:-1], np.tile([0.0, 0.3, 1.0], (298, 1)), atol=1e-3)
    sideways = level_velocity(translation, pelvis @ rotation_about_axis("y", np.full(300, 0.5)), RATE)
    tilted = torch.from_numpy(rotation_about_axis("x", 0.4) @ rotation_about_axis("y", 0.5))
    angle = float(turn_about_y(tilted))
    np.testing.assert_allclose(sideways[1:-1, 2], np.cos(angle), atol=1e-3)
    np.testing.assert_allclose(sideways[1:-1, 0], -np.sin(angle), atol=1e-3)
