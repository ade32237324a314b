"""Calibration against synthetic rigs whose true bones are known, hostile files, and a real wearer."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edgepose import calibration as cal
from edgepose import rotations as rot
from edgepose.calibration.checks import detect_alternating_devices
from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.registry import read_recording
from edgepose.imu import ImuSample
from edgepose.placements import PLACEMENTS, ROOT

DATA = Path(__file__).parents[2] / "data" / "imu"
CREATED = "2026-01-02T03:04:05+00:00"
LEFT, HEAD, PELVIS = PLACEMENTS.index("left_forearm"), PLACEMENTS.index("head"), PLACEMENTS.index("pelvis")
seeds = st.integers(0, 2**32 - 1)


def random_quats(rng: np.random.Generator, *shape: int) -> np.ndarray:
    q = rng.standard_normal((*shape, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def still(
    quat: np.ndarray, n: int = 100, rate: float = 100.0, acc: np.ndarray | None = None, name: str = "pelvis"
) -> cal.SensorHold:
    """A sensor at rest: quaternion (4,) sensor to inertial, true specific force."""
    quats = np.tile(quat, (n, 1))
    acc = rot.quat_rotate(rot.quat_conjugate(quats), [0, 0, 9.81]) if acc is None else np.tile(acc, (n, 1))
    return cal.SensorHold(np.arange(n) / rate, quats, acc, np.zeros((n, 3)), name)


def rig_at_rest(quats: np.ndarray) -> list[cal.SensorHold]:
    return [still(q, name=name) for q, name in zip(quats, PLACEMENTS, strict=True)]


def moved(hold: list[cal.SensorHold], sensor: int, quat: np.ndarray) -> list[cal.SensorHold]:
    """The hold with other orientations (n, 4) of one sensor, its accelerometer true to them."""
    acc = rot.quat_rotate(rot.quat_conjugate(quat), [0, 0, 9.81])
    return [s._replace(quat=quat, acc=acc) if i == sensor else s for i, s in enumerate(hold)]


def turns_about_x(angles: np.ndarray) -> np.ndarray:
    return rot.rotvec_to_quat(np.stack([angles, 0 * angles, 0 * angles], axis=-1))


class Rig:
    """A wearer who faces anywhere, six sensors mounted anyhow, each with a heading error of its own."""

    def __init__(self, seed: int, headings: bool = True) -> None:
        self.rng = np.random.default_rng(seed)
        self.facing = self.rng.uniform(-math.pi, math.pi)
        ahead = np.array([math.cos(self.facing), math.sin(self.facing), 0.0])
        up = np.array([0.0, 0.0, 1.0])
        self.r_ti = np.stack([np.cross(up, ahead), up, ahead])
        self.r_bs = rot.quat_to_matrix(random_quats(self.rng, 6))
        self.error = self.rng.uniform(-math.pi, math.pi, 6) if headings else np.zeros(6)
        # The pelvis sensor's frame is the reference: its own error only turns what "facing" means.
        self.error[ROOT] = 0.0

    def measured(self, r_tb: np.ndarray) -> np.ndarray:
        """Quaternions (..., 6, 4) that the sensors report with their bones at r_tb (..., 6, 3, 3)."""
        true = self.r_ti.T @ r_tb @ self.r_bs
        return rot.quat_multiply(rot.quat_about_z(-self.error), rot.matrix_to_quat(true))

    def lying(self) -> list[cal.SensorHold]:
        """All six side by side in one orientation."""
        return rig_at_rest(rot.quat_multiply(rot.quat_about_z(-self.error), random_quats(self.rng)))

    def force(self, a_t: np.ndarray) -> np.ndarray:
        """Specific force in each sensor's own inertial frame for accelerations (..., 6, 3) in T."""
        true = a_t @ self.r_ti + np.array([0, 0, 9.81])
        return rot.quat_rotate(rot.quat_about_z(-self.error), true)

    def calibration(self, pose: str = "straight", **changes: Any) -> cal.Calibration:
        summary = cal.check_hold(rig_at_rest(self.measured(cal.POSES[pose])))
        offset = cal.headings_side_by_side(self.lying()).offset
        arguments: dict[str, Any] = {
            "body_frame": f"heading:{math.degrees(self.facing)}",
            "heading_offset": offset,
        }
        return cal.calibrate(summary, pose=pose, created=CREATED, **(arguments | changes))


# --- poses and recovery -------------------------------------------------------------------------------------


