"""Poses as NPZ and BVH, read back by this project's readers and by others'."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgepose.convert import convert_poses
from edgepose.errors import EdgeposeError, FileFormatError
from edgepose.formats.bvh import read_bvh
from edgepose.formats.bvh_names import BVH_NAMES
from edgepose.formats.joint_tree import forward
from edgepose.formats.poses.csv import BLOCK, read_blocks
from edgepose.formats.poses.registry import is_poses, read_poses, salvage_poses
from edgepose.formats.recordings.csv import write_csv
from edgepose.formats.recordings.registry import read_recording
from edgepose.pose import PoseFrame, PoseSequence, parse_status
from edgepose.sinks.bvh import BvhSink, depth_first
from edgepose.sinks.csv import CsvSink
from edgepose.sinks.npz import NpzSink
from edgepose.skeleton import JOINTS, default_body, forward_kinematics, global_rotations
from edgepose_export.mocap import read_motion

with warnings.catch_warnings():
    warnings.simplefilter("ignore", PendingDeprecationWarning)  # of PyGLM's old name, which it imports
    import bvhio

STATUSES = ("ok", "held head", "held left_forearm pelvis; filling window", "filling window")
REAL = Path(__file__).parents[3] / "data" / "imu" / "six-sites-3s.npz"


def motion(count: int, moves: bool = True) -> list[PoseFrame]:
    """Joints that turn steadily, some of them through all angles, on a path through the room."""
    rng = np.random.default_rng(count)
    start = Rotation.random(24, random_state=rng)
    axes = rng.normal(size=(24, 3))
    result = []
    for i in range(count):
        rotations = (Rotation.from_rotvec(axes * i * 0.02) * start).as_matrix().astype(np.float32)
        where = np.array([0.01 * i, 0.9 + 0.1 * np.sin(i / 9), -0.02 * i]) if moves else None
        std = np.full(24, np.nan, np.float32)
        result.append(PoseFrame(i, 1.7e9 + i / 60, rotations, std, where, *parse_status(STATUSES[i % 4])))
    return result


def touching(count: int) -> list[PoseFrame]:
    """The same on its path, with contacts."""
    shares = np.linspace(0.0, 1.0, 7 * count, dtype=np.float32).reshape(count, 7)
    return [pose._replace(contacts=share) for pose, share in zip(motion(count), shares, strict=True)]


def written(sink, poses: list[PoseFrame]) -> None:
    with sink:
        for pose in poses:
            sink.write(pose)


def same(poses: PoseSequence, wanted: list[PoseFrame], tolerance: float = 2e-6) -> None:
    assert poses.frames.tolist() == [pose.index for pose in wanted]
    assert poses.status == [pose.status for pose in wanted]
    np.testing.assert_allclose(poses.time_s, [pose.time_s for pose in wanted], atol=1e-6)
    np.testing.assert_allclose(poses.rotations, [pose.rotations for pose in wanted], atol=tolerance)
    if wanted[0].translation is None:
        assert poses.translation is None
    else:
        np.testing.assert_allclose(poses.translation, [pose.translation for pose in wanted], atol=tolerance)
    if wanted[0].contacts is None:
        assert poses.contacts is None
    else:
        assert poses.contacts.dtype == np.float32
        np.testing.assert_allclose(poses.contacts, [pose.contacts for pose in wanted], atol=1e-6)


def joints(poses: list[PoseFrame], offsets: np.ndarray) -> np.ndarray:
    """Positions (T, 24, 3), metres."""
    rotations = np.stack([pose.rotations for pose in poses])
    return forward_kinematics(rotations, offsets, np.stack([pose.translation for pose in poses]))[1]


# --- CSV with the pelvis' place -----------------------------------------------------------------------------


@pytest.mark.parametrize("std", [False, True])
def test_csv_with_translation(tmp_path, std):
    poses = motion(7)
    written(CsvSink(tmp_path / "a.csv", "matrix", std, translation=True), poses)
    if not std:
        same(read_poses(tmp_path / "a.csv"), poses)
    header = (tmp_path / "a.csv").read_text().split("\n")[0].split(",")
    assert header[-3:] == ["trans_x", "trans_y", "trans_z"]
    assert is_poses(tmp_path / "a.csv")
    assert not is_poses(tmp_path / "b.csv")
    with pytest.raises(ValueError, match="pose 0 has no translation"):
        written(CsvSink(tmp_path / "b.csv", translation=True), motion(1, moves=False))


@pytest.mark.parametrize("form", ["axis-angle", "quat", "euler"])
def test_csv_with_contacts(tmp_path, form):
    poses = touching(7)
    path = tmp_path / "a.csv"
    written(CsvSink(path, form, translation=True, contacts=True), poses)
    same(read_poses(path), poses, 5e-6)
    header, *rows = path.read_text().splitlines()
    assert header.split(",")[-10:-6] == ["trans_x", "trans_y", "trans_z", "contact_left_ankle"]
    assert header.endswith("contact_pelvis,contact_left_wrist,contact_right_wrist")
    path.write_text("\n".join([header, *rows[:3], rows[3].rpartition(",")[0] + ",1.1", *rows[4:], ""]))
    kept, problem = salvage_poses(path)
    assert kept.frames.tolist() == [0, 1, 2, 4, 5, 6]
    assert "the first: row 5 has a contact that is not a probability from 0 to 1" in problem
    # Without one of the columns it is a file without contacts.
    path.write_text("\n".join([header.replace("contact_pelvis", "seat"), *rows, ""]))
    same(read_poses(path), motion(7), 5e-6)
    with pytest.raises(ValueError, match="pose 0 has no contacts"):
        written(CsvSink(tmp_path / "b.csv", contacts=True), motion(1))


def test_csv_in_blocks(tmp_path):
    poses = motion(10)
    many = [poses[i % 10]._replace(index=i, time_s=1.7e9 + i / 60) for i in range(BLOCK + 5)]
    written(CsvSink(tmp_path / "a.csv"), many)
    assert [len(block.frames) for block in read_blocks(tmp_path / "a.csv")] == [BLOCK, 5]
    assert read_poses(tmp_path / "a.csv").frames.tolist() == list(range(BLOCK + 5))
    lines = (tmp_path / "a.csv").read_text().splitlines(keepends=True)
    bad = tmp_path / "b.csv"
    bad.write_text("".join([*lines[:-2], lines[-1], lines[-2]]))
    with pytest.raises(EdgeposeError, match=rf"row {BLOCK + 6} has frame {BLOCK + 3} after"):
        read_poses(bad)
    bad.write_text("".join([*lines[: BLOCK + 3], "1,2\n"]))
    with pytest.raises(EdgeposeError, match=rf"row {BLOCK + 4} has 2 columns"):
        read_poses(bad)


# --- NPZ ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("moves", [False, True])
def test_npz_comes_back(tmp_path, moves):
    poses = motion(50, moves)
    sink = NpzSink(tmp_path / "a.npz", 60.0, moves)
    assert [path.name for path in tmp_path.iterdir()] == ["a.part.csv"]
    written(sink, poses)
    sink.close()
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]
    assert is_poses(tmp_path / "a.npz")
    back = read_poses(tmp_path / "a.npz")
    same(back, poses)
    assert back.rate == 60.0
    same(PoseSequence(*back), list(back.pose_frames()))


def test_npz_has_the_keys_of_amass_in_a_world_with_z_up(tmp_path):
    poses = motion(50)
    written(NpzSink(tmp_path / "a.npz", 60.0, True), poses)
    with np.load(tmp_path / "a.npz", allow_pickle=False) as archive:
        arrays = {key: archive[key] for key in archive.files}
    assert arrays["poses"].shape == (50, 72)
    assert arrays["betas"].shape == (16,)
    assert str(arrays["gender"]) == "neutral"
    assert arrays["mocap_framerate"] == 60.0
    # Up is Z, where their x is ours and their y is what lies behind us. SMPL adds its own pelvis, unturned.
    wanted = poses[9].translation[[0, 2, 1]] * [1, -1, 1] - AVERAGE_PELVIS
    np.testing.assert_allclose(arrays["trans"][9], wanted, atol=1e-6)
    upright = Rotation.from_euler("x", 90, degrees=True)
    wanted = (upright * Rotation.from_matrix(poses[9].rotations[0])).as_rotvec()
    np.testing.assert_allclose(arrays["poses"][9, :3], wanted, atol=2e-6)
    elbow = 3 * JOINTS.index("left_elbow")
    wanted = Rotation.from_matrix(poses[9].rotations[18]).as_rotvec()
    np.testing.assert_allclose(arrays["poses"][9, elbow : elbow + 3], wanted, atol=2e-6)
    # The reader of motion capture, which knows nothing of this writer.
    read = read_motion(tmp_path / "a.npz")
    assert read.rate == 60.0
    rotations = np.stack([pose.rotations for pose in poses])
    np.testing.assert_allclose(read.rotations, global_rotations(rotations), atol=1e-5)
    moved = np.array([pose.translation - poses[0].translation for pose in poses])
    np.testing.assert_allclose(read.translation - read.translation[0], moved, atol=1e-5)


AVERAGE_PELVIS = np.array([0.0, -0.22, 0.03])
"""Of SMPL's template: below the model's origin, and a little in front of it."""


@pytest.mark.parametrize(
    ("width", "said", "pelvis"),
    [
        (72, {}, AVERAGE_PELVIS),
        (156, {"surface_model_type": "smplh"}, AVERAGE_PELVIS),
        (165, {"surface_model_type": "smplx"}, [0.0, -0.35, 0.01]),
        (165, {"surface_model_type": "smplx_locked_head"}, [0.0, -0.35, 0.01]),
        (165, {}, [0.0, -0.35, 0.01]),
        (156, {"pelvis_offset": np.array([0.1, 0.2, 0.3])}, [0.1, 0.2, 0.3]),
    ],
)
def test_the_pelvis_of_an_amass_file(tmp_path, width, said, pelvis):
    """SMPL: the pelvis is at `trans` plus its place in the template, however the body is turned."""
    rng = np.random.default_rng(0)
    poses, trans = rng.normal(scale=0.3, size=(5, width)), rng.normal(size=(5, 3))
    np.savez(tmp_path / "a.npz", poses=poses, trans=trans, mocap_framerate=60.0, **said)
    x, y, z = (trans + pelvis).T
    np.testing.assert_allclose(
        read_poses(tmp_path / "a.npz").translation, np.stack([x, z, -y], 1), atol=1e-12
    )


def test_npz_that_edgepose_wrote_before_the_pelvis_was_told(tmp_path):
    poses = motion(5)
    written(NpzSink(tmp_path / "a.npz", 60.0, True), poses)
    with np.load(tmp_path / "a.npz") as archive:
        arrays = dict(archive)
    arrays["trans"] = arrays["trans"] + arrays.pop("pelvis_offset")  # as it was then: the pelvis itself
    np.savez(tmp_path / "b.npz", **arrays)
    same(read_poses(tmp_path / "b.npz"), poses)


@pytest.mark.parametrize("joints", [24, 52, 55])
def test_npz_with_place(tmp_path, joints):
    poses = [pose._replace(rotations=pose.rotations.copy()) for pose in touching(9)]
    for pose in poses:
        pose.rotations[22:] = np.eye(3)
    written(NpzSink(tmp_path / "a.npz", 60.0, True, True, joints), poses)
    same(read_poses(tmp_path / "a.npz"), poses)


@pytest.mark.parametrize("way", [("npz", "csv"), ("bvh", "npz"), ("csv", "bvh"), ("npz", "bvh")])
def test_convert_keeps_the_place(tmp_path, way):
    poses, path = touching(30), tmp_path / "a.csv"
    written(CsvSink(path, translation=True, contacts=True), poses)
    for i, ending in enumerate(way):
        source, path = path, tmp_path / f"{i}.{ending}"
        convert_poses(source, path)
    read = read_poses(path)
    np.testing.assert_allclose(read.translation, [pose.translation for pose in poses], atol=1e-5)
    if "bvh" in way:
        assert read.contacts is None
    else:
        np.testing.assert_allclose(read.contacts, [pose.contacts for pose in poses], atol=1e-6)


def test_npz_of_others(tmp_path):
    rng = np.random.default_rng(0)
    poses = rng.normal(scale=0.3, size=(20, 156))
    np.savez(tmp_path / "a.npz", poses=poses, trans=np.zeros((20, 3)), mocap_frame_rate=np.array(120.0))
    read = read_poses(tmp_path / "a.npz")
    assert read.rate == 120.0
    assert read.translation is None
    assert read.status == ["ok"] * 20
    np.testing.assert_allclose(
        read.rotations[:, 21], Rotation.from_rotvec(poses[:, 63:66]).as_matrix(), atol=1e-12
    )
    assert (read.rotations[:, 22:] == np.eye(3)).all()  # fingers are no hands


@pytest.mark.parametrize("key", ["mocap_framerate", "mocap_frame_rate", "fps"])
def test_npz_with_root_and_body_apart(tmp_path, key):
    vectors = np.random.default_rng(0).normal(scale=0.3, size=(20, 66))
    np.savez(tmp_path / "a.npz", poses=vectors, **{key: 120.0})
    np.savez(tmp_path / "b.npz", root_orient=vectors[:, :3], pose_body=vectors[:, 3:], **{key: [120.0]})
    whole, parts = read_poses(tmp_path / "a.npz"), read_poses(tmp_path / "b.npz")
    assert is_poses(tmp_path / "b.npz")
    assert (whole.rate, parts.rate) == (120.0, 120.0)
    np.testing.assert_array_equal(parts.rotations, whole.rotations)


@pytest.mark.parametrize(("joints", "model"), [(24, "smpl"), (52, "smplh"), (55, "smplx")])
def test_npz_with_the_joints_of_other_models(tmp_path, joints, model):
    """Tools of AMASS take joints by their place: 22 of the body, SMPL-X's jaw and eyes, 30 of the fingers."""
    poses = [pose._replace(rotations=pose.rotations.copy()) for pose in motion(5, moves=False)]
    written(NpzSink(tmp_path / "a.npz", joints=joints), poses)
    with np.load(tmp_path / "a.npz") as archive:
        vectors = archive["poses"].reshape(5, -1, 3)
        assert str(archive["surface_model_type"]) == model
        assert archive["mocap_framerate"] == archive["mocap_frame_rate"] == 60.0
    assert vectors.shape == (5, joints, 3)
    if joints > 24:
        assert (vectors[:, 22:] == 0.0).all()
    wanted = Rotation.from_matrix(np.stack([pose.rotations[1:22] for pose in poses]).reshape(-1, 3, 3))
    np.testing.assert_allclose(vectors[:, 1:22].reshape(-1, 3), wanted.as_rotvec(), atol=2e-6)
    read = read_poses(tmp_path / "a.npz").rotations
    np.testing.assert_allclose(read[:, :22], [pose.rotations[:22] for pose in poses], atol=2e-6)


