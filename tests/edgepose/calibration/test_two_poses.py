"""Straight pose, then T-pose: the raised arms show forward."""

from __future__ import annotations

import numpy as np
import pytest

from edgepose import calibration as cal
from edgepose import rotations as rot
from edgepose.calibration.heading_reset import HeadingReset
from edgepose.errors import CalibrationError
from edgepose.placements import PLACEMENTS

FACING_DEG = 70.0
R_TI = cal.body_from_inertial(np.tile([1.0, 0, 0, 0], (6, 1)), f"heading:{FACING_DEG}")
R_BS = rot.rotvec_to_matrix(np.random.default_rng(3).normal(0.0, 1.0, (6, 3)))


def worn(pose: str, forearms: np.ndarray | None = None, headings: np.ndarray | float = 0.0) -> np.ndarray:
    """Quaternions (6, 4) of sensors in a pose; rotations (2, 3, 3) in T apply to the forearms."""
    bones = cal.POSES[pose].copy()
    if forearms is not None:
        bones[:2] = forearms @ bones[:2]
    quats = rot.matrix_to_quat(R_TI.T @ bones @ R_BS)
    return rot.quat_multiply(rot.quat_about_z(np.broadcast_to(headings, 6)), quats)


def about(axis: str, *angles_deg: float) -> np.ndarray:
    return np.stack([rot.rotation_about_axis(axis, np.radians(angle)) for angle in angles_deg])


def test_the_arms_show_forward_whatever_their_twist():
    twisted = about("x", 30.0, -25.0)
    arms = cal.forward_of_raised_arms(worn("straight"), worn("t-pose", twisted))
    angle_deg, error_deg = cal.facing_deg(arms, np.zeros(6))
    assert angle_deg == pytest.approx(FACING_DEG)
    assert error_deg == pytest.approx(0.0, abs=1e-6)
    forwards = about("y", -20.0, 20.0)  # both hands are 20 deg in front of the shoulders
    angle_deg, error_deg = cal.facing_deg(
        cal.forward_of_raised_arms(worn("straight"), worn("t-pose", forwards)), np.zeros(6)
    )
    assert (angle_deg, error_deg) == (pytest.approx(FACING_DEG), pytest.approx(20.0))


@pytest.mark.parametrize(
    ("t_pose", "text"),
    [
        (worn("straight"), "not raised level to the sides: left_forearm by 0 deg, right_forearm by 0 deg"),
        (worn("t-pose", about("z", 0.0, 40.0)), "not raised level to the sides: right_forearm by 50 deg"),
        (
            rot.quat_multiply(rot.matrix_to_quat(rot.rotation_about_axis("x", 0.4)), worn("t-pose")),
            "not standing as before the T-pose: left_lower_leg",
        ),
    ],
)
def test_another_pose_is_refused(t_pose, text):
    with pytest.raises(CalibrationError, match=text):
        cal.forward_of_raised_arms(worn("straight"), t_pose)


def test_sensors_without_a_north_are_found_out():
    headings = np.radians([50.0, -40.0, 0, 0, 0, 0])
    arms = cal.forward_of_raised_arms(worn("straight", None, headings), worn("t-pose", None, headings))
    with pytest.raises(CalibrationError, match=r"90 deg from pointing in opposite .* --heading-reset steps"):
        cal.facing_deg(arms, np.zeros(6))
    # With a heading reset, they improve its forearms.
    true = -headings - np.radians(FACING_DEG)
    found = HeadingReset(true + np.radians([8.0, -8.0, 1.0, 1.0, 1.0, 1.0]), np.full(6, 8.0))
    better = cal.with_raised_arms(found, arms)
    left = np.degrees(np.angle(np.exp(1j * (better.offset - true))))
    assert left == pytest.approx([4.0, -4.0, 1.0, 1.0, 1.0, 1.0])
    assert better.error_deg[:3] == pytest.approx([8.0 / 2**0.5, 8.0 / 2**0.5, 8.0])
    with pytest.raises(
        CalibrationError, match=r"contradict the heading reset: left_forearm .40 deg.; stretch"
    ):
        cal.with_raised_arms(found._replace(offset=true + np.radians([40.0, 0, 0, 0, 0, 0])), arms)


def test_bone_offsets_are_those_of_both_poses():
    hold = cal.HoldSummary([100] * 6, worn("straight"), np.zeros(6), np.zeros((6, 3)), [])
    made = cal.calibrate(hold, pose="straight", body_frame=f"heading:{FACING_DEG}", created="")
    better, warnings = cal.with_t_pose(made, worn("t-pose", about("x", 30.0, 10.0)))
    wanted = rot.matrix_to_quat(about("x", 15.0, 5.0) @ R_BS[:2])
    apart = np.degrees(rot.geodesic_angle(*map(rot.quat_to_matrix, (better.bone_from_sensor[:2], wanted))))
    assert apart.max() < 1e-3
    assert warnings == [
        "straight pose and T-pose differ by 30 deg at left_forearm: turn the palms down in the T-pose"
    ]
    with pytest.raises(CalibrationError, match=r"contradict each other: right_forearm .90 deg."):
        cal.with_t_pose(made, worn("t-pose", about("x", 0.0, 90.0)))


def test_a_t_pose_after_a_clock_that_jumped_by_years_is_found():
    times = np.concatenate([np.arange(300) / 60.0, 1.7e9 + np.arange(300) / 60.0])
    quats = np.stack([worn("straight")] * 330 + [worn("t-pose")] * 270)
    unknown = np.full((len(times), 3), np.nan)
    everything = [
        cal.SensorHold(times, quats[:, i], unknown, unknown, name) for i, name in enumerate(PLACEMENTS)
    ]
    start_s = cal.t_pose_start(everything, worn("straight"), after_s=3.0, seconds=3.0)
    assert start_s == pytest.approx(1.7e9 + 0.5, abs=0.11)
