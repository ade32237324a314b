"""Zero of actors and hinges, on real takes whose skeletons are disturbed by known constants."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edgepose import rotations as rot
from edgepose.placements import BONES
from edgepose_export.mocap import Motion, read_motion
from edgepose_export.mocap.hinges import Bends, hinge_rotations
from edgepose_export.mocap.straight_pose import straight_pose
from edgepose_export.mocap.zeroing import Evidence, find_zero
from edgepose_export.synthesis.virtual_imus import with_hold

MOCAP = Path(__file__).parents[1] / "data" / "mocap"
RATE = 60.0


def standing(seconds: float, pose: np.ndarray | None = None) -> Motion:
    """Return a motion of standing still."""
    pose = straight_pose() if pose is None else pose
    frames = round(seconds * RATE)
    return Motion(np.broadcast_to(pose, (frames, 24, 3, 3)).copy(), np.zeros((frames, 3)), RATE, "test")


def bending(upper: int, lower: int, axis: str, sign: float) -> Motion:
    """Return a motion from the zero pose in which one joint bends and stretches."""
    motion = standing(6.0, np.tile(np.eye(3), (24, 1, 1)))
    angle = sign * np.radians(45.0) * (1.0 - np.cos(np.arange(len(motion.rotations)) / RATE * 2.0))
    motion.rotations[:, lower] = motion.rotations[:, upper] @ rot.rotation_about_axis(axis, angle)
    return motion


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(rot.geodesic_angle(a, b))


@pytest.mark.parametrize(
    ("upper", "lower", "axis", "sign", "length"),
    [(16, 18, "y", -1.0, "x"), (17, 19, "y", 1.0, "x"), (1, 4, "x", 1.0, "y"), (2, 5, "x", 1.0, "y")],
)
@pytest.mark.parametrize("twist_deg", [0.0, 30.0, -75.0])
def test_a_skeleton_whose_upper_bones_are_twisted_gets_the_hinges_of_smpl(
    upper: int, lower: int, axis: str, sign: float, length: str, twist_deg: float
) -> None:
    motion = bending(upper, lower, axis, sign)
    true = motion.rotations.copy()
    motion.rotations[:, upper] @= rot.rotation_about_axis(length, np.radians(twist_deg))

    mended = motion.rotations @ hinge_rotations(Bends.of(motion))

    assert angles(mended, true).max() < 0.1


def test_a_joint_that_does_not_bend_or_not_as_a_hinge_keeps_its_frame() -> None:
    loose = bending(16, 18, "y", -1.0)
    turning = np.arange(len(loose.rotations)) / RATE
    loose.rotations[:, 16] = rot.rotation_about_axis("x", turning)  # bends about all axes in turn

    assert angles(hinge_rotations(Bends.of(standing(3.0))), np.eye(3)).max() == 0.0
    assert angles(hinge_rotations(Bends.of(loose))[16], np.eye(3)) == 0.0


def test_a_skeleton_with_another_zero_has_its_straight_pose_where_the_actor_stands() -> None:
    rng = np.random.default_rng(3)
    # The trunk's frames may be anything; limbs have true directions in all sources.
    wrong = np.tile(np.eye(3), (24, 1, 1))
    for joint in (0, 3, 6, 9, 12, 15):
        wrong[joint] = rot.rotation_about_axis("x", rng.normal(0.0, np.radians(10.0)))
    stands = standing(30.0)
    disturbed = stands._replace(rotations=stands.rotations @ wrong)

    zero = find_zero(Evidence.of(disturbed))

    assert zero.evidence == "standing"
    mended = disturbed.rotations[0] @ zero.straight
    assert angles(mended, straight_pose())[[0, 3, 6, 9, 12, 15]].max() < 1.0
    # Limbs lie between this posture and that of most people.
    assert angles(mended, straight_pose())[[1, 2, 4, 5, 16, 17]].max() < 5.0


def test_left_and_right_are_zeroed_alike() -> None:
    askew = straight_pose()
    askew[1] = rot.rotation_about_axis("y", np.radians(16.0)) @ askew[1]

    zero = find_zero(Evidence.of(standing(30.0, askew)))

    left, right = rot.matrix_to_rotvec(zero.straight[1]), rot.matrix_to_rotvec(zero.straight[2])
    np.testing.assert_allclose(left, right * [1.0, -1.0, -1.0], atol=1e-9)


def test_walking_is_zeroed_like_the_standing_that_it_starts_from() -> None:
    walk = read_motion(MOCAP / "dataset-2_walk_normal_001.bvh")

    one = Evidence.of(walk)  # of a short take; an actor walks longer
    walking = find_zero(one.plus(one).plus(one).plus(one))
    straight = walk._replace(rotations=walk.rotations @ walking.straight)
    standing_too = find_zero(Evidence.of(with_hold(straight, 20.0)))

    assert walking.evidence == "walking"
    assert standing_too.evidence == "standing"
    # What walking tells agrees with the straight pose that was put before the walk.
    trunk = [0, 3, 6, 9, 12, 15]
    assert angles(standing_too.straight, np.eye(3))[trunk].max() < 4.0
    measured = rot.matrix_to_rotvec(walking.straight[list(BONES)])
    assert np.degrees(np.abs(measured)).max() < 45.0


def test_directions_keep_the_limbs_where_they_were() -> None:
    walk = read_motion(MOCAP / "07_01.bvh")

    zero = find_zero(Evidence.of(walk))

    moved = walk.rotations @ zero.directions
    for limb, axis in ((1, 1), (4, 1), (16, 0), (18, 0)):
        np.testing.assert_allclose(moved[:, limb, :, axis], walk.rotations[:, limb, :, axis], atol=1e-9)


def test_an_actor_who_never_stands_or_walks_is_marked() -> None:
    bow = standing(10.0)
    bow.rotations[:] = rot.rotation_about_axis("x", np.radians(70.0)) @ bow.rotations

    zero = find_zero(Evidence.of(bow))

    assert zero.evidence == "none"
    assert angles(zero.straight, np.eye(3))[[0, 3, 6, 9, 12, 15]].max() < 1e-9


def test_takes_of_one_actor_share_a_zero() -> None:
    walk = read_motion(MOCAP / "dataset-2_walk_normal_001.bvh")
    middle = len(walk.rotations) // 2
    halves = [
        walk._replace(rotations=walk.rotations[part], translation=walk.translation[part])
        for part in (slice(middle), slice(middle, None))
    ]

    both = find_zero(Evidence.of(halves[0]).plus(Evidence.of(halves[1])))

    assert angles(both.straight, find_zero(Evidence.of(walk)).straight).max() < 1.0


def test_one_frame_is_no_evidence() -> None:
    walk = read_motion(MOCAP / "07_01.bvh")
    one = walk._replace(rotations=walk.rotations[:1], translation=walk.translation[:1])

    assert find_zero(Evidence.of(one)).evidence == "none"