def test_true_poses_of_a_recording_are_in_the_body_frame(tmp_path):
    vectors = np.random.default_rng(0).normal(scale=0.3, size=(20, 72))
    with np.load(REAL) as archive:
        np.savez(tmp_path / "a.npz", **archive, poses=vectors, mocap_framerate=np.array(60.0))
    assert not is_poses(tmp_path / "a.npz")
    read = read_poses(tmp_path / "a.npz")
    np.testing.assert_allclose(
        read.rotations[:, 0], Rotation.from_rotvec(vectors[:, :3]).as_matrix(), atol=1e-12
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"poses": None}, "no poses in it"),
        ({"poses": np.zeros((0, 72))}, "no poses in it"),
        ({"poses": np.zeros((5, 63))}, r"'poses' must be \(frames, 72\)"),
        ({"poses": np.full((5, 72), np.nan)}, "a number in 'poses' of frame 0 is not finite"),
        ({"poses": np.array([["a"] * 72] * 5)}, ", not numbers"),
        ({"trans": np.full((5, 3), 1e7)}, "a number in 'trans' of frame 0 is not finite, or far too large"),
        ({"trans": np.zeros((4, 3))}, r"'trans' is float64 \(4, 3\), not numbers \(5, 3\)"),
        (
            {"time_s": None, "mocap_framerate": None, "mocap_frame_rate": None},
            "needs one number 'mocap_framerate'",
        ),
        ({"time_s": None, "mocap_framerate": np.array(0.0)}, "a frame rate of 0 Hz is not possible"),
        ({"frame": np.array([0, 1, 1, 2, 3])}, "do not increase"),
        ({"held": np.zeros((5, 5), bool)}, "'held' is bool"),
        ({"contacts": np.zeros((5, 6))}, r"'contacts' is float64 \(5, 6\), not numbers \(5, 7\)"),
        ({"contacts": np.full((5, 7), 1.5)}, "a number in 'contacts' is not a probability from 0 to 1"),
        (
            {"trans": np.ones((5, 3)), "pelvis_offset": np.ones(2)},
            r"'pelvis_offset' is .* not numbers \(3,\)",
        ),
        ({"poses": np.array([None] * 5)}, "not a complete NPZ file .*pickle"),
    ],
)
def test_damaged_npz(tmp_path, change, message):
    path = tmp_path / "a.npz"
    written(NpzSink(path), motion(5, moves=False))
    with np.load(path) as archive:
        arrays = {**archive, **change}
    np.savez(path, **{key: value for key, value in arrays.items() if value is not None})
    with pytest.raises(EdgeposeError, match=message) as info:
        read_poses(path)
    assert str(path) in str(info.value)


