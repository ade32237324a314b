"""The tracker of a wearer's place, on motions whose paths are known, and on input that no wearer makes."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from edgepose.place import PlaceTracker
from edgepose.place.tracker import GAP_S
from edgepose.place.velocity import FASTEST
from edgepose.rotations import rotation_about_axis, rotvec_to_matrix
from edgepose.skeleton import default_body, grounded_pelvis_position
from tests.edgepose.place.walks import BODY, RATE, follow, motion, relative, walk

HIP = abs(BODY.offsets[1][0])
FEET = np.array([[HIP, 0.0, 0.0], [-HIP, 0.0, 0.0]])
STRAIGHT = np.tile(np.eye(3), (24, 1, 1))
ON_FEET = np.array([1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], np.float32)


def standing(frames, pelvis_m=0.86):
    """A body that stands, with its pelvis at heights (T,) or one height."""
    pelvis = np.zeros((frames, 3))
    pelvis[:, 1] = pelvis_m
    return motion(pelvis, np.repeat(FEET[None], frames, 0), np.ones((frames, 2)))


def ramp(start, end, frames):
    """A smooth way from one number to another."""
    return start + (end - start) * (0.5 - 0.5 * np.cos(np.pi * np.arange(frames) / (frames - 1)))


# --- walking ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("along", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0.6, 0, 0.8)], ids=str)
def test_a_walk_ends_where_it_ends_on_level_ground(along):
    moved = walk(along=along)
    error = relative(follow(moved)) - relative(moved.pelvis)
    assert np.linalg.norm(error, axis=1).max() < 0.015 * moved.pelvis[-1] @ along
    assert abs(error[:, 1]).max() < 0.001


def test_a_run_keeps_its_speed_in_the_air():
    """Each foot stands for 0.2 s, then nothing touches the ground for 0.1 s."""
    frames, speed = 240, 3.0
    t = np.arange(frames) / RATE
    pelvis = np.stack([0 * t, 0.83 + 0 * t, speed * t], axis=1)
    step = np.floor(t / 0.3)
    phase = t - 0.3 * step
    soles, planted = np.zeros((frames, 2, 3)), np.zeros((frames, 2))
    for side in (0, 1):
        stands = (step % 2 == side) & (phase < 0.2)
        soles[:, side] = [FEET[side][0], 0.25, 0.0]
        soles[:, side, 2] = pelvis[:, 2] - 0.2
        soles[stands, side, 1:] = np.stack([0 * t, 0.9 * step + 0.3], axis=1)[stands]
        planted[:, side] = stands
    moved = motion(pelvis, soles, planted)
    moved.place[:, 7:] *= 0.8  # networks are too slow for runners
    path = follow(moved)
    assert abs(path[-1, 2] - path[0, 2] - pelvis[-1, 2]) < 0.05 * pelvis[-1, 2]
    assert abs(path[:, 1] - 0.83).max() < 0.08


def test_a_turn_in_place_moves_nobody():
    frames = 240
    heading = ramp(0.0, math.pi, frames)
    pelvis = np.tile([0.0, 0.86, 0.0], (frames, 1))
    # The feet turn one after the other.
    steps = np.floor(np.arange(frames) / 20.0)
    own = np.stack([heading[(steps - (steps + side) % 2).clip(0).astype(int) * 20] for side in (0, 1)], 1)
    soles = np.stack([(rotation_about_axis("y", own[:, side]) @ FEET[side]) for side in (0, 1)], axis=1)
    planted = np.stack([(steps + side) % 2 for side in (0, 1)], axis=1)
    path = follow(motion(pelvis, soles, planted, heading))
    assert np.linalg.norm((path - path[0])[:, [0, 2]], axis=1).max() < 0.2
    assert abs(path[:, 1] - 0.86).max() < 0.005


def test_a_body_that_is_scaled_wrongly_costs_its_part_of_the_distance():
    moved = walk()
    tall = follow(moved, PlaceTracker(default_body(1.1 * BODY.height_m)))
    way = (tall - tall[0])[-1, 2] / (moved.pelvis[-1] - moved.pelvis[0])[2]
    assert way == pytest.approx(1.1, abs=0.02)
    assert np.ptp(tall[:, 1]) < 0.01


def test_a_path_does_not_depend_on_the_rate_of_frames():
    moved = walk()
    assert np.linalg.norm(follow(moved)[-1] - follow(moved, every=3)[-1]) < 0.08


def test_without_contacts_the_lower_foot_stands():
    moved = walk()
    path = relative(follow(moved, place=False))
    assert path[-1, 2] == pytest.approx(moved.pelvis[-1, 2], rel=0.1)
    assert abs(path[:, 1] - moved.pelvis[:, 1]).max() < 0.01


# --- heights ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("climb", [0.17, 0.2, -0.17, -0.13])
def test_stairs_are_climbed_and_descended(climb):
    moved = walk(climb=climb)
    error = relative(follow(moved)) - relative(moved.pelvis)
    assert abs(error[:, 1]).max() < 0.05
    assert np.linalg.norm(error[-1]) < 0.05


def test_who_comes_back_from_stairs_is_on_the_floor_again():
    up, down = walk(climb=0.17), walk(climb=-0.17)
    tracker = PlaceTracker(BODY)
    top = follow(up, tracker)[-1]
    later = down._replace(time_s=down.time_s + up.time_s[-1] + 1.0 / RATE)
    assert top[1] > 2.5
    assert follow(later, tracker)[-1, 1] == pytest.approx(0.86, abs=0.02)


@pytest.mark.parametrize("error", [0.03, -0.03])
def test_errors_of_poses_are_no_steps(error):
    """One leg seems to be longer than the other."""
    moved = walk(steps=20)
    short = walk(steps=20)
    short.pelvis[:, 1] += error * moved.place[:, 0]
    soles = np.zeros((len(moved.poses), 2, 3))
    soles[:, :, 2] = moved.pelvis[:, None, 2] + [0.1, -0.1]
    soles[:, :, 0] = FEET[:, 0]
    path = follow(motion(short.pelvis, soles, moved.place[:, :2]))
    assert abs(path[-1, 1] - path[0, 1]) < abs(error) + 0.001


@pytest.mark.parametrize(("height_m", "climb", "stairs"), [(2.4, 0.085, False), (0.9, 0.12, True)])
def test_the_least_step_grows_with_the_body(height_m, climb, stairs):
    """Errors of poses grow with it, so a wrong height of the wearer changes nothing but sizes."""
    path = follow(walk(climb=climb), PlaceTracker(default_body(height_m)))
    assert bool(path[-1, 1] - path[0, 1] > 0.2) == stairs


def test_a_jump_ends_on_the_ground_it_began_on():
    fly = 24
    t = np.arange(fly) / RATE
    speed = 9.81 * fly / RATE / 2.0
    push = 0.7 + 0.5 * speed**2 / 0.32 * (np.arange(10) / RATE) ** 2  # from 0.7 to 0.86 m, up to that speed
    air = 0.86 + speed * t - 0.5 * 9.81 * t * t
    pelvis = np.concatenate([ramp(0.86, 0.7, 32), push, air, push[::-1], ramp(0.7, 0.86, 40)])
    moved = standing(len(pelvis))
    moved.pelvis[:, 1] = pelvis
    soles = np.repeat(FEET[None], len(pelvis), 0)
    flight = slice(42, 42 + fly)
    soles[flight, :, 1] = (air - 0.86)[:, None]
    planted = np.ones((len(pelvis), 2))
    planted[flight] = 0.0
    path = follow(motion(moved.pelvis, soles, planted))
    assert path[flight, 1].max() > 0.95
    assert path[-1, 1] == pytest.approx(0.86, abs=0.005)
    assert np.linalg.norm((path - path[0])[-1]) < 0.02


def test_who_sits_down_is_on_a_seat_with_feet_on_the_floor():
    heights = np.concatenate([ramp(0.86, 0.5, 90), np.full(120, 0.5), ramp(0.5, 0.86, 90)])
    pelvis = np.zeros((len(heights), 3))
    pelvis[:, 1], pelvis[:, 2] = heights, 0.35 * (heights - 0.86)
    moved = motion(pelvis, np.repeat(FEET[None], len(heights), 0), np.ones((len(heights), 2)))
    moved.place[100:200, 4] = 0.9
    path = follow(moved)
    assert np.linalg.norm(relative(path) - relative(moved.pelvis), axis=1).max() < 0.01


def test_who_lies_down_lies_on_the_ground():
    standing_up = standing(30)
    lying = np.tile(STRAIGHT, (120, 1, 1, 1))
    lying[:, 0] = rotation_about_axis("x", np.linspace(0.0, -math.pi / 2.0, 120))
    tracker = PlaceTracker(BODY)
    follow(standing_up, tracker)
    on_back = np.zeros(10, np.float32)
    for i, pose in enumerate([*lying, *[lying[-1]] * 60]):
        place = tracker.update((31 + i) / RATE, pose, on_back)
    assert 0.0 < place.translation[1] < 0.25


def test_who_rolls_over_on_the_floor_stays_on_it():
    """Arms, held out, lift the body, and a network takes feet in the air for planted."""
    tracker = PlaceTracker(BODY)
    follow(standing(30), tracker)
    down = rotation_about_axis("x", np.linspace(0.0, -math.pi / 2.0, 90))
    rolls = rotation_about_axis("z", ramp(0.0, 6.0 * math.pi, 720)) @ down[-1]
    still = np.repeat(rolls[-1:], 60, 0)
    for i, pelvis in enumerate([*down, *rolls, *still]):
        planted = 0.8 if i < 60 or i % 30 < 15 else 0.2
        place = np.array([planted, planted, 0.0, 0.0, 0.9, 0.0, 0.0, 0.0, 0.0, 0.0], np.float32)
        pose = np.concatenate([pelvis[None], STRAIGHT[1:]])
        height = tracker.update((31 + i) / RATE, pose, place).translation[1]
    assert 0.05 < height < 0.25


# --- standing -----------------------------------------------------------------------------------------------


def test_who_stands_for_ten_minutes_stays():
    """Poses sway and tremble, and the network's velocity is biased."""
    rng, rate, frames = np.random.default_rng(5), 20, 12_000
    poses = rotvec_to_matrix(rng.normal(0.0, 0.001, (100, 24, 3)))  # one period of the sway
    poses[:, 0] = rotation_about_axis("x", np.radians(0.4) * np.sin(2.0 * np.pi * np.arange(100) / 100))
    place = np.array([0.98, 0.98, 0.98, 0.98, 0, 0, 0, 0.02, 0.01, -0.03], np.float32)
    tracker = PlaceTracker(BODY)
    path = np.array([tracker.update(i / rate, poses[i % 100], place).translation for i in range(frames)])
    before, after = path[100:300].mean(0), path[-200:].mean(0)
    assert np.linalg.norm(after - before) < 0.005
    assert np.ptp(path[100:], axis=0).max() < 0.02


