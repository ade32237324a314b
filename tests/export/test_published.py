"""Readers of published recordings, on small files of their makers' layouts."""

import pickle
import re

import numpy as np
import pytest
from click.testing import CliRunner

from edgepose import rotations as rot
from edgepose.calibration import GRAVITY
from edgepose.errors import EdgeposeError
from edgepose.placements import BONES, PLACEMENTS
from edgepose.skeleton import global_rotations
from edgepose_export.cli.evaluate import evaluate
from edgepose_export.datasets import read_dip, read_published, read_totalcapture, read_vicon
from edgepose_export.evaluation.evaluate import takes_of

FRAMES = 12
DIP_PLACES = (7, 8, 11, 12, 0, 2)


@pytest.fixture
def truth():
    """Poses (T, 72), the bones' orientations (T, 6, 3, 3), accelerations in T (T, 6, 3)."""
    rng = np.random.default_rng(1)
    gt = np.cumsum(0.05 * rng.normal(size=(FRAMES, 72)), axis=0)
    bones = global_rotations(rot.rotvec_to_matrix(gt.reshape(-1, 24, 3)))
    return gt, bones[:, list(BONES)], rng.normal(size=(FRAMES, 6, 3))


def dip_imu(truth):
    gt, orientation, acceleration = truth
    imu_ori, imu_acc = np.zeros((FRAMES, 17, 3, 3)), np.zeros((FRAMES, 17, 3))
    imu_ori[:, DIP_PLACES], imu_acc[:, DIP_PLACES] = orientation, acceleration
    return {"imu_ori": imu_ori, "imu_acc": imu_acc, "gt": gt}


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_dip_imu(truth, tmp_path, protocol):
    path = tmp_path / "s_09" / "01.pkl"
    path.parent.mkdir()
    path.write_bytes(pickle.dumps(dip_imu(truth), protocol))
    take = read_dip(path)
    gt, orientation, acceleration = truth
    assert take.name == "s_09_01"
    assert "non-commercial" in take.license
    np.testing.assert_allclose(take.orientation, orientation, atol=1e-6)
    np.testing.assert_allclose(take.acceleration, acceleration, atol=1e-6)
    np.testing.assert_allclose(take.pose, rot.rotvec_to_matrix(gt.reshape(-1, 24, 3)), atol=1e-6)


def test_lost_packets_have_the_nearest_frame(truth, tmp_path):
    content = dip_imu(truth)
    content["imu_ori"][3:6, 7] = np.nan
    content["imu_acc"][:2, 0] = np.nan
    path = tmp_path / "01.pkl"
    path.write_bytes(pickle.dumps(content))
    take = read_dip(path)
    arm, head = PLACEMENTS.index("left_forearm"), PLACEMENTS.index("head")
    for frame, nearest in ((3, 2), (5, 6)):
        np.testing.assert_allclose(take.orientation[frame, arm], truth[1][nearest, arm], atol=1e-6)
    np.testing.assert_allclose(take.acceleration[:2, head], truth[2][[2, 2], head], atol=1e-6)
    content["imu_acc"][:, 2] = np.nan
    path.write_bytes(pickle.dumps(content))
    with pytest.raises(EdgeposeError, match="pelvis in 'imu_acc': no frame was measured"):
        read_dip(path)


def test_dips_totalcapture(truth, tmp_path):
    gt, orientation, acceleration = truth
    order = [2, 3, 0, 1, 4, 5]  # legs first
    path = tmp_path / "s1_acting1.pkl"
    path.write_bytes(
        pickle.dumps(
            {"ori": orientation[:, order].reshape(FRAMES, 6, 9), "acc": acceleration[:, order], "gt": gt}
        )
    )
    (take,) = read_published(tmp_path)
    np.testing.assert_allclose(take.orientation, orientation, atol=1e-6)
    np.testing.assert_allclose(take.acceleration, acceleration, atol=1e-6)