def test_cut_npz_and_other_files(tmp_path):
    path = tmp_path / "a.npz"
    written(NpzSink(path), motion(5, moves=False))
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    for i in range(100):
        cut = bytearray(whole[: rng.integers(len(whole))] if i % 2 else whole)
        for place in rng.integers(len(cut), size=3) if cut else ():
            cut[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(cut)
        said = ""
        try:
            read_poses(path)
        except EdgeposeError as error:
            said = str(error)
        assert "\n" not in said
    with pytest.raises(EdgeposeError, match="No such file"):
        read_poses(tmp_path / "nothing.npz")
    entry = bytearray(whole)
    size_at = entry.index(b"PK\x01\x02") + 24  # of the first member, as the archive's directory declares it
    entry[size_at : size_at + 4] = b"\xf0\xff\xff\xff"
    path.write_bytes(entry)
    with pytest.raises(EdgeposeError, match="unpacks to 4096 MB"):
        read_poses(path)


def test_a_recording_is_no_file_of_poses(tmp_path):
    assert not is_poses(REAL)
    write_csv(tmp_path / "a.csv", read_recording(REAL))
    assert not is_poses(tmp_path / "a.csv")
    with pytest.raises(EdgeposeError, match="no poses in it"):
        read_poses(REAL)


# --- BVH ----------------------------------------------------------------------------------------------------


def test_bvh_by_an_independent_reader(tmp_path):
    poses = motion(40)
    body = default_body(1.82)
    written(BvhSink(tmp_path / "a.bvh", 60.0, body), poses)
    root = bvhio.readAsHierarchy(str(tmp_path / "a.bvh"))
    order = [joint for joint, _, _ in root.layout()]
    assert [joint.Name for joint in order] == [JOINTS[i] for i in depth_first()]
    wanted = joints(poses, body.offsets)
    for frame in (0, 1, 17, 39):
        root.loadPose(frame)
        for joint in order:
            place = np.array(joint.PositionWorld.to_tuple()) / 100.0
            error = np.linalg.norm(place - wanted[frame, JOINTS.index(joint.Name)])
            assert error < 1e-4, (frame, joint.Name)
    assert bvhio.readAsBvh(str(tmp_path / "a.bvh")).FrameTime == pytest.approx(1 / 60, abs=1e-8)


def test_bvh_in_metres_with_a_t_pose_first(tmp_path):
    poses = [pose._replace(translation=np.array([0.4, 0.9, -1.0])) for pose in motion(20)]
    body = default_body(1.82)
    written(BvhSink(tmp_path / "a.bvh", 60.0, body, "mixamo", "m", "t-pose"), poses)
    root = bvhio.readAsHierarchy(str(tmp_path / "a.bvh"))
    standing = forward_kinematics(np.tile(np.eye(3), (24, 1, 1)), body.offsets)[1]
    standing += [0.4, -standing[:, 1].min(), -1.0]
    for frame, wanted in ((0, standing), (1, joints(poses, body.offsets)[0])):
        root.loadPose(frame)
        for joint, _, _ in root.layout():
            place = np.array(joint.PositionWorld.to_tuple())
            index = BVH_NAMES["mixamo"].index(joint.Name)
            assert np.linalg.norm(place - wanted[index]) < 2e-6, (frame, joint.Name)
    assert len(bvhio.readAsBvh(str(tmp_path / "a.bvh")).Root.Keyframes) == 21
    again = read_poses(tmp_path / "a.bvh")  # the unit shows in the shanks
    np.testing.assert_allclose(again.translation[1:], [pose.translation for pose in poses], atol=1e-6)


def test_bvh_by_the_reader_of_motion_capture(tmp_path):
    poses = motion(700)  # more than one block
    written(BvhSink(tmp_path / "a.bvh"), poses)
    read = read_bvh(tmp_path / "a.bvh")
    assert read.rate == 60.0
    order = [read.names.index(name) for name in JOINTS]
    places = forward(read)[1][:, order] / 100.0
    assert np.abs(places - joints(poses, default_body().offsets)).max() < 1e-4


def test_bvh_angles_do_not_leap(tmp_path):
    poses = motion(700)
    written(BvhSink(tmp_path / "a.bvh"), poses)
    table = np.loadtxt((tmp_path / "a.bvh").read_text().partition("Frame Time")[2].splitlines()[1:])
    pelvis_y = table[:, 5]
    assert np.abs(np.diff(table[:, 3:], axis=0)).max() < 350.0
    assert len(table) == 700
    assert np.isfinite(pelvis_y).all()


def test_bvh_without_translation_stands_on_the_ground(tmp_path):
    straight = PoseFrame(0, 0.0, np.tile(np.eye(3, dtype=np.float32), (24, 1, 1)), np.zeros(24))
    written(BvhSink(tmp_path / "a.bvh"), [straight])
    places = forward(read_bvh(tmp_path / "a.bvh"))[1][0] / 100.0
    assert places[:, 1].min() == pytest.approx(0.0, abs=1e-4)
    assert 0.8 < places[0, 1] < 1.1


# --- runs that end badly ------------------------------------------------------------------------------------

PRELUDE = """
import sys, signal, time, numpy as np
from edgepose.pose import PoseFrame, parse_status
from edgepose.errors import EdgeposeError, FileFormatError
from edgepose.sinks.bvh import BvhSink
from edgepose.sinks.npz import NpzSink
def pose(i): return PoseFrame(i, i / 60, np.tile(np.eye(3), (24, 1, 1)), np.zeros(24))
kind = BvhSink if sys.argv[1].endswith('bvh') else NpzSink
"""


def run_python(code: str, *args: str) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, "-c", PRELUDE + code, *args], text=True, stdout=subprocess.PIPE)


