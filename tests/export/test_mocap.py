import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest

from edgepose.errors import EdgeposeError
from edgepose.formats.bvh import read_bvh
from edgepose.formats.joint_tree import forward
from edgepose.rotations import geodesic_angle, matrix_to_rotvec, rotation_about_axis, rotvec_to_matrix
from edgepose.skeleton import local_from_global
from edgepose_export.mocap import Motion, pieces, read_motion, resample
from edgepose_export.mocap.amc import find_asf, read_amc, read_asf
from edgepose_export.mocap.rest_pose import REST_DIRECTIONS
from edgepose_export.mocap.skeleton_roles import find_roles

DATA = Path(__file__).parents[1] / "data" / "mocap"
CMU = DATA / "07_01.bvh"
AMC = DATA / "07_01.amc"
WALK = DATA / "dataset-2_walk_normal_001.bvh"
STAND = DATA / "dataset-2_raise-up-right-hand_normal_001.bvh"
AXES = {"+x": np.array([1.0, 0, 0]), "-x": np.array([-1.0, 0, 0]), "-y": np.array([0, -1.0, 0])}


def degrees_between(u, v):
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(u, v), axis=-1), (u * v).sum(-1)))


def without_heading(rotations):
    yaw = np.arctan2(rotations[:, 0, 0, 2], rotations[:, 0, 2, 2])
    return rotation_about_axis("y", -yaw)[:, None] @ rotations


# --- real takes ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "reader", "drop"),
    [(CMU, read_bvh, 1), (AMC, read_amc, 0), (WALK, read_bvh, 0), (STAND, read_bvh, 0)],
)
def test_limbs_point_where_the_source_points(path, reader, drop):
    recording = reader(path)
    _, positions = forward(recording)
    motion = read_motion(path)
    limbs = find_roles(recording.names, recording.parents).limbs
    assert set(limbs) == set(REST_DIRECTIONS)
    for limb, (start, end) in limbs.items():
        source = (positions[:, end] - positions[:, start])[drop:]
        assert degrees_between(motion.rotations[:, limb] @ REST_DIRECTIONS[limb], source).max() < 0.005


def test_amc_agrees_with_bvh_of_the_same_take():
    amc, bvh = read_motion(AMC), read_motion(CMU)
    assert len(amc.rotations) == len(bvh.rotations) == 60
    assert amc.rate == bvh.rate == 120.0
    assert np.degrees(geodesic_angle(amc.rotations, bvh.rotations)).max() < 0.01
    np.testing.assert_allclose(amc.translation, bvh.translation, atol=1e-5)


@pytest.mark.parametrize(
    ("path", "source", "rate", "hip"),
    [
        (CMU, "cmu", 120.0, 0.89),
        (AMC, "cmu", 120.0, 0.89),
        (WALK, "bandai-namco", 30.0, 0.9),
        (STAND, "bandai-namco", 30.0, 0.9),
    ],
)
def test_units_rates_and_rotations(path, source, rate, hip):
    motion = read_motion(path)
    frames = len(motion.rotations)
    assert (motion.source, motion.rate) == (source, rate)
    assert motion.rotations.shape == (frames, 24, 3, 3)
    assert motion.translation.shape == (frames, 3)
    assert motion.translation[:, 1].mean() == pytest.approx(hip, abs=0.06)
    eye = np.broadcast_to(np.eye(3), motion.rotations.shape)
    np.testing.assert_allclose(motion.rotations @ np.swapaxes(motion.rotations, -1, -2), eye, atol=1e-9)
    assert np.linalg.det(motion.rotations).min() > 0.99


@pytest.mark.parametrize("path", [CMU, AMC, WALK])
def test_walking_goes_where_the_pelvis_faces(path):
    motion = read_motion(path)
    way = motion.translation[-1] - motion.translation[0]
    facing = motion.rotations[:, 0, :, 2].mean(axis=0)
    way[1] = facing[1] = 0.0
    assert np.linalg.norm(way) > 0.5
    assert degrees_between(way, facing) < 15


@pytest.mark.parametrize("path", [CMU, AMC, WALK, STAND])
def test_left_is_left_and_up_is_up(path):
    rotations = without_heading(read_motion(path).rotations)
    assert (rotations[:, 0, 1, 1] > 0.95).all()
    # Hanging arms: turned down from +X on the left, from -X on the right, by opposite angles about Z.
    rotvec = np.degrees(matrix_to_rotvec(rotations[0]))
    assert rotvec[16, 2] < -45
    assert rotvec[17, 2] > 45