def test_evaluate_measures_them(truth, tmp_path):
    path = tmp_path / "s_09" / "01.pkl"
    path.parent.mkdir()
    path.write_bytes(pickle.dumps(dip_imu(truth)))
    (take,) = takes_of(tmp_path, "published")
    np.testing.assert_allclose(take.acceleration[5], 0.5 * (truth[2][4] + truth[2][5]), atol=1e-6)
    arguments = ["--data", str(tmp_path), "--part", "published", "--model", "rnn", "--online", "stream"]
    result = CliRunner().invoke(evaluate, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    assert "published" in result.output
    assert f"{FRAMES} frames" in result.output


class Attack:
    def __reduce__(self):
        return (print, ("run!",))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("gt"), "has no 'gt'"),
        (lambda c: c.pop("imu_acc"), r"neither DIP-IMU .* it has gt, imu_ori"),
        (lambda c: c.update(gt=np.zeros((FRAMES, 10))), r"'gt' is \(12, 10\)"),
        (lambda c: c.update(gt=np.full((FRAMES, 72), np.nan)), "gt contains NaN"),
        (
            lambda c: c.update(imu_ori=np.zeros((5, 17, 3, 3))),
            r"'imu_ori' is \(5, 17, 3, 3\), but .* needs \(12,",
        ),
        (lambda c: c.update(imu_ori=np.ones((FRAMES, 17, 3, 3))), "matrices that are not rotations"),
        (lambda c: c.update(imu_ori="words"), "not an array of numbers"),
        (lambda c: c.update(extra=Attack()), r"asks for \S+print, .*it was not run"),
    ],
)
def test_broken_pickles(truth, tmp_path, capsys, change, message):
    content = dip_imu(truth)
    change(content)
    path = tmp_path / "01.pkl"
    path.write_bytes(pickle.dumps(content))
    with pytest.raises(EdgeposeError, match=message):
        read_dip(path)
    assert "run!" not in capsys.readouterr().out


def test_no_pickle_at_all(tmp_path):
    with pytest.raises(EdgeposeError, match=r"none\.pkl: cannot be read"):
        read_dip(tmp_path / "none.pkl")
    with pytest.raises(EdgeposeError, match=r"no \.pkl file with true poses"):
        list(read_published(tmp_path))
    (tmp_path / "cut.pkl").write_bytes(pickle.dumps({"gt": np.zeros((3, 72))})[:40])
    with pytest.raises(EdgeposeError, match="not a readable pickle of DIP-IMU"):
        read_dip(tmp_path / "cut.pkl")


# --- TotalCapture -------------------------------------------------------------------------------------------

SENSORS = ("Head", "Sternum", "Pelvis", "L_UpArm", "R_UpArm", "L_LowArm", "R_LowArm", "L_LowLeg", "R_LowLeg")
OURS = ("L_LowArm", "R_LowArm", "L_LowLeg", "R_LowLeg", "Head", "Pelvis")
GLOBAL_FROM_BODY = np.diag([-1.0, 1.0, -1.0])
OUR_BONE_FROM_THEIRS = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]]).T


def line(name, numbers):
    return "\t".join([name, *(f"{number:.9f}" for number in numbers)])


@pytest.fixture
def totalcapture(truth, tmp_path):
    """A folder as TotalCapture and DIP publish them, with three frames of sensors more than of poses."""
    gt, orientation, acceleration = truth
    rng = np.random.default_rng(5)
    ref, bone = (rot.rotvec_to_matrix(rng.normal(size=(6, 3))) for _ in range(2))
    # R_GB of their bones = R_ref R_IS inverse(R_bone)
    theirs = GLOBAL_FROM_BODY @ orientation @ OUR_BONE_FROM_THEIRS
    sensor = rot.transpose(ref) @ theirs @ bone
    in_global = (acceleration + np.array([0.0, GRAVITY, 0.0])) @ GLOBAL_FROM_BODY.T
    force = (rot.transpose(sensor) @ rot.transpose(ref) @ in_global[..., None])[..., 0]
    quats = rot.matrix_to_quat(sensor)
    rows = [f"{len(SENSORS)}\t{FRAMES + 3}"]
    for frame in range(FRAMES + 3):
        rows.append(str(frame + 1))
        at = max(frame - 3, 0)
        for name in SENSORS:
            i = OURS.index(name) if name in OURS else 0
            rows.append(line(name, [*quats[at, i], *force[at, i], *np.zeros(6)]))
    folder = tmp_path / "tc"
    (folder / "gyro_mag" / "s1").mkdir(parents=True)
    (folder / "imu" / "s1").mkdir(parents=True)
    path = folder / "gyro_mag" / "s1" / "Acting1_Xsens_AuxFields.sensors"
    path.write_text("\n".join(rows) + "\n")
    for kind, turns in (("ref", ref), ("bone", bone)):
        x = rot.matrix_to_quat(turns)[:, [1, 2, 3, 0]]
        text = "\n".join(["6", *(line(name, x[i]).replace("\t", " ") for i, name in enumerate(OURS))])
        (folder / "imu" / "s1" / f"s1_acting1_calib_imu_{kind}.txt").write_text(text + "\n")
    (folder / "s1_acting1.pkl").write_bytes(pickle.dumps({"gt": gt}, 2))
    return folder, path