# --- surprises ----------------------------------------------------------------------------------------------


def test_the_first_frame_and_a_reset_put_the_wearer_above_the_origin():
    tracker = PlaceTracker(BODY)
    path = follow(walk(), tracker)
    assert path[0].tolist() == [0.0, pytest.approx(0.86, abs=1e-6), 0.0]
    tracker.reset()
    start = tracker.update(1e9, STRAIGHT, ON_FEET)
    np.testing.assert_allclose(
        start.translation, grounded_pelvis_position(STRAIGHT, BODY.offsets), atol=1e-12
    )
    assert start.contacts.tolist() == [1, 1, 1, 1, 0, 0, 0]
    assert tracker.update(1e9 + 0.01, STRAIGHT, None).contacts is None


def test_wearers_do_not_share_anything():
    together = PlaceTracker(BODY), PlaceTracker(BODY)
    one, two = walk(), walk(along=(1, 0, 0))
    rows = zip(one.time_s.tolist(), one.poses, one.place, two.poses, two.place, strict=True)
    paths = [
        (together[0].update(t, a, b).translation, together[1].update(t, c, d).translation)
        for t, a, b, c, d in rows
    ]
    np.testing.assert_array_equal([path[0] for path in paths], follow(one))
    np.testing.assert_array_equal([path[1] for path in paths], follow(two))