def test_straight_standing_is_near_the_zero_pose():
    rotvec = np.degrees(matrix_to_rotvec(without_heading(read_motion(STAND).rotations)[:3]))
    trunk = np.linalg.norm(rotvec[:, [0, 3, 6, 9, 12, 13, 14, 15, 7, 8, 10, 11]], axis=-1)
    assert trunk.max() < 8
    assert np.abs(rotvec[:, [1, 2, 4, 5], 0]).max() < 15  # knees of these takes are never quite straight


def test_only_the_right_hand_goes_up():
    rotations = read_motion(STAND).rotations
    right = (rotations[:, 19] @ AXES["-x"])[:, 1]
    left = (rotations[:, 18] @ AXES["+x"])[:, 1]
    assert right.max() > 0.7
    assert left.max() < -0.5


def test_cmu_t_pose_frame_is_the_zero_pose_and_no_motion(tmp_path):
    assert len(read_motion(CMU).rotations) == len(read_bvh(CMU).rotations) - 1
    lines = CMU.read_text().splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("Frame Time"))
    twice = [*lines[: start - 1], "Frames: 2", lines[start], lines[start + 1], lines[start + 1]]
    (tmp_path / "t.bvh").write_text("\n".join(twice))
    rotvec = np.degrees(matrix_to_rotvec(read_motion(tmp_path / "t.bvh").rotations[0]))
    trunk = [0, 3, 6, 9, 12, 13, 14, 15, 7, 8, 10, 11]
    np.testing.assert_allclose(rotvec[trunk], 0.0, atol=1e-6)
    assert np.abs(rotvec[[1, 2, 4, 5]]).max() < 1.5  # its legs stand 1 deg apart, its arms hang by 8 deg
    np.testing.assert_allclose(rotvec[[16, 18, 20, 22], 2], -8.0, atol=0.01)
    np.testing.assert_allclose(rotvec[[17, 19, 21, 23], 2], 8.0, atol=0.01)


def test_zero_frames_after_the_t_pose_are_left_out(tmp_path):
    lines = CMU.read_text().splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("Frame Time"))
    zero = " ".join(["0"] * len(lines[start + 1].split()))
    padded = [*lines[: start - 1], "Frames: 63", *lines[start : start + 2], zero, zero, *lines[start + 2 :]]
    (tmp_path / "t.bvh").write_text("\n".join(padded))
    np.testing.assert_array_equal(read_motion(tmp_path / "t.bvh").rotations, read_motion(CMU).rotations)


def test_cmu_bvh_without_t_pose_takes_the_known_one(tmp_path):
    lines = CMU.read_text().splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("Frame Time"))
    (tmp_path / "t.bvh").write_text(
        "\n".join([*lines[: start - 1], "Frames: 60", lines[start], *lines[start + 2 :]])
    )
    found, whole = read_motion(tmp_path / "t.bvh"), read_motion(CMU)
    assert np.degrees(geodesic_angle(found.rotations, whole.rotations)).max() < 1e-4
    np.testing.assert_array_equal(found.translation, whole.translation)


def test_collars_of_dataset_1_lie_straight(tmp_path):
    renamed = tmp_path / "dataset-1_walk_normal_001.bvh"
    renamed.write_bytes(WALK.read_bytes())
    first, second = read_motion(renamed).rotations, read_motion(WALK).rotations
    turn = np.degrees(matrix_to_rotvec(np.swapaxes(second, -1, -2) @ first))
    np.testing.assert_allclose(turn[:, 13], [[0, 17.5, 0]] * 60, atol=1e-9)
    np.testing.assert_allclose(turn[:, 14], [[0, -17.5, 0]] * 60, atol=1e-9)
    others = [j for j in range(24) if j not in (13, 14)]
    np.testing.assert_allclose(first[:, others], second[:, others], atol=1e-12)


# --- resampling and cutting ---------------------------------------------------------------------------------


def spinning(rate, frames, speed=8.0):
    """Every bone turns about a slanted axis, by more than a turn, so that quaternion signs come up."""
    times = np.arange(frames) / rate
    axis = np.array([0.48, 0.6, 0.64])
    turn = rotvec_to_matrix(np.outer(times * speed, axis))
    return Motion(np.repeat(turn[:, None], 24, axis=1), np.outer(times**2, [0.2, 0.1, 0]), rate, "made")