def test_totalcapture(totalcapture, truth):
    (take,) = read_published(totalcapture[0])
    assert take.name == "s1_acting1"
    np.testing.assert_allclose(take.orientation, truth[1], atol=1e-5)
    np.testing.assert_allclose(take.acceleration, truth[2], atol=1e-5)
    assert take.pose.shape == (FRAMES, 24, 3, 3)


def test_broken_sensors(totalcapture):
    folder, path = totalcapture
    truth = {"s1_acting1": folder / "s1_acting1.pkl"}
    text = path.read_text()
    rows = text.splitlines()

    def broken(changed, message):
        path.write_text(changed)
        with pytest.raises(EdgeposeError, match=message):
            read_totalcapture(path, folder, truth)

    broken("", r"line 1: expected the numbers of sensors and frames")
    broken(text.replace("9\t15", "9\t99999999999", 1), "line 1")
    broken("\n".join(rows[:25]), r"line at the end: expected frame 3 of 15, found|frame 3 has no")
    broken(text.replace("\n2\n", "\n7\n", 1), r"line 12: expected frame 2 of 15, found '7'")
    broken(text.replace("Pelvis", "Tail", 1), "frame 1 has no Pelvis")
    broken("\n".join([*rows[:2], "Head\tnan 0 0 0 0 0 0", *rows[3:]]), "line 3: expected a unit quaternion")
    path.write_text(text)
    with pytest.raises(EdgeposeError, match=r"needs the true poses: s1_acting1\.pkl"):
        read_totalcapture(path, folder, {})
    calibration = folder / "imu" / "s1" / "s1_acting1_calib_imu_ref.txt"
    calibration.write_text("6\nHead 0 0 0 1\n")
    with pytest.raises(EdgeposeError, match="not a calibration of"):
        read_totalcapture(path, folder, truth)
    calibration.unlink()
    with pytest.raises(EdgeposeError, match=r"no s1_acting1_calib_imu_ref\.txt"):
        read_totalcapture(path, folder, truth)


# --- TotalCapture's own truth -------------------------------------------------------------------------------

# Name -> joint of SMPL's whose rotation it has; `Spine` has none of SMPL's and is Spine1's here.
VICON = {
    "Hips": 0, "Spine": 3, "Spine1": 3, "Spine2": 6, "Spine3": 9, "Neck": 12, "Head": 15,
    "RightShoulder": 14, "RightArm": 17, "RightForeArm": 19, "RightHand": 21,
    "LeftShoulder": 13, "LeftArm": 16, "LeftForeArm": 18, "LeftHand": 20,
    "RightUpLeg": 2, "RightLeg": 5, "RightFoot": 8, "LeftUpLeg": 1, "LeftLeg": 4, "LeftFoot": 7,
}  # fmt: skip
LIMBS = {
    "RightForeArm": ("RightArm", [-1, 0, 0]), "RightHand": ("RightForeArm", [-1, 0, 0]),
    "LeftForeArm": ("LeftArm", [1, 0, 0]), "LeftHand": ("LeftForeArm", [1, 0, 0]),
    "RightLeg": ("RightUpLeg", [0, -1, 0]), "RightFoot": ("RightLeg", [0, -1, 0]),
    "LeftLeg": ("LeftUpLeg", [0, -1, 0]), "LeftFoot": ("LeftLeg", [0, -1, 0]),
}  # fmt: skip