def test_straight_pose_hangs_the_arms_with_palms_to_the_thighs() -> None:
    left, right = cal.POSES["straight"][:2]
    # In the T-pose arms point sideways along their bones and palms face down.
    np.testing.assert_allclose(left @ [1, 0, 0], [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(right @ [-1, 0, 0], [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(left @ [0, -1, 0], [-1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(right @ [0, -1, 0], [1, 0, 0], atol=1e-12)
    np.testing.assert_array_equal(cal.POSES["straight"][2:], np.tile(np.eye(3), (4, 1, 1)))
    np.testing.assert_array_equal(cal.POSES["t-pose"], np.tile(np.eye(3), (6, 1, 1)))


@given(seeds, st.sampled_from(sorted(cal.POSES)))
@settings(max_examples=40, deadline=None)
def test_bones_and_accelerations_of_any_rig_are_recovered(seed: int, pose: str) -> None:
    rig = Rig(seed)
    calibration = rig.calibration(pose)
    bones = rot.quat_to_matrix(random_quats(rig.rng, 5, 6))
    a_t = rig.rng.normal(0.0, 5.0, (5, 6, 3))

    r_tb, a = cal.apply_calibration(calibration, rig.measured(bones), rig.force(a_t))

    np.testing.assert_allclose(r_tb, bones, atol=1e-9)
    np.testing.assert_allclose(a, a_t, atol=1e-9)
    one, a_one = cal.apply_calibration(calibration, rig.measured(bones)[2], rig.force(a_t)[2])
    np.testing.assert_allclose(one, bones[2], atol=1e-9)
    np.testing.assert_allclose(a_one, a_t[2], atol=1e-9)


@pytest.mark.parametrize("pose", sorted(cal.POSES))
def test_the_calibration_instant_gives_the_pose_back(pose: str) -> None:
    rig = Rig(7)
    calibration = rig.calibration(pose)
    at_rest = rig.measured(cal.POSES[pose])
    r_tb, a = cal.apply_calibration(calibration, at_rest, rig.force(np.zeros((6, 3))))
    np.testing.assert_allclose(r_tb, cal.POSES[pose], atol=1e-9)
    np.testing.assert_allclose(a, 0.0, atol=1e-9)

    # Eq. 8 as printed, R_BS R_TS, does not.
    r_ts = rig.r_ti @ rot.quat_to_matrix(
        rot.quat_multiply(rot.quat_about_z(calibration.heading_offset), at_rest)
    )
    printed = rot.quat_to_matrix(calibration.bone_from_sensor) @ r_ts
    assert rot.geodesic_angle(printed, cal.POSES[pose]).min() > 0.1


def test_apply_is_the_chain_of_its_equations() -> None:
    rig = Rig(11)
    calibration = rig.calibration()
    q, f = random_quats(rig.rng, 6), rig.rng.normal(0, 9, (6, 3))
    r_ti = rot.quat_to_matrix(calibration.body_from_inertial)
    reset = rot.quat_about_z(calibration.heading_offset)
    r_ts = r_ti @ rot.quat_to_matrix(rot.quat_multiply(reset, q))

    r_tb, a = cal.apply_calibration(calibration, q, f)

    np.testing.assert_allclose(
        r_tb, r_ts @ rot.transpose(rot.quat_to_matrix(calibration.bone_from_sensor)), atol=1e-12
    )
    np.testing.assert_allclose(a, (rot.quat_rotate(reset, f) + np.array([0, 0, -9.81])) @ r_ti.T, atol=1e-12)


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_mean_over_the_hold_beats_one_noisy_frame(seed: int) -> None:
    rig = Rig(seed)
    n = 400
    hold = rig_at_rest(rig.measured(cal.POSES["straight"]))
    noisy = []
    for s in hold:
        shake = rot.rotvec_to_quat(rig.rng.normal(0.0, math.radians(1.0), (n, 3)))
        quat = rot.quat_multiply(s.quat[0], shake)
        noisy.append(still(s.quat[0], n)._replace(quat=np.where(rig.rng.random((n, 1)) < 0.5, quat, -quat)))
    summary = cal.check_hold(noisy)
    assert rot.geodesic_angle(
        rot.quat_to_matrix(summary.orientation), rot.quat_to_matrix([s.quat[0] for s in hold])
    ).max() < math.radians(0.4)
    np.testing.assert_allclose(summary.spread_deg, math.sqrt(3.0), rtol=0.2)


# --- body frame ---------------------------------------------------------------------------------------------


@given(seeds, st.sampled_from(["x", "-x", "+y", "-y", "z", "-z"]), st.floats(-60, 60))
@settings(max_examples=40, deadline=None)
def test_a_named_axis_gives_forward_and_gravity_gives_up(seed: int, axis: str, pitch: float) -> None:
    rig = Rig(seed, headings=False)
    sign = -1.0 if axis[0] == "-" else 1.0
    along = sign * np.eye(3)["xyz".index(axis[-1])]
    # The axis points forward in T and somewhat up or down.
    tilted = np.array([0.0, math.sin(math.radians(pitch)), math.cos(math.radians(pitch))])
    if along @ tilted > -0.99:
        rig.r_bs[PELVIS] = rot.minimal_rotation(along, tilted)
    else:
        rig.r_bs[PELVIS] = rot.rotation_about_axis("y", math.pi) @ rot.minimal_rotation(
            along, rot.rotation_about_axis("y", math.pi) @ tilted
        )
    calibration = rig.calibration(body_frame=f"pelvis:{axis}", heading_offset=None)
    np.testing.assert_allclose(rot.quat_to_matrix(calibration.body_from_inertial), rig.r_ti, atol=1e-9)


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_the_head_sensor_along_the_body_gives_the_frame(seed: int) -> None:
    rig = Rig(seed)
    rig.r_bs[HEAD] = np.eye(3)
    calibration = rig.calibration(body_frame="head")
    np.testing.assert_allclose(rot.quat_to_matrix(calibration.body_from_inertial), rig.r_ti, atol=1e-9)


def test_headings_count_from_x_towards_y() -> None:
    r_ti = cal.body_from_inertial(random_quats(np.random.default_rng(0), 6), "heading:90")
    np.testing.assert_allclose(r_ti @ [0, 1, 0], [0, 0, 1], atol=1e-12)  # facing Y of I
    np.testing.assert_allclose(r_ti @ [-1, 0, 0], [1, 0, 0], atol=1e-12)  # its left is -X
    np.testing.assert_allclose(r_ti @ [0, 0, 1], [0, 1, 0], atol=1e-12)


@given(seeds, st.sampled_from(["head", "pelvis:-z", "head:+x", "heading:17.5"]))
@settings(max_examples=40, deadline=None)
def test_a_body_frame_is_a_rotation_with_y_up(seed: int, body_frame: str) -> None:
    try:
        r_ti = cal.body_from_inertial(random_quats(np.random.default_rng(seed), 6), body_frame)
    except EdgeposeError:
        return
    np.testing.assert_allclose(r_ti @ r_ti.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(r_ti) > 0
    assert (r_ti @ [0, 0, 1])[1] > math.cos(math.radians(20.1))


def test_a_head_sensor_whose_y_is_not_up_is_refused() -> None:
    rig = Rig(3)
    rig.r_bs[HEAD] = rot.rotation_about_axis("x", math.radians(25))
    with pytest.raises(EdgeposeError, match=r"head sensor's Y axis points 25 deg from up"):
        rig.calibration(body_frame="head")


@pytest.mark.parametrize("axis", ["y", "-y"])
def test_an_axis_near_the_vertical_gives_no_forward(axis: str) -> None:
    rig = Rig(3)
    rig.r_bs[PELVIS] = rot.rotation_about_axis("x", math.radians(15))
    with pytest.raises(EdgeposeError, match=rf"pelvis:{axis}: this axis is 15 deg from vertical"):
        rig.calibration(body_frame=f"pelvis:{axis}")


@pytest.mark.parametrize(
    "text",
    ["", "north", "head:", "head:w", "head:--x", "head:xy", "spine:z", "heading", "heading:", "heading:nan",
     "heading:east", "heading:1e999", ":z", "pelvis:-", "pelvis:z-"],
)  # fmt: skip
def test_a_body_frame_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(EdgeposeError, match=r"is none of: head, heading:DEG, SENSOR:AXIS"):
        cal.check_body_frame(text)


@pytest.mark.parametrize(
    ("text", "hint"), [("heading:x", ""), ("head:w", ""), ("pelvs:z", "; did you mean 'pelvis'?")]
)
def test_a_wrong_body_frame_names_sensors_only_if_that_is_wrong(text: str, hint: str) -> None:
    with pytest.raises(EdgeposeError, match=rf"\(such as heading:90, pelvis:-z\){re.escape(hint)}$"):
        cal.check_body_frame(text)


def test_an_unknown_pose_is_refused() -> None:
    with pytest.raises(EdgeposeError, match="pose 'sitting' is none of: straight, t-pose"):
        cal.calibrate(cal.check_hold(Rig(0).lying()), pose="sitting", body_frame="head", created=CREATED)


# --- heading reset ------------------------------------------------------------------------------------------


@given(seeds)
@settings(max_examples=40, deadline=None)
def test_heading_reset_finds_every_offset(seed: int) -> None:
    rig = Rig(seed)
    reset = cal.headings_side_by_side(rig.lying())
    np.testing.assert_allclose(np.sin(reset.offset - rig.error), 0.0, atol=1e-9)
    np.testing.assert_allclose(np.cos(reset.offset - rig.error), 1.0, atol=1e-9)
    assert reset.offset[ROOT] == pytest.approx(0.0, abs=1e-9)
    assert np.abs(reset.offset).max() <= math.pi
    assert reset.error_deg.max() < 1e-6


def test_heading_reset_reports_tilt_and_refuses_too_much_of_it() -> None:
    quats = rot.quat_multiply(rot.quat_about_z([0.3, 1, 2, -1, -3, 0.0]), np.array([1.0, 0, 0, 0]))
    tilt = np.radians([0, 4, 0, 0, 0, 0.0])
    reset = cal.headings_side_by_side(rig_at_rest(rot.quat_multiply(quats, turns_about_x(tilt))))
    np.testing.assert_allclose(reset.error_deg, np.degrees(tilt), atol=1e-6)
    tilt = np.radians([0, 0, 90, 0, 16, 0.0])
    with pytest.raises(
        EdgeposeError,
        match=r"like the pelvis sensor: left_lower_leg \(90 deg\), head \(16 deg\); lay all six",
    ):
        cal.headings_side_by_side(rig_at_rest(rot.quat_multiply(quats, turns_about_x(tilt))))


def test_heading_reset_names_a_sensor_that_moved() -> None:
    hold = moved(rig_at_rest(np.tile([1.0, 0, 0, 0], (6, 1))), LEFT, turns_about_x(np.linspace(0, 0.5, 100)))
    with pytest.raises(cal.MovedError, match=r"left_forearm .* repeat the heading reset"):
        cal.headings_side_by_side(hold)


# --- checks of a hold ---------------------------------------------------------------------------------------


@pytest.fixture
def hold() -> list[cal.SensorHold]:
    return rig_at_rest(random_quats(np.random.default_rng(5), 6))


def test_a_good_hold_has_no_warnings(hold: list[cal.SensorHold]) -> None:
    summary = cal.check_hold(hold)
    assert summary.samples == [100] * 6
    assert summary.warnings == []
    np.testing.assert_allclose(summary.force, np.tile([0, 0, 9.81], (6, 1)), atol=1e-9)
    assert summary.spread_deg.max() < 1e-5


def test_every_sensor_that_moved_is_named_with_its_amount(hold: list[cal.SensorHold]) -> None:
    sway = turns_about_x(np.radians(10) * np.sin(np.arange(100) / 100 * 8 * math.pi))
    drift = turns_about_x(np.radians(np.linspace(0, 8, 100)))
    with pytest.raises(cal.MovedError) as error:
        cal.check_hold(moved(moved(hold, LEFT, sway), HEAD, drift))
    assert (
        str(error.value)
        == "moved during the hold: left_forearm 7.1 deg, head 6.1 deg; stand still and repeat"
    )


def test_a_turning_rate_counts_as_movement_but_a_bias_does_not(hold: list[cal.SensorHold]) -> None:
    bias = [s._replace(gyr=s.gyr + np.array([1.0, 0, 0])) for s in hold]
    assert cal.check_hold(bias).warnings == []
    shake = hold[PELVIS]._replace(gyr=np.tile([[1.0, 0, 0], [-1.0, 0, 0]], (50, 1)))
    with pytest.raises(cal.MovedError, match="pelvis 57 deg/s"):
        cal.check_hold([*hold[:PELVIS], shake])
    unmeasured = [s._replace(gyr=s.gyr * np.nan) for s in hold]
    assert cal.check_hold(unmeasured).warnings == []


def test_sensors_that_never_reported_are_named(hold: list[cal.SensorHold]) -> None:
    nothing = cal.hold_from_samples([])
    with pytest.raises(EdgeposeError, match="nothing from left_forearm, pelvis: check power"):
        cal.check_hold([nothing[0], *hold[1:5], nothing[5]])
    with pytest.raises(EdgeposeError, match="nothing from pelvis"):
        cal.stillest_start([*hold[:5], nothing[5]], 0.5)


def test_raw_sensors_are_told_from_silent_ones() -> None:
    samples = [
        ImuSample(i, t / 50, None if i == 4 else (1, 0, 0, 0), (0, 0, 9.81))
        for t in range(20)
        for i in range(6)
    ]
    with pytest.raises(EdgeposeError, match="no orientation from head: "):
        cal.check_hold(cal.hold_from_samples(samples))


def test_samples_without_an_orientation_among_others_are_left_out() -> None:
    samples = [
        ImuSample(i, t / 50, None if t % 2 else (1, 0, 0, 0), (0, 0, 9.81))
        for t in range(40)
        for i in range(6)
    ]
    summary = cal.check_hold(cal.hold_from_samples(samples))
    assert summary.samples == [20] * 6


def test_too_few_samples(hold: list[cal.SensorHold]) -> None:
    with pytest.raises(EdgeposeError, match=r"too few samples in the hold \(head 9; at least 10\)"):
        cal.check_hold([*hold[:HEAD], still(hold[HEAD].quat[0], 9, name="head"), hold[PELVIS]])


@pytest.mark.parametrize("bad", [[0, 0, 0, 0], [2, 0, 0, 0], [math.nan, 0, 0, 0], [math.inf, 0, 0, 0]])
def test_a_quaternion_that_is_not_a_rotation(hold: list[cal.SensorHold], bad: list[float]) -> None:
    hold[HEAD].quat[[3, 50]] = bad
    with pytest.raises(EdgeposeError, match=r"not rotations \(not of length 1\): head \(2 of 100\)"):
        cal.check_hold(hold)


def test_two_sensors_under_one_name_are_told_from_movement(hold: list[cal.SensorHold]) -> None:
    first, second = (
        hold[LEFT].quat[0],
        rot.quat_multiply(rot.quat_about_z(math.radians(40)), hold[LEFT].quat[0]),
    )
    alternating = np.tile([first, second], (50, 1))
    with pytest.raises(
        EdgeposeError, match=r"left_forearm: two devices, 40 deg apart, send under its id"
    ) as error:
        cal.check_hold(moved(hold, LEFT, alternating))
    assert not isinstance(error.value, cal.MovedError)
    step = np.concatenate([np.tile(first, (50, 1)), np.tile(second, (50, 1))])
    with pytest.raises(cal.MovedError):
        cal.check_hold(moved(hold, LEFT, step))


def test_a_wrong_size_of_gravity_is_a_warning(hold: list[cal.SensorHold]) -> None:
    in_g = hold[HEAD]._replace(acc=hold[HEAD].acc / 9.80665)
    scaled = hold[LEFT]._replace(acc=hold[LEFT].acc * 1.04)
    summary = cal.check_hold([scaled, *hold[1:HEAD], in_g, hold[PELVIS]])
    assert summary.warnings == ["head: it reads 1 at rest, which is in g: send m/s², 9.81 at rest"]


def test_no_accelerometer_is_a_warning(hold: list[cal.SensorHold]) -> None:
    blind = hold[HEAD]._replace(acc=hold[HEAD].acc * np.nan)
    summary = cal.check_hold([*hold[:HEAD], blind, hold[PELVIS]])
    assert summary.warnings == ["head measures no acceleration: gravity was not checked"]
    assert np.isnan(summary.force[HEAD]).all()


@pytest.mark.parametrize("speed_deg_s", [0.0, 60.0, 400.0])
@pytest.mark.parametrize("own_ids", [False, True])
def test_two_devices_alternate_also_in_motion(speed_deg_s: float, own_ids: bool) -> None:
    """The samples of two devices that move come in turn; a single one that turns as fast is one."""
    rng = np.random.default_rng(2)
    t = np.arange(100) / 100
    one = rot.rotvec_to_quat(np.outer(np.radians(speed_deg_s) * t, [0.6, 0.0, 0.8]))
    other = rot.quat_multiply(rot.rotvec_to_quat(np.array([0.0, 1.0, 0.0])), one)
    quats = one if own_ids else np.concatenate([one, other])[np.argsort(np.tile(t, 2), kind="stable")]
    quats = rot.quat_multiply(quats, rot.rotvec_to_quat(rng.normal(0.0, 0.002, (len(quats), 3))))
    apart = detect_alternating_devices(quats)
    assert apart is None if own_ids else apart == pytest.approx(np.degrees(1.0), abs=6.0)


Q = np.array([0.5, 0.1, -0.7, 0.5]) / np.linalg.norm([0.5, 0.1, -0.7, 0.5])


@pytest.mark.parametrize(
    ("quat", "acc", "why"),
    [
        (Q, rot.quat_rotate(rot.quat_conjugate(Q), [0, 0, -9.81]), "180 deg at rest: looks negated"),
        (
            rot.quat_conjugate(Q),
            rot.quat_rotate(rot.quat_conjugate(Q), [0, 0, 9.81]),
            "looks like an inverse",
        ),
        (Q[[1, 2, 3, 0]], rot.quat_rotate(rot.quat_conjugate(Q), [0, 0, 9.81]), "looks like x, y, z, w"),
        (
            Q,
            rot.quat_rotate(rot.quat_conjugate(Q), [0, 9.81, 0]),
            "looks like a frame with Y up",
        ),
        (Q, rot.quat_rotate(rot.quat_conjugate(Q), [0, 5, 7]), "36 deg at rest: no usual convention fits"),
        (Q, np.array([0.01, 0, 0]), "gravity is already removed"),
    ],
)
def test_gravity_that_is_not_up_says_why(
    hold: list[cal.SensorHold], quat: np.ndarray, acc: np.ndarray, why: str
) -> None:
    hold[HEAD] = still(quat, acc=acc, name="head")
    with pytest.raises(EdgeposeError) as error:
        cal.check_hold(hold)
    message = str(error.value)
    assert "head" in message
    assert why in message
    assert "left_forearm" not in message


# --- windows ------------------------------------------------------------------------------------------------


def test_the_first_of_the_still_windows_is_taken(hold: list[cal.SensorHold]) -> None:
    rng = np.random.default_rng(1)
    time_s = 100.0 + np.arange(3000) / 100
    # Movement, still from 105 to 110 s, movement, still from 120 s on and even stiller.
    amount = np.where(((time_s > 105) & (time_s < 110)) | (time_s > 120), 0.001, 0.3) * np.where(
        time_s > 120, 0.1, 1.0
    )
    long = []
    for s in hold:
        quat = rot.quat_multiply(
            s.quat[0], rot.rotvec_to_quat(amount[:, None] * rng.standard_normal((3000, 3)))
        )
        long.append(s._replace(time_s=time_s, quat=quat, acc=np.zeros((3000, 3)), gyr=np.zeros((3000, 3))))
    start = cal.stillest_start(long, 4.0)
    assert 105.0 <= start <= 105.3
    assert [len(s.time_s) for s in cal.trim(long, start, start + 4.0)] == [400] * 6


def test_no_window_is_an_error_that_says_what_there_is(hold: list[cal.SensorHold]) -> None:
    with pytest.raises(
        EdgeposeError, match=r"no 4 s in which all six sensors reported: they overlap for 1\.0 s from 0\.0 s"
    ):
        cal.stillest_start(hold, 4.0)


def test_a_clock_that_leaps_by_years_takes_no_memory(hold: list[cal.SensorHold]) -> None:
    leaping = [s._replace(time_s=s.time_s + np.where(np.arange(100) < 50, 0.0, 1e9)) for s in hold]
    assert cal.stillest_start(leaping, 0.4) == pytest.approx(0.0, abs=0.2)


# --- files --------------------------------------------------------------------------------------------------


def test_a_file_gives_the_same_calibration_back(tmp_path: Path) -> None:
    calibration = Rig(21).calibration(metadata={"source": "rig.csv", "hold_s": 4.0})
    path = tmp_path / "calib.json"
    cal.save(calibration, path)
    loaded = cal.load_calibration(path)

    for name in ("body_from_inertial", "heading_offset", "bone_from_sensor", "residual_deg"):
        np.testing.assert_allclose(getattr(loaded, name), getattr(calibration, name), atol=1e-12)
    for name in ("pose", "body_frame", "created", "metadata"):
        assert getattr(loaded, name) == getattr(calibration, name)
    q = random_quats(np.random.default_rng(0), 3, 6)
    for a, b in zip(
        cal.apply_calibration(loaded, q, q[..., :3]),
        cal.apply_calibration(calibration, q, q[..., :3]),
        strict=True,
    ):
        np.testing.assert_allclose(a, b, atol=1e-12)


def test_what_made_the_orientations_is_kept() -> None:
    made = cal.from_json(cal.to_json(Rig(3).calibration(filter="vqf", north=False)))
    assert (made.filter, made.north) == ("vqf", False)
    # Files from before there were filters here.
    old = cal.from_json(corrupt(orientation=KeyError))
    assert (old.filter, old.north) == ("none", True)


def test_the_file_is_for_people() -> None:
    rig = Rig(2)
    # X of the case up along the spine, its face to the back.
    rig.r_bs[PELVIS] = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]) @ np.diag([1.0, -1, -1])
    document = json.loads(cal.to_json(rig.calibration()))
    assert list(document["sensors"]) == list(PLACEMENTS)
    assert document["sensors"]["pelvis"]["mounting"] == "x up, z back"
    assert document["sensors"]["head"]["heading_offset_deg"] == pytest.approx(math.degrees(rig.error[HEAD]))


def corrupt(**changes: Any) -> str:
    document = json.loads(cal.to_json(Rig(1).calibration()))
    for path, value in changes.items():
        *parents, key = path.split("__")
        owner = document
        for parent in parents:
            owner = owner[parent]
        if value is KeyError:
            del owner[key]
        else:
            owner[key] = value
    return json.dumps(document)


def of_head(**changes: Any) -> str:
    return corrupt(**{f"sensors__head__{key}": value for key, value in changes.items()})


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "not valid JSON"),
        ("{", "not valid JSON"),
        ("[" * 100_000, "not valid JSON"),
        ("[]", "not an edgepose calibration"),
        ("null", "not an edgepose calibration"),
        ('{"format": "other"}', "not an edgepose calibration"),
        ('{"format": "edgepose-calibration", "version": 1, "version": 1}', "'version' appears twice"),
        (corrupt(version=2), "format version 2"),
        (corrupt(version=True), "format version True"),
        (corrupt(version=KeyError), "format version None"),
        (corrupt(sensors=[]), "'sensors' is missing or not an object"),
        (
            corrupt(sensors__head=KeyError, sensors__pelvis=KeyError),
            "no sensor head, pelvis; calibrate again with all six",
        ),
        (corrupt(sensors__tail={}), "unknown sensor 'tail'"),
        (corrupt(sensors__chest={}), "sensor chest: 'heading_offset_deg' is not a number"),
        (corrupt(sensors__head=KeyError), "no sensor head; calibrate again with all six"),
        (corrupt(without=["head"]), "sensor head is in 'without', too"),
        (corrupt(without=["pelvis"]), "'without' may only list head, left_forearm"),
        (corrupt(without="head"), "'without' may only list head, left_forearm"),
        (corrupt(sensors__head=3), "sensor head is not an object"),
        (of_head(bone_from_sensor=[1, 0, 0]), "sensor head: 'bone_from_sensor' is not a unit"),
        (of_head(bone_from_sensor=[1, 1, 0, 0]), "sensor head: 'bone_from_sensor' is not a unit"),
        (of_head(bone_from_sensor=[1, None, 0, 0]), "sensor head: 'bone_from_sensor' is not a unit"),
        (of_head(bone_from_sensor="1,0,0,0"), "sensor head: 'bone_from_sensor' is not a unit"),
        (of_head(bone_from_sensor=[math.nan, 0, 0, 0]), "NaN is not a number"),
        (of_head(heading_offset_deg=math.inf), "Infinity is not a number"),
        (of_head(heading_offset_deg=10**400), "sensor head: 'heading_offset_deg' is not a number"),
        (of_head(heading_offset_deg="5"), "sensor head: 'heading_offset_deg' is not a number"),
        (of_head(heading_offset_deg=KeyError), "sensor head: 'heading_offset_deg' is not a number"),
        (of_head(residual_deg=-1), "sensor head: 'residual_deg' is not a number of at least 0"),
        (of_head(residual_deg=True), "sensor head: 'residual_deg' is not a number of at least 0"),
        (corrupt(body_from_inertial=[0, 0, 0, 0]), "'body_from_inertial' is not a unit quaternion"),
        (corrupt(pose="sitting"), "pose 'sitting' is none of: straight, t-pose"),
        (corrupt(pose=KeyError), "'pose' is missing or not text"),
        (corrupt(body_frame="north"), "body frame 'north' is none of"),
        (corrupt(created=5), "'created' is missing or not text"),
        (corrupt(metadata=[]), "'metadata' is missing or not an object"),
        (corrupt(orientation=3), "'orientation' is missing or not an object"),
        (corrupt(orientation__filter="magic"), "'orientation' must have filter (none, kalman, vqf)"),
        (corrupt(orientation__filter=["none"]), "'orientation' must have filter (none, kalman, vqf)"),
        (corrupt(orientation__north=1), "north (true or false)"),
    ],
)  # fmt: skip
def test_a_hostile_file_is_refused_with_its_name(text: str, what: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.json"
    path.write_text(text)
    with pytest.raises(EdgeposeError) as error:
        cal.load_calibration(path)
    assert str(error.value).startswith(f"{path}: ")
    assert what in str(error.value)
    assert "\n" not in str(error.value)


def test_files_that_cannot_be_read_or_written(tmp_path: Path) -> None:
    with pytest.raises(EdgeposeError, match=r"nowhere\.json: cannot read the calibration"):
        cal.load_calibration(tmp_path / "nowhere.json")
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(EdgeposeError, match="not UTF-8"):
        cal.load_calibration(tmp_path / "binary.json")
    with pytest.raises(EdgeposeError, match="cannot write the calibration"):
        cal.save(Rig(0).calibration(), tmp_path / "no" / "calib.json")


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda s: st.lists(s, max_size=4) | st.dictionaries(st.text(max_size=5), s, max_size=4),
    max_leaves=8,
)
PLACES = [
    "format", "version", "pose", "body_frame", "metadata", "body_from_inertial", "sensors", "sensors__head",
    "sensors__head__bone_from_sensor", "sensors__pelvis__residual_deg",
]  # fmt: skip


@given(json_values, st.sampled_from(PLACES))
@settings(max_examples=150, deadline=None)
def test_any_value_anywhere_loads_or_is_refused(value: Any, where: str) -> None:
    try:
        loaded = cal.from_json(corrupt(**{where: value}))
    except EdgeposeError:
        return
    r_tb, _ = cal.apply_calibration(loaded, np.tile([1.0, 0, 0, 0], (6, 1)), np.zeros((6, 3)))
    np.testing.assert_allclose(r_tb @ rot.transpose(r_tb), np.tile(np.eye(3), (6, 1, 1)), atol=1e-9)


# --- a real wearer ------------------------------------------------------------------------------------------


def test_a_real_wearer_standing_straight() -> None:
    hold = cal.hold_from_recording(read_recording(DATA / "six-sites-3s.npz"))
    summary = cal.check_hold(hold)
    assert summary.warnings == []
    assert summary.spread_deg.max() < 0.5
    by_heading = cal.calibrate(summary, pose="straight", body_frame="heading:0", created=CREATED)
    by_pelvis = cal.calibrate(summary, pose="straight", body_frame="pelvis:-z", created=CREATED)
    apart = rot.geodesic_angle(
        rot.quat_to_matrix(by_heading.body_from_inertial), rot.quat_to_matrix(by_pelvis.body_from_inertial)
    )
    assert math.degrees(apart) < 10.0

    frames = np.stack([s.quat for s in hold], axis=1)
    force = rot.quat_rotate(frames, np.stack([s.acc for s in hold], axis=1))
    r_tb, a_t = cal.apply_calibration(by_heading, frames, force)
    assert np.degrees(rot.geodesic_angle(r_tb, cal.POSES["straight"])).max() < 2.0
    # Scale errors of the accelerometers are up to 3 %.
    assert np.linalg.norm(a_t.mean(axis=0), axis=-1).max() < 0.35


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda s: s._replace(quat=s.quat[:, [1, 2, 3, 0]]), "looks like x, y, z, w"),
        (lambda s: s._replace(quat=s.quat * [1.0, -1.0, -1.0, -1.0]), "looks like an inverse"),
        (lambda s: s._replace(acc=-s.acc), "looks negated"),
    ],
)
def test_one_convention_of_all_sensors(change, says):
    """By chance, other conventions fit single sensors, too."""
    recording = read_recording(Path(__file__).parents[2] / "data" / "imu" / "six-sites-3s.npz")
    sensors = {name: change(data) for name, data in recording.sensors.items()}
    hold = cal.hold_from_recording(recording._replace(sensors=sensors))
    start_s = min(data.time_s[0] for data in recording.sensors.values())
    with pytest.raises(EdgeposeError) as caught:
        cal.check_hold(cal.trim(hold, start_s + 0.1, start_s + 1.1))
    text = str(caught.value)
    assert text.count("deg at rest: ") == text.count(says) >= 4