def test_resampling_follows_a_smooth_motion():
    found, wanted = resample(spinning(30.0, 91)), spinning(60.0, 181)
    assert found.rate == 60.0
    assert len(found.rotations) == 181
    inner = slice(6, -6)  # the ends of a spline are less exact
    assert np.degrees(geodesic_angle(found.rotations, wanted.rotations))[inner].max() < 0.02
    np.testing.assert_allclose(found.translation, wanted.translation, atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(found.rotations), 1.0, atol=1e-9)


def test_resampling_keeps_frames_that_are_on_the_new_grid():
    motion = read_motion(CMU)
    found = resample(motion, 60.0)
    assert len(found.rotations) == 30
    assert geodesic_angle(found.rotations, motion.rotations[::2]).max() < 1e-9
    back = resample(resample(read_motion(WALK), 60.0), 30.0)
    assert geodesic_angle(back.rotations, read_motion(WALK).rotations).max() < 1e-9


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_resampling_very_short_motion(frames):
    found = resample(spinning(30.0, frames), 60.0)
    assert len(found.rotations) == 2 * frames - 1
    assert found.rate == 60.0
    assert np.isfinite(found.rotations).all()


def test_no_spikes_in_accelerations_after_resampling():
    motion = resample(spinning(30.0, 91))
    point = motion.rotations[:, 0] @ np.array([0.3, 0.0, 0.0])
    acceleration = np.linalg.norm(np.diff(point, 2, axis=0), axis=1)[6:-6] * 60.0**2
    assert np.abs(np.diff(acceleration)).max() < 0.1 * acceleration.mean()


def test_pieces_are_cut_at_jumps():
    motion = spinning(120.0, 600)
    assert [len(p.rotations) for p in pieces(motion)] == [600]
    motion.rotations[200:, 0] = motion.rotations[200:, 0] @ rotation_about_axis("y", np.pi)
    motion.translation[450:] += 5.0
    motion.rotations[300, 7] = np.eye(3)  # feet do not count
    parts = pieces(motion)
    assert [len(p.rotations) for p in parts] == [200, 250, 150]
    np.testing.assert_array_equal(parts[1].rotations, motion.rotations[200:450])
    assert [len(p.rotations) for p in pieces(motion, shortest=2.0)] == [250]


# --- AMASS --------------------------------------------------------------------------------------------------


def amass_fields(motion, width, rate_name="mocap_framerate"):
    """The fields of an AMASS file, whose world has Z up, for a motion in our world."""
    rotvec = matrix_to_rotvec(local_from_global(motion.rotations))
    rotvec[:, 0] = matrix_to_rotvec(rotation_about_axis("x", np.pi / 2) @ motion.rotations[:, 0])
    poses = np.zeros((len(rotvec), width))
    poses[:, : min(width, 72)] = rotvec.reshape(len(rotvec), 72)
    trans = motion.translation @ rotation_about_axis("x", np.pi / 2).T
    return {"poses": poses, "trans": trans, rate_name: np.array(motion.rate), "gender": np.array("neutral")}


@pytest.mark.parametrize(
    ("width", "name"), [(72, "mocap_framerate"), (156, "mocap_frame_rate"), (165, "mocap_frame_rate")]
)
def test_amass_round_trip(tmp_path, width, name):
    motion = read_motion(WALK)
    np.savez(tmp_path / "m.npz", **amass_fields(motion, width, name))
    found = read_motion(tmp_path / "m.npz")
    assert (found.rate, found.source) == (30.0, "amass")
    assert geodesic_angle(found.rotations[:, :22], motion.rotations[:, :22]).max() < 1e-9
    np.testing.assert_allclose(found.translation, motion.translation, atol=1e-12)
    if width > 72:  # 22 and 23 are fingers or a jaw there
        np.testing.assert_allclose(found.rotations[:, 22], found.rotations[:, 20], atol=1e-12)