def write_vicon(folder, bones, hang=0.0):
    """Files of global rotations (T, 24, 3, 3), as TotalCapture's; arms of the T-pose hang by some radians."""
    theirs = GLOBAL_FROM_BODY @ bones @ OUR_BONE_FROM_THEIRS
    turns = {name: theirs[:, joint] for name, joint in VICON.items()}
    places = dict.fromkeys(VICON, np.zeros((len(bones), 3)))
    for far, (near, rest) in LIMBS.items():
        down = rot.rotation_about_axis("z", -hang * rest[0]) @ rest
        places[far] = places[near] + 10.0 * bones[:, VICON[near]] @ down @ GLOBAL_FROM_BODY.T
    folder.mkdir(parents=True)
    quats = {name: rot.matrix_to_quat(turns[name])[:, [1, 2, 3, 0]] for name in VICON}
    for kind, values in (("ori", quats), ("pos", places)):
        rows = ["".join(f"{name}\t" for name in VICON)]
        for frame in range(len(bones)):
            cells = (" ".join(f"{number:.9f}" for number in values[name][frame]) for name in VICON)
            rows.append("".join(f"{cell}\t" for cell in cells))
        (folder / f"gt_skel_gbl_{kind}.txt").write_text("\n".join(rows) + "\n")
    return folder / "gt_skel_gbl_ori.txt"


@pytest.fixture
def true_bones(truth):
    """Global rotations (T, 24, 3, 3) of the truth with what Vicon's skeleton does not have at rest."""
    bones = global_rotations(rot.rotvec_to_matrix(truth[0].reshape(-1, 24, 3)))
    bones[:, [10, 11]] = bones[:, [7, 8]]
    bones[:, [20, 21, 22, 23]] = bones[:, [18, 19, 18, 19]]
    return bones


def test_vicons_truth_where_dips_is_absent(totalcapture, true_bones):
    folder, _ = totalcapture
    path = write_vicon(folder / "S1" / "acting1", true_bones)
    np.testing.assert_allclose(read_vicon(path), true_bones, atol=1e-7)
    (folder / "s1_acting1.pkl").unlink()
    (take,) = read_published(folder)
    assert take.name == "s1_acting1"
    assert take.pose.shape == (FRAMES, 24, 3, 3)
    np.testing.assert_allclose(global_rotations(take.pose), true_bones, atol=1e-5)
    np.testing.assert_allclose(take.orientation, true_bones[:, list(BONES)], atol=1e-5)


def test_vicons_truth_may_go_on_after_the_sensors(totalcapture, true_bones):
    folder, _ = totalcapture
    (folder / "s1_acting1.pkl").unlink()
    as_sensors = true_bones[np.maximum(np.arange(FRAMES + 5) - 3, 0) % FRAMES]
    write_vicon(folder / "S1" / "acting1", as_sensors)
    (take,) = read_published(folder)
    np.testing.assert_allclose(global_rotations(take.pose), as_sensors[: FRAMES + 3], atol=1e-5)
    np.testing.assert_allclose(take.orientation, as_sensors[: FRAMES + 3, list(BONES)], atol=1e-5)


def test_dips_truth_is_the_first_choice(totalcapture, truth):
    folder, _ = totalcapture
    (folder / "S1" / "acting1").mkdir(parents=True)
    (folder / "S1" / "acting1" / "gt_skel_gbl_ori.txt").write_text("broken")
    (take,) = read_published(folder)
    np.testing.assert_allclose(take.pose, rot.rotvec_to_matrix(truth[0].reshape(-1, 24, 3)), atol=1e-5)


def test_a_take_with_two_files_of_sensors_is_one(totalcapture):
    folder, path = totalcapture
    (folder / "imu" / "s1" / "s1_acting1_Xsens.sensors").write_bytes(path.read_bytes())
    (take,) = read_published(folder)
    assert take.name == "s1_acting1"


def test_limbs_point_as_vicons_do_whatever_its_t_pose(tmp_path, true_bones):
    read = read_vicon(write_vicon(tmp_path / "S1" / "acting1", true_bones, hang=0.15))
    for arm, side in ((16, 1), (17, -1), (18, 1), (19, -1)):
        hanging = rot.rotation_about_axis("z", -0.15 * side) @ [side, 0, 0]
        np.testing.assert_allclose(read[:, arm] @ [side, 0, 0], true_bones[:, arm] @ hanging, atol=1e-6)
    straight = [joint for joint in range(16) if joint]
    np.testing.assert_allclose(read[:, straight], true_bones[:, straight], atol=1e-7)