@pytest.mark.parametrize("gap_s", [0.5, 60.0, -5.0])
def test_a_gap_does_not_move_the_wearer(gap_s):
    moved = walk()
    half = len(moved.poses) // 2
    time_s = moved.time_s + gap_s * (np.arange(len(moved.poses)) >= half)
    path = follow(moved._replace(time_s=time_s))
    assert path[half, [0, 2]].tolist() == path[half - 1, [0, 2]].tolist()
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 0.05
    whole = relative(follow(moved))
    assert np.linalg.norm((path[-1] - path[half]) - (whole[-1] - whole[half])) < 0.1


@pytest.mark.parametrize("gap_s", [5.0, -5.0])
def test_who_rises_or_sits_down_in_a_gap_keeps_the_feet_on_the_floor(gap_s):
    sitting, risen = standing(60, 0.5), standing(120)
    tracker = PlaceTracker(BODY)
    assert follow(sitting, tracker)[-1, 1] == pytest.approx(0.5, abs=0.001)
    later = [each._replace(time_s=each.time_s + 1.0 + gap_s * k) for k, each in ((1, risen), (2, sitting))]
    assert follow(later[0], tracker)[-1, 1] == pytest.approx(0.86, abs=0.001)
    assert follow(later[1], tracker)[-1, 1] == pytest.approx(0.5, abs=0.001)


