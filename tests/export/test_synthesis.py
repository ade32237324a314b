from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from edgepose import calibration
from edgepose import rotations as rot
from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.registry import read_recording
from edgepose.placements import BONES, PLACEMENTS
from edgepose.skeleton import PARENTS, Body, default_body, local_from_global
from edgepose_export.cli.synthesize import synthesize
from edgepose_export.mocap import Motion, read_motion, resample
from edgepose_export.synthesis.virtual_imus import (
    BLEND_S,
    INERTIAL_FROM_BODY,
    recording_arrays,
    straight_pose,
    virtual_imus,
    with_hold,
)
from edgepose_export.training.dataset import read_take

DATA = Path(__file__).parents[1] / "data" / "mocap"
WALK = DATA / "dataset-2_walk_normal_001.bvh"
STAND = DATA / "dataset-2_raise-up-right-hand_normal_001.bvh"
MOUNTING = Rotation.random(6, random_state=4).as_matrix()
RATE = 200.0


def still(frames=20, rate=RATE, pose=None):
    rotations = np.broadcast_to(straight_pose() if pose is None else pose, (frames, 24, 3, 3))
    return Motion(rotations, np.zeros((frames, 3)), rate, "cmu")


def body_acceleration(imus):
    """Accelerations in T, gravity taken off."""
    inertial = rot.quat_to_matrix(imus.orientation)
    force = np.einsum("tsij,tsj->tsi", inertial, imus.force)
    return (force - [0, 0, 9.81]) @ INERTIAL_FROM_BODY


@pytest.mark.parametrize("mounting", [None, MOUNTING])
def test_at_rest_a_sensor_feels_gravity_upwards(mounting):
    imus = virtual_imus(still(), default_body(), mounting)
    up_in_sensor = rot.quat_to_matrix(imus.orientation)[..., 2, :]
    np.testing.assert_allclose(imus.force, 9.81 * up_in_sensor, atol=1e-9)
    np.testing.assert_allclose(imus.rate_of_turn, 0, atol=1e-9)


def test_straight_pose_is_the_one_that_calibration_knows():
    np.testing.assert_allclose(straight_pose()[list(BONES)], calibration.POSES["straight"], atol=1e-12)


def test_level_sensor_reads_gravity_on_its_up_axis():
    """Along the bones of a T-pose: the bones' Y axis is up, Z forward is the inertial X."""
    imus = virtual_imus(still(pose=np.tile(np.eye(3), (24, 1, 1))), default_body())
    np.testing.assert_allclose(imus.force, np.tile([0, 9.81, 0], (20, 6, 1)), atol=1e-9)
    forward = rot.quat_to_matrix(imus.orientation) @ [0, 0, 1]
    np.testing.assert_allclose(forward, np.tile([1, 0, 0], (20, 6, 1)), atol=1e-9)


def test_circling_body():
    """A body carried on a circle of 1 m without turning: towards the centre with r w^2, at every sensor."""
    w, t = 3.0, np.arange(60) / RATE
    motion = still(60)._replace(translation=np.stack([np.cos(w * t), 0 * t, np.sin(w * t)], axis=1))
    acceleration = body_acceleration(virtual_imus(motion, default_body(), MOUNTING))
    expected = -(w**2) * motion.translation[:, None]
    np.testing.assert_allclose(acceleration[1:-1], np.broadcast_to(expected, (60, 6, 3))[1:-1], atol=1e-3)
    np.testing.assert_array_equal(acceleration[0], acceleration[1])
    np.testing.assert_array_equal(acceleration[-1], acceleration[-2])


