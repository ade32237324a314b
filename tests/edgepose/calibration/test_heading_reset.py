"""Headings of sensors without a north: from mounting, an axis, motion, and the pose held again."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edgepose import calibration as cal
from edgepose import rotations as rot
from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.registry import read_recording
from edgepose.placements import BONES, PLACEMENTS
from edgepose_export.synthesis.heading_routine import ASIDE_DEG, exercises
from edgepose_export.synthesis.virtual_imus import INERTIAL_FROM_BODY, random_mounting, straight_pose

WALK = Path(__file__).parents[2] / "data" / "imu" / "six-sites-walk.npz"
RATE = 50.0
seeds = st.integers(0, 2**32 - 1)
UPRIGHT = cal.POSES["straight"]
MOUNTING = [
    *("x up, z left", "x up, z right", "x down, z forward"),
    *("x up, z forward", "x left, z back", "x up, z back"),
]
MAP = dict(zip(PLACEMENTS, MOUNTING, strict=True))


def wrapped_deg(angle: np.ndarray) -> np.ndarray:
    return np.degrees(np.angle(np.exp(1j * angle)))


def quats(bones: np.ndarray, mounting: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """What sensors say whose inertial frames are turned by yaw (6,) against one where the wearer faces X."""
    true = rot.matrix_to_quat(INERTIAL_FROM_BODY @ bones @ mounting)
    return rot.quat_multiply(rot.quat_about_z(yaw), true)


def hold_of(orientation: np.ndarray) -> list[cal.SensorHold]:
    """Six sensors from orientations (T, 6, 4)."""
    time_s = np.arange(len(orientation)) / RATE
    empty = np.full((len(time_s), 3), math.nan)
    return [
        cal.SensorHold(time_s, orientation[:, i], empty, empty, name) for i, name in enumerate(PLACEMENTS)
    ]


def exercised(bones: np.ndarray, mounting: np.ndarray, yaw: np.ndarray) -> cal.HeadingReset:
    """Headings from the motion of bones (T, 24, 3, 3)."""
    moving = hold_of(quats(bones[:, list(BONES)], mounting, yaw))
    return cal.headings_from_motion(moving, quats(UPRIGHT, mounting, yaw))


# --- mounting -----------------------------------------------------------------------------------------------


def sits(words: str) -> np.ndarray:
    """R_TS (3, 3), written out."""
    directions = {
        "left": [1, 0, 0], "right": [-1, 0, 0], "up": [0, 1, 0],
        "down": [0, -1, 0], "forward": [0, 0, 1], "back": [0, 0, -1],
    }  # fmt: skip
    x, z = (np.array(directions[part.split()[1]], float) for part in words.split(", "))
    return np.stack([x, np.cross(z, x), z], axis=-1)


def measured(words: list[str], yaw: np.ndarray, slack_deg: float = 0.0, seed: int = 0) -> np.ndarray:
    """Quaternions (6, 4) of sensors that sit as words say, or up to `slack_deg` off."""
    slack = np.random.default_rng(seed).normal(size=(6, 3))
    slack *= math.radians(slack_deg) / np.linalg.norm(slack, axis=-1, keepdims=True)
    r_ts = rot.rotvec_to_matrix(slack) @ np.stack([sits(w) for w in words])
    return rot.quat_multiply(rot.quat_about_z(yaw), rot.matrix_to_quat(INERTIAL_FROM_BODY @ r_ts))


def calibration_of(orientation: np.ndarray, offset: np.ndarray) -> cal.Calibration:
    summary = cal.HoldSummary([100] * 6, orientation, np.zeros(6), np.zeros((6, 3)), [])
    return cal.calibrate(summary, pose="straight", body_frame="heading:0", created="", heading_offset=offset)


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_a_known_mounting_gives_every_heading(seed: int) -> None:
    yaw = np.random.default_rng(seed).uniform(-math.pi, math.pi, 6)
    found = cal.headings_from_mounting(measured(MOUNTING, yaw), MOUNTING)
    np.testing.assert_allclose(wrapped_deg(found.offset + yaw), 0.0, atol=1e-6)
    np.testing.assert_allclose(found.error_deg, 0.0, atol=1e-5)


def test_a_mounting_that_gravity_denies_is_refused() -> None:
    turned = [*MOUNTING[:4], MOUNTING[4], "x back, z up"]
    with pytest.raises(
        EdgeposeError, match=r"^not mounted as the sensor map says, judged by gravity: pelvis \(90 deg\);"
    ):
        cal.headings_from_mounting(measured(turned, np.zeros(6)), MOUNTING)


@pytest.mark.parametrize("axis", ["z", "+z", "-x", "y"])
def test_an_axis_that_faces_forward_gives_every_heading(axis: str) -> None:
    rng = np.random.default_rng(5)
    yaw = rng.uniform(-math.pi, math.pi, 6)
    # The named axis along Z of T, then anything about it, and 10 degrees of slope.
    unit = np.eye(3)["xyz".index(axis[-1])] * (-1.0 if axis[0] == "-" else 1.0)
    along = rot.minimal_rotation(unit + 1e-6, [0.0, 0.0, 1.0])
    r_ts = (
        rot.rotation_about_axis("x", math.radians(10))
        @ rot.rotation_about_axis("z", rng.uniform(0, 6, 6))
        @ along
    )
    orientation = rot.quat_multiply(rot.quat_about_z(yaw), rot.matrix_to_quat(INERTIAL_FROM_BODY @ r_ts))
    found = cal.headings_from_axis(orientation, axis)
    np.testing.assert_allclose(wrapped_deg(found.offset + yaw), 0.0, atol=1e-3)
    np.testing.assert_allclose(found.error_deg, 10.0, atol=1e-3)


def test_a_steep_axis_gives_no_heading() -> None:
    with pytest.raises(EdgeposeError, match=r"^axis x does not face forward: left_forearm \(90 deg\), "):
        cal.headings_from_axis(measured(MOUNTING, np.zeros(6)), "x")


def test_a_sensor_on_as_said_gives_no_warning_however_it_slipped() -> None:
    for seed in range(20):
        orientation = measured(MOUNTING, np.zeros(6), slack_deg=40.0, seed=seed)
        assert cal.mounting_warnings(calibration_of(orientation, np.zeros(6)), MAP, "rig.toml") == []


def test_swapped_sensors_and_one_upside_down_are_told() -> None:
    worn = [MOUNTING[1], MOUNTING[0], *MOUNTING[2:5], "x down, z back"]
    warnings = cal.mounting_warnings(
        calibration_of(measured(worn, np.zeros(6), slack_deg=20.0), np.zeros(6)), MAP, "rig.toml"
    )
    assert len(warnings) == 2
    assert warnings[0].startswith(
        "left_forearm and right_forearm look swapped: each is mounted as rig.toml says"
    )
    assert warnings[1] == (
        "pelvis is mounted x down, z back (upside down), but rig.toml says x up, z back; "
        "check that no two sensors are swapped and that it is the right way round"
    )
    nothing_said = MAP | {"left_forearm": None, "right_forearm": None, "pelvis": None}
    assert (
        cal.mounting_warnings(calibration_of(measured(worn, np.zeros(6)), np.zeros(6)), nothing_said, "")
        == []
    )


# --- motion -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_exercises_give_every_heading(seed: int) -> None:
    yaw = np.random.default_rng(seed).uniform(-math.pi, math.pi, 6)
    found = exercised(exercises(RATE), random_mounting(seed), yaw)
    # Forearms rise to the side by as much as they do.
    np.testing.assert_allclose(wrapped_deg(found.offset + yaw), [-ASIDE_DEG, ASIDE_DEG, 0, 0, 0, 0], atol=0.1)
    assert (found.error_deg < 1.0).all()
    assert found.warnings == []


@pytest.mark.parametrize(
    ("order", "told"),
    [
        ([1, 0, 2, 3, 4, 5], ["left_forearm", "right_forearm"]),
        ([0, 1, 3, 2, 4, 5], ["left_lower_leg", "right_lower_leg"]),
        ([2, 1, 0, 3, 4, 5], ["left_forearm", "left_lower_leg"]),
    ],
)
def test_swapped_sensors_move_at_the_wrong_time(order: list[int], told: list[str]) -> None:
    bones = exercises(RATE)
    swapped = np.array(BONES)[order]
    yaw, mounting = np.arange(6.0), random_mounting(3)
    upright = quats(straight_pose()[swapped], mounting, yaw)
    found = cal.headings_from_motion(hold_of(quats(bones[:, swapped], mounting, yaw)), upright)
    assert len(found.warnings) == 2
    for warning, place in zip(found.warnings, told, strict=True):
        assert f"moved when {place} should" in warning


def real_walk() -> tuple[list[cal.SensorHold], np.ndarray]:
    everything = cal.hold_from_recording(read_recording(WALK))
    return cal.trim(everything, 99, 110), cal.check_hold(cal.trim(everything, 40, 42)).orientation


@pytest.mark.parametrize("seed", range(4))
def test_a_real_walk_gives_headings_though_not_finely(seed: int) -> None:
    """The recording's own headings were brought together by other means; here each sensor loses its own."""
    moving, upright = real_walk()
    yaw = np.random.default_rng(seed).uniform(-math.pi, math.pi, 6)
    turned = [
        s._replace(quat=rot.quat_multiply(rot.quat_about_z(y), s.quat))
        for s, y in zip(moving, yaw, strict=True)
    ]
    found = cal.headings_from_motion(turned, rot.quat_multiply(rot.quat_about_z(yaw), upright))
    error = np.abs(wrapped_deg(found.offset + yaw))
    assert (error < [14.0, 16.0, 6.0, 10.0, 9.0, 6.0]).all(), error
    # What it says of itself is of the size of what it does.
    assert (error < 2.5 * found.error_deg).all()
    assert found.warnings == []


