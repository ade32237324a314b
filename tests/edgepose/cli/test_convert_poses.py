"""`edgepose convert` with files of poses."""

from __future__ import annotations

import re
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgepose.convert import Job, Options, convert
from edgepose.errors import EdgeposeError
from edgepose.formats.bvh import read_bvh
from edgepose.formats.joint_tree import forward
from edgepose.formats.poses.registry import is_poses, read_poses, salvage_poses
from edgepose.formats.recordings.registry import read_recording
from edgepose.pose import PoseFrame
from edgepose.sinks.bvh import BvhSink
from edgepose.sinks.csv import CsvSink
from edgepose.sinks.npz import NpzSink
from edgepose.skeleton import JOINTS, default_body, forward_kinematics
from tests.support import processes

REAL = Path(__file__).parents[2] / "data" / "imu" / "six-sites-3s.npz"


def poses(count: int, where: bool = False) -> list[PoseFrame]:
    result = []
    for i in range(count):
        turns = Rotation.from_rotvec(0.3 * np.sin(np.arange(72).reshape(24, 3) + i / 10))
        place = np.array([0.0, 0.9, 0.01 * i]) if where else None
        held = frozenset(["head"] if i % 5 == 3 else [])
        result.append(PoseFrame(i, 1.7e9 + i / 60, turns.as_matrix(), np.zeros(24), place, held))
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
    """The file holds `poses`; BVH as the reader of any BVH file sees it."""
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


def messages(errors: str) -> dict[str, str]:
    """Result with its reason by file name, of the lines during the conversion."""
    found = re.findall(r"^\d+ of \d+  (\S+): (.*)$", errors, re.MULTILINE)
    return {Path(name).name: said for name, said in found}


@pytest.mark.parametrize("where", [False, True])
def test_bvh_comes_back(tmp_path, where):
    path = tmp_path / "a.bvh"
    with BvhSink(path, body=default_body(1.6)) as sink:
        for pose in poses(20, where):
            sink.write(pose)
    assert is_poses(path)
    read, damage = salvage_poses(path)
    assert damage is None
    assert read.rate == 60.0
    assert read.frames.tolist() == list(range(20))
    assert read.status == ["ok"] * 20
    np.testing.assert_allclose(read.time_s, np.arange(20) / 60)
    np.testing.assert_allclose(read.rotations, [pose.rotations for pose in poses(20)], atol=3e-6)
    if where:
        np.testing.assert_allclose(
            read.translation, [pose.translation for pose in poses(20, True)], atol=1e-6
        )
    else:
        assert read.translation is None


@pytest.mark.parametrize("metre", [1.0, 100.0, 1000.0])
def test_bvh_of_others_in_any_unit(tmp_path, metre):
    """Names in other cases, more joints, no hands, other channels."""
    path = tmp_path / "a.bvh"
    with BvhSink(path) as sink:
        for pose in poses(3, True):
            sink.write(pose)
    text = path.read_text().replace("pelvis", "Pelvis").replace("left_knee", "Left_Knee")
    text = text.replace("left_hand", "left_thumb").replace("right_hand", "right_thumb")
    head, *rows = text.partition("Frame Time: ")[0], *text.splitlines()[-3:]
    offsets = re.sub(r"-?\d+\.\d{4}", lambda number: f"{float(number[0]) * metre / 100:.6f}", head)
    scaled = [" ".join(f"{float(v) * metre / 100:.6f}" for v in row.split()[:3]) for row in rows]
    lines = [f"{places} {' '.join(row.split()[3:])}" for places, row in zip(scaled, rows, strict=True)]
    path.write_text(f"{offsets}Frame Time: 0.016667\n" + "\n".join(lines) + "\n")
    read = read_poses(path)
    np.testing.assert_allclose(read.translation, [pose.translation for pose in poses(3, True)], atol=1e-5)
    wanted = np.stack([pose.rotations for pose in poses(3)])
    np.testing.assert_allclose(read.rotations[:, :22], wanted[:, :22], atol=3e-6)
    np.testing.assert_array_equal(read.rotations[:, 22:], np.broadcast_to(np.eye(3), (3, 2, 3, 3)))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("JOINT spine2", "JOINT chest", "its joints are not SMPL's: no spine2; other names"),
        (
            "JOINT left_",
            "JOINT l_",
            r"its joints are not SMPL's: no left_hip, left_knee, left_ankle \.\.\.; other",
        ),
        ("JOINT neck", "JOINT x", "no neck; other"),
        ("Frames: 3", "Frames: 4", "4 frames are announced, 3 are there"),
        ("left_", "right_", "joint name 'right_hip' is missing or used twice"),
    ],
)
def test_other_bvh_files(tmp_path, old, new, message):
    path = tmp_path / "a.bvh"
    with BvhSink(path) as sink:
        for pose in poses(3):
            sink.write(pose)
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(EdgeposeError, match=message):
        read_poses(path)