def test_amass_standing_person_is_the_zero_pose(tmp_path):
    poses = np.zeros((2, 156))
    poses[:, 0] = np.pi / 2  # stands upright where Z is up
    np.savez(tmp_path / "m.npz", poses=poses, trans=[[1.0, 2.0, 0.9]] * 2, mocap_framerate=100)
    found = read_motion(tmp_path / "m.npz")
    np.testing.assert_allclose(found.rotations, np.broadcast_to(np.eye(3), (2, 24, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(found.translation[0], [1.0, 0.9, -2.0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"poses": np.zeros((3, 66))}, "72 or more"),
        ({"poses": np.zeros(72)}, "72 or more"),
        ({"poses": np.full((3, 72), np.nan)}, "'poses' is not finite, or far too large, in frame 0"),
        ({"trans": np.zeros((2, 3))}, "'trans' must have the shape"),
        ({"trans": np.full((3, 3), np.inf)}, "'trans' is not finite"),
        ({"mocap_framerate": np.array(0.0)}, "frame rate of 0 Hz"),
        ({"mocap_framerate": np.array(np.nan)}, "frame rate of nan Hz"),
        ({"mocap_framerate": np.array([60.0, 60.0])}, "one number"),
        ({"poses": np.array([{"a": 1}], dtype=object)}, "not a readable npz"),
        ({"poses": np.array(["x"])}, "not a readable npz"),
    ],
)
def test_amass_hostile_fields(tmp_path, change, message):
    fields = {"poses": np.zeros((3, 72)), "trans": np.zeros((3, 3)), "mocap_framerate": np.array(60.0)}
    np.savez(tmp_path / "m.npz", **(fields | change))
    with pytest.raises(EdgeposeError, match=message):
        read_motion(tmp_path / "m.npz")


@pytest.mark.parametrize(
    "content", [b"", b"PK\x03\x04 no zip", b"text", pickle.dumps([1, 2]), b"\x93NUMPY\x01\x00"]
)
def test_amass_that_is_no_archive(tmp_path, content):
    (tmp_path / "m.npz").write_bytes(content)
    with pytest.raises(EdgeposeError, match=r"m\.npz"):
        read_motion(tmp_path / "m.npz")


def test_amass_other_archives(tmp_path):
    np.savez(tmp_path / "shape.npz", betas=np.zeros(10))
    with zipfile.ZipFile(tmp_path / "zip.npz", "w") as archive:
        archive.writestr("poses.npy", b"not numpy")
    with (tmp_path / "array.npz").open("wb") as stream:
        np.save(stream, np.zeros(3))
    for name in ("shape.npz", "zip.npz", "array.npz", "missing.npz"):
        with pytest.raises(EdgeposeError, match=name):
            read_motion(tmp_path / name)


# --- BVH text -----------------------------------------------------------------------------------------------

SMALL = """HIERARCHY
ROOT base
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT arm
  {
    OFFSET 0 2 0
    CHANNELS 3 Yrotation Zrotation Xrotation
    JOINT slide
    {
      OFFSET 1 0 0
      CHANNELS 1 Zposition
      End Site
      {
        OFFSET 0 0 1
      }
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.0333333
1 2 3 0 0 0 0 0 0 0
1 2 3 90 0 0 20 30 40 5
"""


def small(tmp_path, text):
    path = tmp_path / "small.bvh"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_bvh_channels_in_any_order(tmp_path):
    found = read_bvh(small(tmp_path, SMALL))
    assert found.names == ("base", "arm", "slide")
    assert found.parents == (-1, 0, 1)
    assert found.rate == 30.0
    np.testing.assert_array_equal(found.offsets, [[0, 0, 0], [0, 2, 0], [1, 0, 0]])
    y, z, x = (
        rotation_about_axis(axis, np.radians(angle)) for axis, angle in zip("yzx", (20, 30, 40), strict=True)
    )
    np.testing.assert_allclose(found.rotations[1, 1], y @ z @ x, atol=1e-12)
    np.testing.assert_array_equal(found.rotations[1, 2], np.eye(3))
    np.testing.assert_array_equal(found.positions[:, 2], [[1, 0, 0], [1, 0, 5]])
    rotations, positions = forward(found)
    np.testing.assert_allclose(positions[1, 1], [1 - 2, 2, 3], atol=1e-12)
    np.testing.assert_allclose(positions[1, 2], positions[1, 1] + rotations[1, 1] @ [1, 0, 5], atol=1e-12)


def test_bvh_line_ends_tabs_and_empty_lines_do_not_matter(tmp_path):
    plain = read_bvh(small(tmp_path, SMALL))
    other = read_bvh(
        small(tmp_path, "\ufeff" + SMALL.replace("\n", " \r\n\r\n").replace("Frames: ", "Frames:\t"))
    )
    np.testing.assert_array_equal(plain.rotations, other.rotations)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("HIERARCHY", "HELLO", "line 1: not a BVH file"),
        ("OFFSET 0 2 0", "OFFSET 0 2", "line 8: 3 numbers were expected, 2 found"),
        ("OFFSET 0 2 0", "OFFSET 0 two 0", "line 8: a number was expected"),
        ("OFFSET 0 2 0", "OFFSET 0 nan 0", "line 8: a number is not finite"),
        ("    OFFSET 0 2 0\n", "", "joint arm has no OFFSET"),
        ("CHANNELS 3", "CHANNELS 4", "line 9: CHANNELS needs"),
        ("Yrotation Zrotation Xrotation\n", "Yrotation Zrotation Wrotation\n", "line 9: CHANNELS needs"),
        ("Yrotation Zrotation Xrotation\n", "Yrotation Zrotation Zrotation\n", "line 9: CHANNELS needs"),
        ("JOINT slide", "JOINT arm", "line 10: joint name 'arm'"),
        ("JOINT slide", "JOINT", "line 10: joint name ''"),
        ("JOINT slide", "ROOT slide", "line 10: ROOT at this place"),
        ("ROOT base\n{", "ROOT base", "line 3: an opening brace was expected"),
        ("}\nMOTION", "MOTION", "MOTION before the hierarchy is closed"),
        ("}\nMOTION", "}\n}\nMOTION", "a brace closes that was not opened"),
        ("MOTION", "{\nMOTION", "a brace opens without a joint"),
        ("MOTION\n", "", "'Frames:' is not expected here"),
        ("Frames: 2", "Frames: 3", "3 frames are announced, 2 are there"),
        ("Frames: 2", "Frames: 1", "1 frames are announced, 2 are there"),
        ("Frames: 2", "Frames: 999999999999", "are announced"),
        ("Frames: 2", "Frames: -2", "line 22: 'Frames: <count>'"),
        ("0.0333333", "0", "line 23: a frame time of 0 s"),
        ("0.0333333", "nan", "line 23: a number is not finite"),
        ("Frame Time:", "Time:", "line 23: 'Frame Time: <seconds>'"),
        ("20 30 40 5", "20 30 40", "line 25: a frame needs 10 numbers, this line has 9"),
        ("20 30 40 5", "20 30 40 5 6", "line 25: a frame needs 10 numbers, this line has 11"),
        ("20 30 40 5", "20 NaN 40 5", "line 25: a number is not finite"),
        ("20 30 40 5", "20 1e999 40 5", "line 25: a number is not finite"),
        ("20 30 40 5", "20 1e7 40 5", "line 25: a number is not finite, or far too large"),
        ("Frames: 2", "Frames: " + "9" * 5000, "line 22: 'Frames: <count>'"),
        ("20 30 40 5", "20 3O 40 5", "line 25: a number was expected"),
    ],
)
def test_bvh_faults_name_file_and_line(tmp_path, old, new, message):
    assert old in SMALL
    with pytest.raises(EdgeposeError, match=r"small\.bvh") as caught:
        read_bvh(small(tmp_path, SMALL.replace(old, new, 1)))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("keep", range(0, len(SMALL) - 2, 7))