def test_motion_that_shows_no_heading_is_refused_and_names_the_sensor() -> None:
    mounting, yaw = random_mounting(1), np.zeros(6)
    still = np.tile(straight_pose(), (200, 1, 1, 1))
    with pytest.raises(EdgeposeError, match=r"left_forearm leaned by only 0 deg, .*; face one way, bow"):
        exercised(still, mounting, yaw)
    bones = exercises(RATE)
    head = BONES[PLACEMENTS.index("head")]
    t = np.arange(len(bones)) / RATE
    nodding = bones.copy()
    nodding[:, head] = rot.rotation_about_axis("x", 0.5 * np.sin(5.0 * t)) @ straight_pose()[head]
    with pytest.raises(EdgeposeError, match="this motion: head leaned forward as much as back;"):
        exercised(nodding, mounting, yaw)
    circling = bones.copy()
    cone = np.stack([0.6 * np.cos(3 * t), 0 * t, 0.6 * np.sin(3 * t)], axis=-1)
    circling[:, head] = rot.rotvec_to_matrix(cone) @ straight_pose()[head]
    with pytest.raises(EdgeposeError, match=r"this motion: head leaned in all directions \(4\d deg\);"):
        exercised(circling, mounting, yaw)


# --- the pose held again ------------------------------------------------------------------------------------


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_the_pose_held_again_gives_every_heading(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mounting, yaw, later = random_mounting(seed), *rng.uniform(-math.pi, math.pi, (2, 6))
    calibration = calibration_of(quats(UPRIGHT, mounting, yaw), -yaw)
    found = cal.headings_from_pose(calibration, quats(UPRIGHT, mounting, later))
    np.testing.assert_allclose(wrapped_deg(found.offset + later), 0.0, atol=1e-5)
    np.testing.assert_allclose(found.error_deg, 0.0, atol=1e-4)