def test_bvh_with_another_zero_pose_or_tree(tmp_path):
    path = tmp_path / "a.bvh"
    with BvhSink(path) as sink:
        sink.write(poses(1)[0])
    text = path.read_text()
    swapped = (
        text.replace("left_elbow", "X")
        .replace("left_wrist", "left_elbow")
        .replace("JOINT X", "JOINT left_wrist")
    )
    path.write_text(swapped)
    with pytest.raises(EdgeposeError, match="its joint left_elbow does not have SMPL's parent"):
        read_poses(path)
    path.write_text(re.sub(r"OFFSET (\S+) (\S+) (\S+)", r"OFFSET \1 \3 \2", text))
    with pytest.raises(EdgeposeError, match="its toes point backwards; left and right are exchanged, or an"):
        read_poses(path)


def test_poses_on_standard_input(tmp_path):
    text = write(tmp_path / "a.csv", where=True).read_text()
    edgepose = [sys.executable, "-m", "edgepose", "convert"]
    out = tmp_path / "out"
    for words in (["--to", "bvh"], ["--to", "npz", str(tmp_path / "a.csv"), "--jobs", "2"]):
        command = [*edgepose, "-", *words, "--out", str(out)]
        result = processes.run(command, input=text, text=True, capture_output=True, check=False)
        assert result.returncode == 0, result.stdout + result.stderr
        check(out / f"stdin.{words[1]}", 20, True)


def test_bones_of_the_wearer(command, tmp_path):
    write(tmp_path / "a.csv")
    out = tmp_path / "out"
    words = ["--height", 1.5, "--leg-length", 0.75]
    result = command("convert", tmp_path / "a.csv", "--to", "bvh", "--out", out, *words)
    assert result.returncode == 0, result.stderr
    tree = read_bvh(out / "a.bvh")
    order = [tree.names.index(name) for name in JOINTS]
    body = default_body(1.5, leg_length_m=0.75)
    np.testing.assert_allclose(tree.offsets[order][1:] / 100, body.offsets[1:], atol=1e-6)
    result = command("convert", tmp_path / "a.csv", "--to", "bvh", "--out", out, "--height", 150)
    assert result.returncode == 2
    assert "'--height': 150.0 is not in the range 0.8<=x<=2.5 metres" in result.stderr


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
    assert "no poses in it" in messages(result.stderr)["walk.npz"]
    assert lines(result.stdout)["walk.npz"] == "failed"


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
        "edgepose: 3 of 14 recordings not converted, or only in part; see the messages above"
    )
    assert list(lines(result.stdout).values()).count("ok") == 11
    said = messages(result.stderr)
    damage = r"damaged: 1 bad rows left out, the first: row 11 has 1 columns.*; 20 poses are kept"
    assert re.match(damage, said["3.csv"])
    assert re.match("failed: not a complete NPZ file", said["x.npz"])
    assert re.match("failed: .*has no poses, only a header", said["empty.csv"])
    assert sorted(path.name for path in out.iterdir()) == sorted(f"{i}.bvh" for i in range(12))
    check(out / "3.bvh", 20)
    result = command("convert", folder, "--to", "bvh", "--out", out, "--skip-existing")
    assert result.stdout.count("skipped, already exists") == 12


@pytest.mark.parametrize(("at", "mended"), [(6, b"\x63"), (8, struct.pack("<H", 0x800))])
def test_directories_of_archives_that_zipfile_refuses(tmp_path, at, mended):
    """A version of the format that is not there yet, and a name that says it is UTF-8 and is not."""
    content = bytearray(REAL.read_bytes())
    entry = content.index(b"PK\x01\x02")
    content[entry + at : entry + at + len(mended)] = mended
    content[entry + 46] = 0xFF
    path = tmp_path / "a.npz"
    path.write_bytes(content)
    assert not is_poses(path)
    with pytest.raises(EdgeposeError, match=r"a\.npz: not a complete NPZ file"):
        read_poses(path)


