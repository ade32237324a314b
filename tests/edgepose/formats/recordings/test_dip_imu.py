"""Sensors of DIP-IMU as recordings, on small pickles of its layout."""

from __future__ import annotations

import pickle
import re
from pathlib import Path

import numpy as np
import pytest

from edgepose.calibration import GRAVITY
from edgepose.errors import EdgeposeError
from edgepose.formats.poses.registry import read_poses
from edgepose.formats.recordings.dip_imu import read_recording
from edgepose.formats.recordings.registry import read_recording as read_npz
from edgepose.imu import Recording
from edgepose.placements import BONES, PLACEMENTS
from edgepose.rotations import Z_UP_TO_T, quat_to_matrix, rotvec_to_matrix
from edgepose.skeleton import global_rotations

FRAMES = 12
PLACES = [7, 8, 11, 12, 0, 2]


@pytest.fixture
def content() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    gt = np.cumsum(0.05 * rng.normal(size=(FRAMES, 72)), axis=0)
    bones = global_rotations(rotvec_to_matrix(gt.reshape(-1, 24, 3)))
    result = {"imu_ori": np.zeros((FRAMES, 17, 3, 3)), "imu_acc": np.zeros((FRAMES, 17, 3)), "gt": gt}
    result["imu_ori"][:, PLACES] = bones[:, list(BONES)]
    result["imu_acc"][:, PLACES] = rng.normal(size=(FRAMES, 6, 3))
    return result


def written(path: Path, content: dict[str, object]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(content, 2))
    return path


def test_sensors_lie_along_their_bones(content, tmp_path):
    recording = read_recording(written(tmp_path / "01.pkl", content))
    assert recording.damage is None
    for place, name in zip(PLACES, PLACEMENTS, strict=True):
        data = recording.sensors[name]
        np.testing.assert_allclose(data.time_s, np.arange(FRAMES) / 60)
        turned = Z_UP_TO_T @ quat_to_matrix(data.quat)
        np.testing.assert_allclose(turned, content["imu_ori"][:, place], atol=1e-9)
        in_body = (turned @ data.acc[..., None])[..., 0] - [0.0, GRAVITY, 0.0]
        np.testing.assert_allclose(in_body, content["imu_acc"][:, place], atol=1e-9)


def test_lost_packets_are_not_there(content, tmp_path):
    content["imu_ori"][3:5, PLACES[0]] = np.nan
    content["imu_acc"][4:6, PLACES[0]] = np.nan
    recording = read_recording(written(tmp_path / "01.pkl", content))
    kept = [i for i in range(FRAMES) if i not in (3, 4, 5)]
    np.testing.assert_allclose(recording.sensors["left_forearm"].time_s, np.array(kept) / 60)
    assert len(recording.sensors["head"].time_s) == FRAMES


def test_a_silent_sensor_and_a_bad_matrix_cost_only_themselves(content, tmp_path):
    content["imu_ori"][:, PLACES[4]] = np.nan
    content["imu_ori"][3, PLACES[0]] = 0.0
    content["imu_ori"][4:6, PLACES[0]] = 1e300
    content["imu_acc"][7, PLACES[1]] = np.inf
    recording = read_recording(written(tmp_path / "01.pkl", content))
    assert "head was not measured" in recording.damage
    assert "4 samples left out that are not a rotation or not an acceleration" in recording.damage
    assert {name: len(data.time_s) for name, data in recording.sensors.items()} == {
        name: FRAMES - {"left_forearm": 3, "right_forearm": 1}.get(name, 0)
        for name in PLACEMENTS
        if name != "head"
    }


@pytest.mark.parametrize("gt", [None, np.nan, 200.0])
def test_sensors_need_no_true_poses(content, tmp_path, gt):
    if gt is None:
        del content["gt"]
    else:
        content["gt"][3, 0] = gt
    path = written(tmp_path / "01.pkl", content)
    recording = read_recording(path)
    assert recording.damage is None
    assert [len(data.time_s) for data in recording.sensors.values()] == [FRAMES] * 6
    says = {None: "has no 'gt'", 200.0: "an angle in frame 3 of 'gt' is more than 100 rad"}.get(gt, "NaN")
    with pytest.raises(EdgeposeError, match=says):
        read_poses(path)


class Attack:
    def __reduce__(self):
        return (print, ("run!",))


def test_by_the_command(content, command, tmp_path):
    folder = tmp_path / "in"
    written(folder / "s_09" / "01.pkl", content)
    written(folder / "s_09" / "02.pkl", {**content, "more": Attack()})
    result = command("convert", folder, "--to", "npz", "--out", tmp_path / "out")
    assert result.returncode == 1
    assert re.search(r"01\.pkl +72 +0\.2  ok\n", result.stdout)
    assert "print, which arrays do not need; it was not run" in result.stderr
    assert "run!" not in result.stdout + result.stderr
    assert list(read_npz(tmp_path / "out" / "s_09" / "01.npz").sensors) == list(PLACEMENTS)
    # Its true poses, as of every recording that has any.
    source = folder / "s_09" / "01.pkl"
    result = command("convert", source, "--to", "bvh", "--out", tmp_path / "out")
    assert result.returncode == 0, result.stdout
    read = read_poses(tmp_path / "out" / "01.bvh")
    wanted = rotvec_to_matrix(content["gt"].reshape(-1, 24, 3))
    np.testing.assert_allclose(read.rotations, wanted, atol=3e-6)
    np.testing.assert_allclose(read_poses(source).rotations, wanted, atol=1e-9)
    assert read.rate == read_poses(source).rate == 60.0


def write_recording(path: Path, recording: Recording) -> Path:
    frames = len(recording.sensors["head"].time_s)
    content = {"imu_ori": np.zeros((frames, 17, 3, 3)), "imu_acc": np.zeros((frames, 17, 3))}
    for place, data in zip(PLACES, recording.sensors.values(), strict=True):
        bones = Z_UP_TO_T @ quat_to_matrix(data.quat)
        content["imu_ori"][:, place] = bones
        content["imu_acc"][:, place] = (bones @ data.acc[..., None])[..., 0] - [0.0, GRAVITY, 0.0]
    path = path.with_suffix(".pkl")
    path.write_bytes(pickle.dumps(content, 2))
    return path