def test_turning_body():
    """A body that spins about the vertical: each sensor is drawn to the axis by its distance times w^2."""
    w, t = 4.0, np.arange(60) / RATE
    pose = rot.rotation_about_axis("y", w * t)[:, None] @ np.tile(np.eye(3), (24, 1, 1))
    motion = still(60)._replace(rotations=pose)
    body = default_body()
    imus = virtual_imus(motion, body, MOUNTING)
    local = virtual_imus(still(3, pose=np.tile(np.eye(3), (24, 1, 1))), body)
    assert np.abs(body_acceleration(local)).max() < 1e-9
    joints = np.zeros((24, 3))
    for j, parent in enumerate(PARENTS):
        joints[j] = body.offsets[j] + (joints[parent] if parent >= 0 else 0)
    points = (joints[list(BONES)] + body.sensors) * [1, 0, 1]
    expected = -(w**2) * np.einsum("tij,sj->tsi", pose[:, 0], points)
    np.testing.assert_allclose(body_acceleration(imus)[1:-1], expected[1:-1], atol=2e-3)
    # Each gyroscope measures the same turn about the vertical, in its own frame.
    up = np.einsum("tsji,j->tsi", rot.quat_to_matrix(imus.orientation), [0, 0, w])
    np.testing.assert_allclose(imus.rate_of_turn, up, atol=1e-9)


def test_one_swinging_forearm_moves_only_its_own_sensor():
    t = np.arange(60) / RATE
    pose = np.tile(np.eye(3), (60, 24, 1, 1))
    pose[:, [18, 20, 22]] = rot.rotation_about_axis("z", 0.5 * np.sin(5 * t))[:, None]
    offsets, sensors = default_body().offsets, np.zeros((6, 3))
    sensors[0] = [0.2, 0.0, 0.0]
    acceleration = body_acceleration(
        virtual_imus(still(60)._replace(rotations=pose), Body(offsets, sensors, 1.75))
    )
    assert np.abs(acceleration[:, 1:]).max() < 1e-9
    angle, speed, change = 0.5 * np.sin(5 * t), 2.5 * np.cos(5 * t), -12.5 * np.sin(5 * t)
    tangent = np.stack([-np.sin(angle), np.cos(angle), 0 * t], axis=1)
    outwards = np.stack([np.cos(angle), np.sin(angle), 0 * t], axis=1)
    expected = 0.2 * (change[:, None] * tangent - (speed**2)[:, None] * outwards)
    np.testing.assert_allclose(acceleration[1:-1, 0], expected[1:-1], atol=2e-3)


def test_too_short():
    with pytest.raises(ValueError, match="3 frames"):
        virtual_imus(still(2), default_body())


def test_hold_then_the_take():
    motion = resample(read_motion(WALK), 100.0)
    held = with_hold(motion, 2.0)
    blend = round(BLEND_S * 100)
    assert len(held.rotations) == len(held.translation) == 200 + blend + len(motion.rotations)
    np.testing.assert_array_equal(held.rotations[:200], np.broadcast_to(straight_pose(), (200, 24, 3, 3)))
    assert np.ptp(held.translation[: 200 + blend], axis=0).max() == 0
    # The take itself is turned as a whole, so that it begins facing forward.
    turn = held.rotations[200 + blend, 0] @ motion.rotations[0, 0].T
    np.testing.assert_allclose(turn[1], [0, 1, 0], atol=1e-9)
    np.testing.assert_allclose(held.rotations[200 + blend :], turn @ motion.rotations, atol=1e-9)
    np.testing.assert_allclose(held.translation[200 + blend :], motion.translation @ turn.T, atol=1e-9)
    assert held.rotations[200 + blend, 0, 0, 2] == pytest.approx(0, abs=1e-9)
    assert held.rotations[200 + blend, 0, 2, 2] > 0
    # No joint jumps on the way.
    steps = rot.geodesic_angle(held.rotations[1:], held.rotations[:-1])[: 200 + blend]
    assert np.rad2deg(steps.max()) < 4