@pytest.mark.parametrize("form", ["axis-angle", "quat", "matrix", "euler"])
@pytest.mark.parametrize(
    ("column", "number"), [(0, "-9" + "0" * 13), (1, "1e300"), (3, "1e200"), (-1, "-1e7")]
)
def test_numbers_that_are_far_too_large(tmp_path, form, column, number):
    path = write(tmp_path / "a.csv", 5, True, form)
    rows = [row.split(",") for row in path.read_text().splitlines()]
    rows[1 if column == 0 else 5][column] = number
    path.write_text("\n".join(map(",".join, rows)) + "\n")
    with pytest.raises(
        EdgeposeError, match=r"row [26] has a number that is infinite, not a number, or far too large"
    ):
        read_poses(path)


@pytest.mark.parametrize("times", [("0", "1e-320"), ("0", "1e-7"), ("0", "1000")])
@pytest.mark.parametrize("ending", ["csv", "npz"])
def test_times_of_no_frame_rate(tmp_path, times, ending):
    path = write(tmp_path / "a.csv", 2)
    rows = [row.split(",") for row in path.read_text().splitlines()]
    rows[1][1], rows[2][1] = times
    path.write_text("\n".join(map(",".join, rows)) + "\n")
    if ending == "npz":
        path = tmp_path / "a.npz"
        np.savez(path, poses=np.zeros((2, 72)), time_s=np.array(times, float))
    with pytest.raises(EdgeposeError, match=r"a\.(csv|npz): .* s from pose to pose is not possible"):
        read_poses(path)


@pytest.mark.parametrize("status", ["held, head", "held\nhead", 'held ""head', "held\x85head"])
def test_a_status_that_would_break_a_row(tmp_path, status):
    path = write(tmp_path / "a.csv", 5)
    path.write_text(path.read_text().replace("held head", f'"{status}"'))
    read, damage = salvage_poses(path)
    assert read.frames.tolist() == [0, 1, 2, 4]
    assert re.search("row [56] has a comma, a quote or a line break in its status; 4 poses are kept", damage)


def test_names_of_other_sensors_in_a_status_stay(tmp_path):
    path = write(tmp_path / "a.csv", 5)
    path.write_text(path.read_text().replace("held head", "held sternum left_foot"))
    assert read_poses(path).status[3] == "held sternum left_foot"


def test_poses_that_come_in_pieces(tmp_path):
    path = write(tmp_path / "a.csv")
    line = f"(head -c 3 {path}; sleep 1; tail -c +4 {path}) | {sys.executable} -m edgepose convert - "
    line += f"--to npz --out {tmp_path / 'out'}"
    result = subprocess.run(line, shell=True, text=True, capture_output=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    check(tmp_path / "out" / "stdin.npz", 20)


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (0.3, 0.9, -2.0)])
def test_a_place_that_does_not_change_comes_through_bvh(tmp_path, place):
    with BvhSink(tmp_path / "a.bvh", body=default_body(1.9)) as sink:
        for pose in poses(3):
            sink.write(pose._replace(translation=np.array(place)))
    found = read_poses(tmp_path / "a.bvh").translation
    np.testing.assert_allclose(found, [place] * 3, atol=1e-6)


def test_small_files_of_many_poses(tmp_path):
    """They must not fill the memory."""
    path = tmp_path / "a.npz"
    np.savez_compressed(path, poses=np.zeros((200_000, 72), np.int8), mocap_framerate=60.0)
    with pytest.raises(EdgeposeError, match=r"a\.npz: unpacks to 329 MB; the limits are"):
        read_poses(path)
    still = "".join(f"JOINT j{i}\n{{\nOFFSET 0 0 0\nCHANNELS 0\n}}\n" for i in range(500))
    head = f"HIERARCHY\nROOT r\n{{\nOFFSET 0 0 0\nCHANNELS 1 Xrotation\n{still}}}\nMOTION\n"
    path = tmp_path / "a.bvh"
    path.write_text(f"{head}Frames: 50000\nFrame Time: .01\n" + "0\n" * 50_000)
    with pytest.raises(EdgeposeError, match=r"a\.bvh: unpacks to 2293 MB; the limits are"):
        read_poses(path)
    more = "".join(still.replace("j", letter) for letter in "abcdefghiklmnopqstuvw")
    path.write_text(path.read_text().replace("}\nMOTION", more + "}\nMOTION"))
    with pytest.raises(EdgeposeError, match=r"a\.bvh, line \d+: more than 10000 joints"):
        read_poses(path)