def test_a_pose_that_jumps_costs_less_than_a_step():
    """As when a lost sensor comes back."""
    moved = walk()
    poses = moved.poses.copy()
    poses[200:260] = poses[200:260] @ rotvec_to_matrix(np.random.default_rng(1).normal(0.0, 1.0, (24, 3)))
    path = follow(moved._replace(poses=poses))
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 0.3
    assert np.linalg.norm((relative(path) - relative(moved.pelvis))[-1]) < 0.7


def test_a_wearer_upside_down_stays_above_the_ground():
    poses = np.tile(STRAIGHT, (120, 1, 1, 1))
    poses[60:, 0] = np.diag([1.0, -1.0, -1.0])
    tracker = PlaceTracker(BODY)
    path = np.array([tracker.update(i / RATE, pose, ON_FEET).translation for i, pose in enumerate(poses)])
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 0.3
    assert 0.0 < path[-1, 1] < 2.0


def test_in_a_lift_and_on_a_bicycle_nothing_explodes():
    lift = standing(600)
    lift.place[:, 8] = 2.0
    assert np.ptp(follow(lift), axis=0).max() < 0.05
    ride = standing(600, 0.7)
    ride.place[:, :4], ride.place[:, 4], ride.place[:, 9] = 0.1, 0.95, 0.3
    path = follow(ride)
    assert np.linalg.norm(path[-1] - path[0]) < 3.5


numbers = st.floats(width=32)
rotation = st.integers(0, 99).map(
    lambda seed: rotvec_to_matrix(np.random.default_rng(seed).normal(0.0, seed % 4, (24, 3)))
)
place = st.none() | arrays(np.float32, 10, elements=numbers)
time_step = st.floats(0.001, 2.0) | st.sampled_from([0.0, -1.0, 1e-9, 1e9, math.nan, math.inf])


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(time_step, rotation, place), min_size=1, max_size=12))
def test_no_input_makes_the_wearer_leave_or_vanish(frames):
    tracker, time_s = PlaceTracker(BODY), 0.0
    before = tracker.update(time_s, STRAIGHT, ON_FEET).translation
    for step, pose, numbers in frames:
        result = tracker.update(time_s + step, pose, numbers)
        assert np.isfinite(result.translation).all()
        assert result.contacts is None or np.isfinite(result.contacts).all()
        moved = result.translation - before
        passed_s = time_s + step - time_s  # a short step may be lost in rounding
        if 0.0 < passed_s <= GAP_S:
            assert np.linalg.norm(moved) <= (FASTEST + 9.0) * passed_s + 1e-9
        else:  # only the lowest part of the body may have changed
            assert np.hypot(moved[0], moved[2]) == 0.0
            assert abs(moved[1]) < BODY.height_m
        before = result.translation
        if math.isfinite(step):
            time_s += step


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 23), st.sampled_from([math.nan, math.inf, 1e200]))
def test_rotations_that_are_not_finite_leave_the_wearer_in_place(joint, number):
    pose = STRAIGHT.copy()
    pose[joint] = number
    stays_in_place(pose)


def test_matrices_whose_products_are_not_finite_leave_the_wearer_in_place():
    stays_in_place(STRAIGHT * 1e60)


def stays_in_place(pose: np.ndarray) -> None:
    tracker = PlaceTracker(BODY)
    tracker.update(0.0, STRAIGHT, ON_FEET)
    tracker.update(1.0 / RATE, pose, ON_FEET)
    assert np.isfinite(tracker.update(2.0 / RATE, STRAIGHT, ON_FEET).translation).all()
