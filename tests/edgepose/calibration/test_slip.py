"""Sensors that turn on their limbs during a run are found, and no others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edgepose import calibration as cal
from edgepose import rotations as rot
from edgepose.analysis.report import find_slips
from edgepose.calibration.misfit import MisfitDetector
from edgepose.calibration.slip import Slip, SlipMonitor
from edgepose.diagnostics.sensor_health import SensorHealthMonitor
from edgepose.formats.recordings.registry import read_recording
from edgepose.imu import ImuFrame, ImuSample
from edgepose.placements import BONES, PLACEMENTS
from edgepose.pose import PoseSequence
from edgepose.skeleton import default_body, local_from_global

WALK = Path(__file__).parents[2] / "data" / "real" / "mtw-walk.npz"
RATE = 10.0


@pytest.fixture(scope="module")
def walked():
    """Two and a half minutes of the real walker, at 10 Hz: calibration and quaternions (T, 6, 4)."""
    recording = read_recording(WALK)
    hold = cal.check_hold(cal.trim(cal.hold_from_recording(recording), 1.0, 5.0))
    made = cal.calibrate(hold, pose="straight", body_frame="heading:28", created="")
    quats = np.stack([recording.sensors[name].quat for name in PLACEMENTS], axis=1)
    return made, np.concatenate([quats[::6]] * 7)


def slips(bones: np.ndarray, north: bool = True) -> list[Slip]:
    monitor = SlipMonitor(north)
    return [slip for k, instant in enumerate(bones) for slip in monitor.update(k / RATE, instant)]


def slipped(made: cal.Calibration, i: int, axis: str, angle_deg: float) -> np.ndarray:
    """The rotation (3, 3) of a sensor that turned about an axis of T, in the pose."""
    mounted = cal.POSES["straight"][i] @ rot.quat_to_matrix(made.bone_from_sensor[i])
    return mounted.T @ rot.rotation_about_axis(axis, np.radians(angle_deg)) @ mounted


def bones_of(made: cal.Calibration, quats: np.ndarray) -> np.ndarray:
    return cal.apply_calibration(made, quats, np.zeros((*quats.shape[:2], 3)))[0]


def turned(made: cal.Calibration, quats: np.ndarray, i: int, axis: str, angle_deg: float) -> np.ndarray:
    result = quats.copy()
    result[:, i] = rot.quat_multiply(quats[:, i], rot.matrix_to_quat(slipped(made, i, axis, angle_deg)))
    return result


def test_a_real_walker_whose_sensors_stay(walked):
    assert slips(bones_of(*walked)) == []


@pytest.mark.parametrize("i", range(6), ids=PLACEMENTS)
@pytest.mark.parametrize("axis", "xz")
def test_each_sensor_of_a_real_walker(walked, i, axis):
    made, quats = walked
    (slip,) = slips(bones_of(made, turned(made, quats, i, axis, 40.0)))
    assert (slip.placement, slip.kind) == (PLACEMENTS[i], "tilt")
    assert slip.angle_deg == pytest.approx(40.0, abs=15.0)


def test_a_turn_about_the_vertical_shows_only_with_a_common_north(walked):
    made, quats = walked
    bones = bones_of(made, turned(made, quats, 2, "y", 40.0))
    (slip,) = slips(bones)
    assert (slip.placement, slip.kind) == ("left_lower_leg", "heading")
    assert slip.angle_deg == pytest.approx(40.0, abs=10.0)
    assert "(unless a magnet or iron is near)" in slip.message
    assert slips(bones, north=False) == []


def test_two_slipped_sensors_and_a_wearer_who_lies_are_not_judged():
    standing = np.tile(cal.POSES["straight"], (2000, 1, 1, 1))
    leant = rot.rotation_about_axis("x", np.radians(40.0))
    two = standing.copy()
    two[:, [2, 5]] = leant @ two[:, [2, 5]]
    assert slips(two) == []
    assert slips(leant @ standing) == []
    # A minute in between does not count.
    one = standing.copy()
    one[500:900, 5] = leant @ one[500:900, 5]
    assert slips(one) == []


@pytest.mark.parametrize(
    ("without", "found"),
    [(("head",), ["pelvis"]), (("left_forearm", "head"), ["pelvis"]), (PLACEMENTS[:2], [])],
)
def test_a_rig_that_lacks_sensors_is_judged_by_the_others(walked, without, found):
    """Whatever stands for those that it lacks; without forearms, another posture may look like it."""
    whole, quats = walked
    lacking = np.isin(PLACEMENTS, without)
    made = replace(
        whole, without=without, bone_from_sensor=np.where(lacking[:, None], 0.5, whole.bone_from_sensor)
    )
    quats = np.where(lacking[:, None], [1.0, 0.0, 0.0, 0.0], quats)
    assert slips_of_run(made, quats, lacking) == []
    assert slips_of_run(made, turned(whole, quats, 5, "x", 40.0), lacking) == found


def slips_of_run(made: cal.Calibration, quats: np.ndarray, held: np.ndarray) -> list[str]:
    detector = MisfitDetector(made)
    for k, (quat, bones) in enumerate(zip(quats, bones_of(made, quats), strict=True)):
        detector.update(ImuFrame(k, k / RATE, quat, np.zeros((6, 3)), held, k / RATE), bones)
    return [slip.placement for slip in detector.slips]


def test_a_run_warns_once_and_keeps_it(walked):
    made, quats = walked
    half = len(quats) // 2
    later = np.concatenate([quats[:half], turned(made, quats, 5, "x", 40.0)[half:], quats])
    detector, lines = MisfitDetector(made), []
    for k, (quat, bones) in enumerate(zip(later, bones_of(made, later), strict=True)):
        frame = ImuFrame(k, k / RATE, quat, np.zeros((6, 3)), np.zeros(6, bool), k / RATE)
        lines += detector.update(frame, bones)
    assert len(lines) == 1
    assert lines[0].startswith("warning: pelvis has turned on its limb by about 4")
    assert lines[0].endswith("its tilt disagreed with all others; put it back, or calibrate again")
    assert [slip.placement for slip in detector.slips] == ["pelvis"]


def test_check_finds_it_in_a_recording(walked):
    made, quats = walked
    later = np.concatenate([quats[:100], turned(made, quats, 5, "x", 40.0)[100:1000]])
    forces = rot.quat_rotate(rot.quat_conjugate(later), [0.0, 0.0, cal.GRAVITY])
    monitor = SensorHealthMonitor(made)
    rows = [(i, k) for k in range(len(later)) for i in range(6)]
    samples = [ImuSample(i, k / RATE, tuple(later[k, i]), tuple(forces[k, i])) for i, k in rows]
    for first in range(0, len(samples), 600):
        monitor.add(samples[first : first + 600])
    found = {row.placement: row.impossible for row in monitor.report(len(later) / RATE) if row.impossible}
    assert list(found) == ["pelvis"]
    assert found["pelvis"].startswith("it has turned on its limb by about 4")


def test_poses_of_a_file_show_it():
    standing = np.tile(np.eye(3), (1000, 24, 1, 1))
    straight = cal.POSES["straight"]
    for bones, arm in (((16, 18, 20, 22), straight[0]), ((17, 19, 21, 23), straight[1])):
        standing[:, bones] = arm
    standing[:, BONES[4]] = rot.rotation_about_axis("x", np.radians(45.0))
    poses = PoseSequence(
        frames=np.arange(1000),
        time_s=np.arange(1000) / RATE,
        rotations=local_from_global(standing),
        translation=None,
        held=[frozenset()] * 1000,
        warming_up=[False] * 1000,
    )
    (slip,) = find_slips(poses, default_body())
    assert (slip.placement, round(slip.angle_deg)) == ("head", 45)
    assert find_slips(poses._replace(about={"without": "left_forearm, head"}), default_body()) == []


def test_one_forearm_without_the_other_may_be_at_work(walked):
    made, quats = walked
    working = turned(made, quats, 1, "x", 60.0)
    assert [slip.placement for slip in slips(bones_of(made, working))] == ["right_forearm"]
    monitor = SlipMonitor(north=True, without=["left_forearm"])
    assert not [s for k, now in enumerate(bones_of(made, working)) for s in monitor.update(k / RATE, now)]


def test_a_rig_too_small_to_judge_its_sensors_reports_none():
    """Nothing else shows the heading of the only sensor on trunk and legs."""
    monitor = SlipMonitor(north=True, without=["left_lower_leg", "right_lower_leg", "head"])
    bones = cal.POSES["straight"].copy()
    bones[0] = bones[0] @ rot.rotation_about_axis("x", np.radians(60.0))
    assert not [slip for k in range(1000) for slip in monitor.update(k / RATE, bones)]