@pytest.fixture(scope="module")
def mounted(tmp_path_factory):
    """A walk after a hold, sensors strapped on at random: path, motion and sensors."""
    motion = with_hold(resample(read_motion(WALK), 60.0), 3.0)
    imus = virtual_imus(motion, default_body(), MOUNTING)
    path = tmp_path_factory.mktemp("synthesis") / "walk.npz"
    np.savez(path, **recording_arrays(motion, imus, "free for all use", "bandai-namco", "two"))
    return path, motion, imus


def test_recording_round_trip(mounted):
    path, motion, imus = mounted
    recording = read_recording(path)
    assert recording.damage is None
    for i, name in enumerate(PLACEMENTS):
        data = recording.sensors[name]
        np.testing.assert_allclose(data.time_s, np.arange(len(motion.rotations)) / 60.0)
        np.testing.assert_allclose(data.quat, imus.orientation[:, i], atol=1e-6)
        np.testing.assert_allclose(data.acc, imus.force[:, i], atol=1e-5)
        np.testing.assert_allclose(data.gyr, imus.rate_of_turn[:, i], atol=1e-5)
        assert data.mag is None
    with np.load(path) as arrays:
        poses = rot.rotvec_to_matrix(arrays["poses"].reshape(-1, 24, 3))
        np.testing.assert_allclose(poses, local_from_global(motion.rotations), atol=1e-5)
        assert float(arrays["mocap_framerate"]) == 60.0
        assert str(arrays["license"]) == "free for all use"
        assert str(arrays["source"]) == "bandai-namco"
        assert str(arrays["actor"]) == "two"


def test_calibrating_a_mounted_recording_gives_the_true_bones_back(mounted):
    path, motion, imus = mounted
    recording = read_recording(path)
    hold = calibration.trim(calibration.hold_from_recording(recording), 0.0, 2.9)
    made = calibration.calibrate(
        calibration.check_hold(hold), pose="straight", body_frame="heading:0", created="2026-01-01T00:00:00Z"
    )
    np.testing.assert_allclose(rot.quat_to_matrix(made.bone_from_sensor), MOUNTING, atol=1e-5)
    orientation = np.stack([recording.sensors[name].quat for name in PLACEMENTS], axis=1)
    force = np.stack([recording.sensors[name].acc for name in PLACEMENTS], axis=1)
    bones, acceleration = calibration.apply_calibration(
        made, orientation, rot.quat_rotate(orientation, force)
    )
    np.testing.assert_allclose(bones, motion.rotations[:, list(BONES)], atol=1e-5)
    np.testing.assert_allclose(acceleration, body_acceleration(imus), atol=1e-4)


@pytest.mark.parametrize("path", [WALK, STAND, DATA / "07_01.bvh", DATA / "07_01.amc"])
def test_takes_come_back_as_they_were(tmp_path, path):
    motion = resample(read_motion(path))
    imus = virtual_imus(motion, default_body())
    np.savez(tmp_path / "take.npz", **recording_arrays(motion, imus, "x"))
    take = read_take(tmp_path / "take.npz")
    np.testing.assert_allclose(take.orientation, motion.rotations[:, list(BONES)], atol=1e-5)
    # A frame of a run holds the mean acceleration since the frame before it.
    expected = body_acceleration(imus)
    expected[1:] = (expected[1:] + expected[:-1]) / 2
    np.testing.assert_allclose(take.acceleration, expected, atol=1e-4)
    np.testing.assert_allclose(take.pose, local_from_global(motion.rotations), atol=1e-5)
    assert (take.name, take.license) == ("take", "x")


def test_motion_is_not_written_over_by_its_recording(tmp_path):
    path = tmp_path / "walk.npz"
    np.savez(path, poses=np.zeros((30, 72)), trans=np.zeros((30, 3)), mocap_framerate=60.0)
    before = path.read_bytes()
    result = CliRunner().invoke(synthesize, [str(tmp_path), "--out", str(tmp_path)])
    assert isinstance(result.exception, EdgeposeError)
    assert "would be overwritten by its recording" in str(result.exception)
    assert path.read_bytes() == before
