"""`edgepose convert` with files of poses."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgepose.bvh import read_bvh
from edgepose.joint_tree import forward
from edgepose.pose import PoseFrame
from edgepose.poses import read_poses, salvage_poses
from edgepose.recording import read_recording
from edgepose.sinks.csv_file import CsvSink
from edgepose.sinks.npz import NpzSink
from edgepose.skeleton import JOINTS, default_body, forward_kinematics

REAL = Path(__file__).parents[1] / "data" / "imu" / "six-sites-3s.npz"


def poses(count: int, where: bool = False) -> list[PoseFrame]:
    result = []
    for i in range(count):
        turns = Rotation.from_rotvec(0.3 * np.sin(np.arange(72).reshape(24, 3) + i / 10))
        place = np.array([0.0, 0.9, 0.01 * i]) if where else None
        status = "held head" if i % 5 == 3 else "ok"
        result.append(PoseFrame(i, 1.7e9 + i / 60, status, turns.as_matrix(), np.zeros(24), place))
    return result


def write(path: Path, count: int = 20, where: bool = False, form: str = "axis-angle") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    sink = (
        NpzSink(path, translation=where) if path.suffix == ".npz" else CsvSink(path, form, translation=where)
    )
    with sink:
        for pose in poses(count, where):
            sink.write(pose)
    return path


def check(path: Path, count: int, where: bool = False) -> None:
    """The file holds `poses`; BVH is read by the reader of motion capture."""
    wanted = poses(count, where)
    if path.suffix == ".bvh":
        read = read_bvh(path)
        assert read.rate == 60.0
        order = [read.names.index(name) for name in JOINTS]
        places = forward(read)[1][:, order] / 100.0
        offsets = default_body().offsets
        true = forward_kinematics(np.stack([pose.rotations for pose in wanted]), offsets)[1]
        np.testing.assert_allclose(places - places[:, :1], true - true[:, :1], atol=1e-4)
        return
    read = read_poses(path)
    assert read.frames.tolist() == list(range(count))
    assert read.rate == 60.0
    assert read.status == [pose.status for pose in wanted]
    np.testing.assert_allclose(read.time_s, [pose.time_s for pose in wanted], atol=1e-6)
    np.testing.assert_allclose(read.rotations, [pose.rotations for pose in wanted], atol=1e-5)
    if where:
        np.testing.assert_allclose(read.translation, [pose.translation for pose in wanted], atol=1e-5)


def lines(output: str) -> dict[str, str]:
    """Result by file name, of the table at the end."""
    return {Path(line.split()[0]).name: line.split(maxsplit=3)[3] for line in output.splitlines()[1:]}


@pytest.mark.parametrize("where", [False, True])
def test_every_kind_to_every_kind(command, tmp_path, where):
    write(tmp_path / "in" / "a.csv", where=where, form="quat")
    write(tmp_path / "in" / "deep" / "b.npz", where=where)
    for to in ("csv", "npz", "bvh"):
        result = command("convert", tmp_path / "in", "--to", to, "--out", tmp_path / to)
        assert result.returncode == 0, result.stdout + result.stderr
        assert lines(result.stdout) == {"a.csv": "ok", "b.npz": "ok"}
        assert re.search(r"a\.csv +20 +0\.3  ok", result.stdout)
        for name in (f"a.{to}", f"deep/b.{to}"):
            check(tmp_path / to / name, 20, where)


def test_poses_and_recordings_together(command, tmp_path):
    folder = tmp_path / "in"
    write(folder / "poses.csv", 30)
    (folder / "walk.npz").write_bytes(REAL.read_bytes())
    result = command("convert", folder, "--to", "npz", "--out", tmp_path / "out", "--jobs", 2)
    assert result.returncode == 0, result.stderr
    check(tmp_path / "out" / "poses.npz", 30)
    assert read_recording(tmp_path / "out" / "walk.npz").sensors
    result = command("convert", folder, "--to", "bvh", "--out", tmp_path / "out")
    assert result.returncode == 1
    assert lines(result.stdout)["poses.csv"] == "ok"
    assert "no poses in it" in lines(result.stdout)["walk.npz"]


def test_true_poses_of_a_recording_to_bvh(command, tmp_path):
    vectors = np.stack([Rotation.from_matrix(pose.rotations).as_rotvec().ravel() for pose in poses(25)])
    with np.load(REAL) as archive:
        np.savez(tmp_path / "a.npz", **archive, poses=vectors, mocap_framerate=np.array(60.0))
    result = command("convert", tmp_path / "a.npz", "--to", "bvh", "--out", tmp_path / "out")
    assert result.returncode == 0, result.stderr
    check(tmp_path / "out" / "a.bvh", 25)


def test_broken_files_cost_only_themselves(command, tmp_path):
    folder, out = tmp_path / "in", tmp_path / "out"
    for i in range(12):
        write(folder / f"{i}.csv")
    rows = (folder / "3.csv").read_text().splitlines(keepends=True)
    (folder / "3.csv").write_text("".join([*rows[:10], "nonsense\n", *rows[10:]]))
    whole = write(folder / "x.npz").read_bytes()
    (folder / "x.npz").write_bytes(whole[:500])
    (folder / "empty.csv").write_text(rows[0])
    result = command("convert", folder, "--to", "bvh", "--out", out, "--jobs", 2)
    assert result.returncode == 1
    assert result.stderr.splitlines()[-1] == (
        "edgepose: 3 of 14 recordings not or not wholly converted; see the table"
    )
    said = lines(result.stdout)
    assert list(said.values()).count("ok") == 11
    assert re.match(r"damaged: .*3\.csv, row 11: 1 columns.*; only the 9 poses before it", said["3.csv"])
    assert re.match("failed: .*not a whole NPZ file", said["x.npz"])
    assert re.match("failed: .*has no poses, only a header", said["empty.csv"])
    assert sorted(path.name for path in out.iterdir()) == sorted(f"{i}.bvh" for i in range(12))
    check(out / "3.bvh", 9)
    result = command("convert", folder, "--to", "bvh", "--out", out, "--skip-existing")
    assert result.stdout.count("skipped, there already") == 12


@pytest.mark.parametrize("form", ["axis-angle", "quat", "matrix"])
def test_everything_before_the_first_bad_row_is_taken(tmp_path, form):
    path = write(tmp_path / "a.csv", 30, form=form)
    rows = path.read_text().splitlines(keepends=True)
    rows[25] = "1,2,3\n"  # and before that, which is found later:
    rows[12] = rows[12].replace(rows[12].split(",")[7], "nan", 1)
    path.write_text("".join(rows))
    read, damage = salvage_poses(path)
    assert len(read.frames) == 11
    assert "row 13: a number is infinite or not a number" in damage
    np.testing.assert_allclose(read.rotations, [pose.rotations for pose in poses(11)], atol=1e-5)