@pytest.mark.parametrize("name", ["a.npz", "a.bvh"])
def test_an_interrupted_run_leaves_a_whole_file(tmp_path, name):
    code = (
        "try:\n"
        "    with kind(sys.argv[1]) as sink:\n"
        "        for i in range(250): sink.write(pose(i))\n"
        "        print('written', flush=True); time.sleep(60)\n"
        "except KeyboardInterrupt: pass\n"
    )
    process = run_python(code, str(tmp_path / name))
    assert process.stdout.readline() == "written\n"
    process.send_signal(signal.SIGINT)
    process.communicate()
    assert [path.name for path in tmp_path.iterdir()] == [name]
    if name == "a.npz":
        assert len(read_poses(tmp_path / name).frames) == 250
    else:
        assert len(read_bvh(tmp_path / name).rotations) == 250


@pytest.mark.parametrize("name", ["a.npz", "a.bvh"])
def test_a_killed_run_leaves_what_was_on_the_disk(tmp_path, name):
    code = (
        "import edgepose.sinks.pose_file as p\n"
        "p.FLUSH_S = 0.05\n"
        "sink = kind(sys.argv[1])\n"
        "for i in range(100):\n"
        "    sink.write(pose(i)); time.sleep(0.002)\n"
        "print('written', flush=True); time.sleep(60)\n"
    )
    process = run_python(code, str(tmp_path / name))
    assert process.stdout.readline() == "written\n"
    process.kill()
    process.communicate()
    if name == "a.npz":
        poses = len(read_poses(tmp_path / "a.part.csv").frames)
    else:
        poses = len(read_bvh(tmp_path / name).rotations)
    assert 0 < poses <= 100