def test_bvh_cut_short_anywhere(tmp_path, keep):
    with pytest.raises(EdgeposeError, match=r"small\.bvh"):
        read_bvh(small(tmp_path, SMALL[:keep]))


def test_bvh_that_is_no_text(tmp_path):
    with pytest.raises(EdgeposeError, match="not a text file"):
        read_bvh(small(tmp_path, b"\xff\xfe\x00\x81"))
    with pytest.raises(EdgeposeError, match="cannot be read"):
        read_bvh(tmp_path / "missing.bvh")
    with pytest.raises(EdgeposeError, match="cannot be read"):
        read_bvh(tmp_path)


def test_bvh_of_great_depth(tmp_path):
    depth = 5000
    joints = "".join(f"JOINT j{i}\n{{\nOFFSET 0 1 0\nCHANNELS 1 Xrotation\n" for i in range(depth))
    head = "HIERARCHY\nROOT r\n{\nOFFSET 0 0 0\nCHANNELS 1 Xrotation\n"
    tail = "}\n" * (depth + 1) + "MOTION\nFrames: 1\nFrame Time: 0.01\n" + "0 " * (depth + 1)
    assert len(read_bvh(small(tmp_path, head + joints + tail)).names) == depth + 1


@pytest.mark.parametrize("offset", ["0 0 0", "-39.0811 0 0"])
def test_bandai_skeleton_with_a_limb_astray(tmp_path, offset):
    lines = WALK.read_text().splitlines()
    at = next(i for i, line in enumerate(lines) if line.split() == ["JOINT", "LowerLeg_L"])
    lines[at + 2] = f"OFFSET {offset}"
    path = tmp_path / "t.bvh"
    path.write_text("\n".join(lines))
    with pytest.raises(EdgeposeError, match="do not lie as in"):
        read_motion(path)