def test_vicon_of_another_take(totalcapture, true_bones):
    folder, path = totalcapture
    turned = write_vicon(folder / "S1" / "acting1", rot.rotation_about_axis("y", 1.0) @ true_bones)
    with pytest.raises(EdgeposeError, match="its bones are 57 degrees off the sensors"):
        read_totalcapture(path, folder, {"s1_acting1": turned})


def other_order(text):
    """The text with quaternions w x y z."""
    head, *rows = text.splitlines()
    cells = ([cell.split() for cell in row.split("\t")[:-1]] for row in rows)
    return "\n".join([head, *("".join(f"{w} {x} {y} {z}\t" for x, y, z, w in row) for row in cells)])


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        ("ori", lambda t: "", r"ori\.txt, line 1: joint names are missing: Head, Hips, Left"),
        ("ori", lambda t: t.replace("Spine2", "Tail"), r"ori\.txt, line 1: joint names are missing: Spine2$"),
        ("pos", lambda t: t.replace("LeftHand", "Paw"), r"pos\.txt, line 1: joint names are missing: LeftH"),
        ("ori", lambda t: t.replace("Spine\t", "Hips\t", 1), r"line 1: a joint is named twice"),
        ("ori", lambda t: t.splitlines()[0], r"ori\.txt: has no frame"),
        ("ori", lambda t: t.rstrip().rpartition("\t")[0], r"line 13: expected 21 joints, found 20"),
        ("ori", lambda t: t.rstrip().rpartition(" ")[0], r"line 13: 4 numbers were expected, 3 found"),
        ("pos", lambda t: t.replace("\n", "\n\n", 1), r"pos\.txt, line 2: expected 21 joints, found 1"),
        ("pos", lambda t: t.replace("0.000000000", "nan", 1), r"pos\.txt, line 2: a number is not finite"),
        (
            "pos",
            lambda t: t.replace("0.000000000", "1e300", 1),
            r"line 2: a number is not finite, or far too",
        ),
        ("ori", lambda t: t.replace("0.", "zero", 1), r"ori\.txt, line 2: a number was expected"),
        ("ori", lambda t: t.replace("0.", "0.\ufffd", 1), r"ori\.txt, line 2: a number was expected"),
        (
            "ori",
            lambda t: re.sub(r"\n\S+", "\n7", t, count=1),
            "line 2: the quaternion of Hips is not of unit",
        ),
        (
            "pos",
            lambda t: t.rstrip().rpartition("\n")[0],
            r"has 12 frames, but gt_skel_gbl_pos\.txt beside it has 11",
        ),
        (
            "pos",
            lambda t: t.replace("LeftLeg\tLeftFoot", "LeftFoot\tLeftLeg"),
            "do not lie along the bones' axes",
        ),
        ("ori", other_order, "do not lie along the bones' axes"),
    ],
)
def test_broken_vicon(tmp_path, true_bones, kind, change, message):
    path = write_vicon(tmp_path / "S1" / "acting1", true_bones)
    broken = path.with_name(f"gt_skel_gbl_{kind}.txt")
    text = broken.read_text()
    changed = change(text)
    assert changed != text
    broken.write_text(changed, encoding="utf-8")
    with pytest.raises(EdgeposeError, match=message):
        read_vicon(path)


def test_vicon_without_its_places(tmp_path, true_bones):
    path = write_vicon(tmp_path / "S1" / "acting1", true_bones)
    path.with_name("gt_skel_gbl_pos.txt").unlink()
    with pytest.raises(EdgeposeError, match=r"gt_skel_gbl_pos\.txt: cannot be read: No such file"):
        read_vicon(path)


def test_sensors_without_any_truth(totalcapture):
    folder, _ = totalcapture
    (folder / "s1_acting1.pkl").unlink()
    with pytest.raises(EdgeposeError, match=r"needs .*s1_acting1\.pkl.* or s1/acting1/gt_skel_gbl_ori\.txt"):
        list(read_published(folder))