@pytest.mark.parametrize("name", ["a.npz", "a.bvh"])
def test_a_disk_that_fills_up(tmp_path, name):
    code = (
        "import resource\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (30000, 30000))\n"
        "try:\n"
        "    with kind(sys.argv[1]) as sink:\n"
        "        for i in range(2000): sink.write(pose(i))\n"
        "except EdgeposeError as error: print(error)\n"
    )
    said, _ = run_python(code, str(tmp_path / name)).communicate(timeout=120)
    assert re.match(r"cannot write poses to .*: File too large\n", said)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    # An NPZ file is smaller than its CSV file, so that all poses of that fit.
    read = read_poses if name == "a.npz" else read_bvh
    assert 20 < len(read(tmp_path / name).rotations) < 200


def test_npz_that_does_not_fit(tmp_path):
    sink = NpzSink(tmp_path / "a.npz")
    for pose in motion(5, moves=False):
        sink.write(pose)
    (tmp_path / "a.npz").mkdir()  # what came into its place meanwhile
    with pytest.raises(EdgeposeError, match=r"cannot write poses .*all poses are in .*a\.part\.csv"):
        sink.close()
    assert len(read_poses(tmp_path / "a.part.csv").frames) == 5


@pytest.mark.parametrize("kind", [BvhSink, NpzSink])
def test_unwritable(tmp_path, kind):
    with pytest.raises(EdgeposeError, match="folder does not exist"):
        kind(tmp_path / "no" / "a")
    with pytest.raises(EdgeposeError, match=r"cannot write \w+ to"):
        kind(tmp_path)
    with pytest.raises(EdgeposeError, match=r"must be a file|needs the name of a file"):
        kind("-")
    assert list(tmp_path.iterdir()) == []