def test_unknown_skeletons_and_kinds(tmp_path):
    with pytest.raises(EdgeposeError, match="unknown skeleton"):
        read_motion(small(tmp_path, SMALL))
    with pytest.raises(EdgeposeError, match=r"\.npz, \.amc and \.bvh"):
        read_motion(tmp_path / "motion.c3d")


# --- ASF / AMC text -----------------------------------------------------------------------------------------


def test_skeleton_is_found_beside_the_motion(tmp_path):
    assert find_asf(AMC) == DATA / "07.asf"
    motion = tmp_path / "12_03.amc"
    motion.write_bytes(AMC.read_bytes())
    with pytest.raises(EdgeposeError, match=r"12\.asf"):
        read_motion(motion)
    (tmp_path / "12.asf").write_bytes((DATA / "07.asf").read_bytes())
    np.testing.assert_array_equal(read_motion(motion).rotations, read_motion(AMC).rotations)


def test_bone_lengths_are_metres():
    body = read_asf(DATA / "07.asf")
    shank = np.linalg.norm(body.offsets[body.names.index("lfoot")])
    assert shank == pytest.approx(7.40507 * 0.0254 / 0.45, rel=1e-5)


def write_amc(tmp_path, text):
    (tmp_path / "07.asf").write_bytes((DATA / "07.asf").read_bytes())
    path = tmp_path / "07_01.amc"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (":DEGREES\n1\n", ":DEGREES\n", "line 3: expected a frame number"),
        ("\n2\n", "\n5\n", "expected frame 2, found 5"),
        ("rradius 18.5852\n", "", "frame 1 lacks rradius"),
        ("rradius 18.5852\n", "rradius 18.5852\nrradius 18.5852\n", "bone 'rradius' occurs twice"),
        ("rradius 18.5852", "rradius 18.5852 3", "1 numbers were expected, 2 found"),
        ("rradius 18.5852", "rradius nan", "a number is not finite"),
        ("rradius 18.5852", "rradius x", "a number was expected"),
        ("rradius 18.5852", "tail 18.5852", "bone 'tail' is not in the skeleton"),
    ],
)
def test_amc_faults_name_file_and_line(tmp_path, old, new, message):
    text = AMC.read_text()
    assert old in text
    with pytest.raises(EdgeposeError, match=r"07_01\.amc, line \d+") as caught:
        read_motion(write_amc(tmp_path, text.replace(old, new, 1)))
    assert message in str(caught.value)


def test_amc_cut_short(tmp_path):
    lines = AMC.read_text().splitlines()
    with pytest.raises(EdgeposeError, match="cut short"):
        read_motion(write_amc(tmp_path, "\n".join(lines[:-3])))
    with pytest.raises(EdgeposeError, match="no frames"):
        read_motion(write_amc(tmp_path, ":DEGREES\n"))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("length 0.45", "length 0", "length unit must be positive"),
        ("length 6.92462", "", "a bone without length"),
        ("direction 0.34202 -0.939693 0", "direction 0.34202 -0.939693", "3 numbers were expected"),
        ("axis 0 0 20  XYZ", "axis 0 0 20  XYY", "three angles and their order"),
        ("dof rx ry rz", "dof rx ry rq", "may hold only rx, ry, rz"),
        ("name ltibia", "name lfemur", "'lfemur' is defined twice"),
        ("order TX TY TZ RX RY RZ", "order TX TY TZ", "root's order"),
        ("lfemur ltibia", "lfemur tail", "'tail' is not defined"),
        ("root lhipjoint rhipjoint lowerback", "root lhipjoint rhipjoint", "has no parent"),
    ],
)
def test_asf_faults(tmp_path, old, new, message):
    text = (DATA / "07.asf").read_text()
    assert old in text
    path = tmp_path / "07.asf"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(EdgeposeError, match=r"07\.asf") as caught:
        read_asf(path)
    assert message in str(caught.value)


@pytest.mark.parametrize("keep", [0, 10, 300, 1000, 3000, -40])
def test_asf_cut_short(tmp_path, keep):
    path = tmp_path / "07.asf"
    path.write_text((DATA / "07.asf").read_text()[:keep])
    with pytest.raises(EdgeposeError, match=r"07\.asf"):
        read_asf(path)