@pytest.mark.parametrize(
    ("change", "count", "says"),
    [
        (lambda text: text[:-100], 19, "line 164: a frame needs 75 numbers, this line has"),
        (lambda text: text.replace("Frames: 20", "Frames: 12"), 20, "12 frames are announced, 20 are there"),
        (lambda text: text.replace("Frames: 20", "Frames: 30"), 20, "30 frames are announced, 20 are there"),
        (lambda text: text.replace("Frames: 20", "Frames: 30")[:-3], 19, "30 frames are announced"),
        (lambda text: re.sub(r"\S+(\s\S+\s)$", r"nan\1", text), 19, "a number is not finite"),
    ],
)
def test_good_rows_of_a_damaged_bvh_file(command, tmp_path, change, count, says):
    path = tmp_path / "a.bvh"
    with BvhSink(path) as sink:
        for pose in poses(20):
            sink.write(pose)
    path.write_text(change(path.read_text()))
    with pytest.raises(EdgeposeError, match=says):
        read_poses(path)
    result = command("convert", path, "--to", "npz", "--out", tmp_path / "out")
    assert result.returncode == 1
    assert re.match(f"damaged: .*{says}.*; {count} poses are kept", messages(result.stderr)["a.bvh"])
    found = read_poses(tmp_path / "out" / "a.npz").rotations
    np.testing.assert_allclose(found, [pose.rotations for pose in poses(count)], atol=1e-5)


@pytest.mark.parametrize("form", ["axis-angle", "quat", "matrix"])
def test_a_bad_row_costs_only_itself(tmp_path, form):
    path = write(tmp_path / "a.csv", 30, form=form)
    rows = path.read_text().splitlines(keepends=True)
    rows[25] = "1,2,3\n"  # and before that, which is found later:
    rows[12] = ",".join([*rows[12].split(",")[:7], "nan", *rows[12].split(",")[8:]])
    path.write_text("".join(rows))
    read, damage = salvage_poses(path)
    good = [frame for frame in range(30) if frame not in (11, 24)]
    assert read.frames.tolist() == good
    assert "2 bad rows left out, the first: row 13 has a number that is infinite, not a number" in damage
    np.testing.assert_allclose(read.rotations, [poses(30)[i].rotations for i in good], atol=1e-5)


@pytest.mark.parametrize(("ending", "form"), [("glb", {"names": "unity"}), ("sto", {}), ("mot", {})])
def test_formats_that_are_only_written(tmp_path, ending, form):
    source, target = write(tmp_path / "a.csv", where=True), tmp_path / f"a.{ending}"
    result = convert(Job(source, target), Options(height_m=1.6, form=form))
    assert (result.problem, result.samples) == (None, 20)
    if ending == "glb":
        assert b'"name":"LeftUpperArm"' in target.read_bytes()
    else:
        assert len(target.read_text().partition("endheader\n")[2].splitlines()) == 21
    target.write_bytes(b"old")
    assert "already exists" in convert(Job(source, target), Options(overwrite=False)).problem
    assert target.read_bytes() == b"old"


def test_flags_for_other_programs(command, tmp_path):
    write(tmp_path / "a.csv")
    words = ("--to", "bvh,names=unity", "--out", tmp_path / "unity")
    assert command("convert", tmp_path / "a.csv", *words).returncode == 0
    assert "LeftUpperArm" in read_bvh(tmp_path / "unity" / "a.bvh").names
    words = ("--unit", "cm", "--to", "npz,joints=52", "--out", tmp_path / "amass")
    assert command("convert", tmp_path / "unity" / "a.bvh", *words).returncode == 0
    assert np.load(tmp_path / "amass" / "a.npz")["poses"].shape == (20, 156)
    check(write(tmp_path / "b.csv"), 20)
    read = read_poses(tmp_path / "amass" / "a.npz")
    np.testing.assert_allclose(read.rotations[:, :22], [pose.rotations[:22] for pose in poses(20)], atol=1e-5)