def test_bvh_to_a_device():
    with pytest.raises(EdgeposeError, match="must be a file"):
        BvhSink("/dev/null")


def test_npz_without_poses(tmp_path):
    written(NpzSink(tmp_path / "a.npz"), [])
    assert list(tmp_path.iterdir()) == []


def standing(index):
    return PoseFrame(index, index / 60, np.tile(np.eye(3), (24, 1, 1)), np.zeros(24))


def test_times_that_do_not_rise(tmp_path):
    with CsvSink(tmp_path / "a.csv") as sink:
        for i, time_s in enumerate([5.0, 5.1, 5.1]):
            sink.write(standing(i)._replace(time_s=time_s))
    with pytest.raises(EdgeposeError, match=r"a\.csv: .* row 4 has time 5\.1\d* s as the row before; write"):
        read_poses(tmp_path / "a.csv")
    assert len(salvage_poses(tmp_path / "a.csv")[0].frames) == 2
    np.savez(tmp_path / "a.npz", poses=np.zeros((3, 72)), time_s=[1.0, 3.0, 2.0], frame=[0, 1, 2])
    with pytest.raises(EdgeposeError, match="the times in 'time_s' do not increase"):
        read_poses(tmp_path / "a.npz")


@pytest.mark.parametrize("end", [b"\0" * 20000, b"3000,\xff\n"])
def test_rows_before_rubbish_are_good(tmp_path, end):
    path = tmp_path / "a.csv"
    with CsvSink(path) as sink:
        for i in range(3000):
            sink.write(standing(i))
    with path.open("ab") as file:
        file.write(end)
    poses, damage = salvage_poses(path)
    assert len(poses.frames) == 3000
    assert "row 3002" in damage


def test_a_member_that_is_no_array(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("poses", b"abc")
    with pytest.raises(EdgeposeError, match="no poses in it"):
        read_poses(tmp_path / "a.npz")


def test_poses_of_a_run_that_was_cut_off_are_not_written_over(tmp_path):
    part = tmp_path / "walk.part.csv"
    with CsvSink(part) as sink:
        sink.write(standing(0))
    before = part.read_bytes()
    with pytest.raises(EdgeposeError, match=r"walk\.part\.csv already exists.*edgepose convert"):
        NpzSink(tmp_path / "walk.npz")
    assert part.read_bytes() == before


def test_a_bad_first_row_is_the_error_of_a_file(tmp_path):
    with CsvSink(tmp_path / "a.csv") as sink:
        sink.write(motion(1)[0])
    header, row = (tmp_path / "a.csv").read_text().splitlines()
    (tmp_path / "a.csv").write_text(f"{header}\n{row[:-3]}x\n")
    with pytest.raises(FileFormatError, match="row 2"):
        read_poses(tmp_path / "a.csv")
