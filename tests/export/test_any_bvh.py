"""Skeletons of many programs, made of one real motion, are read as that motion, or refused in one line."""

import re
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest

from edgepose.errors import EdgeposeError
from edgepose.formats.bvh_names import BVH_NAMES
from edgepose.rotations import geodesic_angle, rotation_about_axis
from edgepose.skeleton import default_body
from edgepose_export.mocap import Mapping, fault, read_motion, read_source, scaled_to
from edgepose_export.mocap.mapping import read_mapping
from edgepose_export.mocap.rest_pose import to_y_up
from edgepose_export.mocap.rest_search import is_t_pose_file
from edgepose_export.mocap.skeleton_roles import find_roles
from tests.support.skeletons import AXES, FAMILIES, UNITS, followed, lowered_arms, write_bvh

CMU = Path(__file__).parents[1] / "data" / "mocap" / "07_01.bvh"
T_POSE = np.tile(np.eye(3), (1, 24, 1, 1))
ORIGIN = np.array([[0.0, 0.95, 0.0]])
UP = {"y": (0, 1, 0), "z": (0, 0, 1), "z, facing x": (0, 0, 1), "y, facing -z": (0, 1, 0)}
UP |= {"-y": (0, -1, 0), "x": (1, 0, 0)}


@pytest.fixture(scope="module")
def walk():
    """Ten frames of a walk."""
    motion = read_motion(CMU)
    return motion._replace(rotations=motion.rotations[::6], translation=motion.translation[::6])


def check(found, family, walk, axes, start=0):
    """Compare a motion that was read with the one that was written, in the same world."""
    world = to_y_up(np.array(UP[axes], float)) @ AXES[axes]
    truth = world @ followed(family, walk.rotations)[start:]
    angles = np.degrees(geodesic_angle(found.rotations, truth))
    assert angles.max() < 0.1, angles.max(axis=0).round(2)
    np.testing.assert_allclose(found.translation, walk.translation[start:] @ world.T, atol=1e-4)
    assert found.leg_length == pytest.approx(default_body().leg_length_m, abs=1e-4)
    assert (found.source, found.rate) == ("bvh", pytest.approx(60.0, abs=1e-3))


# --- other makers -------------------------------------------------------------------------------------------

_ORDERS = ("ZXY", "XYZ", "YXZ", "ZYX", "YZX", "XZY")
_ZEROS = ("T-pose", "A-pose", "frame 0", "beside", "given", "hanging arms")
MADE = [
    (name, unit, axes, order, zero)
    for i, (name, unit, axes, order, zero) in enumerate(
        zip(FAMILIES, cycle(UNITS), cycle([*AXES, "y"]), cycle(_ORDERS), cycle(_ZEROS), strict=False)
    )
]


@pytest.mark.parametrize(("name", "unit", "axes", "order", "zero"), MADE)
def test_every_program_with_every_habit(tmp_path, walk, name, unit, axes, order, zero):
    family, path, t_pose = FAMILIES[name], tmp_path / "take.bvh", None
    habits = {"unit": unit, "axes": axes, "order": order}
    rotations, translation = walk.rotations, walk.translation
    if zero in ("A-pose", "hanging arms"):
        habits["zero"] = lowered_arms(50.0 if zero == "A-pose" else 85.0)
    elif zero != "T-pose":
        habits["seed"] = 5
    if zero == "frame 0":
        rotations = np.concatenate([T_POSE, rotations])
        translation = np.concatenate([translation[:1], translation])
    elif zero in ("beside", "given"):
        t_pose = tmp_path / ("t_pose.bvh" if zero == "beside" else "stand.bvh")
        write_bvh(t_pose, family, T_POSE, ORIGIN, **habits)
    write_bvh(path, family, rotations, translation, **habits)
    check(read_motion(path, t_pose if zero == "given" else None), family, walk, axes)


def test_there_are_more_than_twenty_makers_and_all_habits_come_up():
    assert len(MADE) > 20
    for column, habits in zip(range(1, 5), (UNITS, AXES, _ORDERS, _ZEROS), strict=True):
        assert {made[column] for made in MADE} == set(habits)


@pytest.mark.parametrize("skeleton", BVH_NAMES)
def test_names_of_our_own_files(skeleton):
    names = BVH_NAMES[skeleton]
    parents = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
    roles = find_roles(names, parents)
    assert (roles.pelvis, roles.spine, roles.neck, roles.head) == (0, (3, 6, 9), 12, 15)
    assert tuple(roles.left) == (1, 4, 7, 10, 13, 16, 18, 20)
    assert tuple(roles.right) == (2, 5, 8, 11, 14, 17, 19, 21)


def test_names_in_capitals_without_separators_and_with_other_prefixes():
    plain = ["Hips", "Spine", "Chest", "Neck", "Head"]
    limbs = ["UpLeg", "Leg", "Foot", "Toe", "Shoulder", "Arm", "ForeArm", "Hand"]
    parents = [-1, 0, 1, 2, 3]
    for _ in range(2):
        at = len(parents)
        parents += [0, at, at + 1, at + 2, 2, at + 4, at + 5, at + 6]
    for spell in (
        lambda side, joint: f"{side}{joint}".upper(),
        lambda side, joint: f"{joint}_{side[:1]}",
        lambda side, joint: f"{joint}.{side[:1].lower()}",
        lambda side, joint: f"ns:rig:{side}_{joint}".lower(),
        lambda side, joint: f"Bob_{side[:1]}_{joint}_jnt",
        lambda side, joint: f"b {side} {joint}",
    ):
        names = [*plain, *(spell(side, joint) for side in ("Left", "Right") for joint in limbs)]
        roles = find_roles(names, parents)
        assert tuple(roles.left) == tuple(range(5, 13))
        assert tuple(roles.right) == tuple(range(13, 21))


def test_spines_of_more_joints_are_followed_by_their_length(tmp_path, walk):
    """A spine of five joints that bends evenly: SMPL's lower joints turn by their share of the bend."""
    bend = np.tile(np.eye(3), (2, 24, 1, 1))
    bend[1, [9, 12, 15, *range(13, 15), *range(16, 24)]] = rotation_about_axis("x", np.radians(40.0))
    path = tmp_path / "a.bvh"
    write_bvh(path, FAMILIES["unreal 5"], bend, ORIGIN.repeat(2, axis=0))
    text = path.read_text().splitlines()
    # All of the bend is in the first joint of the spine; it is spread evenly over the five.
    last = np.array(text[-1].split(), float)
    assert np.abs(last[7]) == pytest.approx(40.0)
    last[[7, 10, 13, 16, 19]] = 8.0
    path.write_text("\n".join([*text[:-1], " ".join(map(str, last))]))
    found = read_motion(path).rotations[-1]
    angles = np.degrees([geodesic_angle(found[joint], np.eye(3)) for joint in (3, 6, 9)])
    assert angles[2] == pytest.approx(40.0, abs=0.01)
    assert 8.0 < angles[0] < angles[1] < 32.0


def test_forearms_take_the_hands_rotation_about_their_axis(tmp_path):
    """Pronation is the same whether the forearm or the hand has it; a bent wrist changes nothing."""
    made = []
    for name, joints in (("forearm", (18, 20, 22)), ("hand", (20, 22))):
        pose = T_POSE.repeat(3, axis=0).copy()
        pose[1:, list(joints)] = rotation_about_axis("x", np.radians(50.0))
        if name == "hand":
            pose[1:, [20, 22]] = pose[1:, [20, 22]] @ rotation_about_axis("z", np.radians(30.0))
        write_bvh(tmp_path / f"{name}.bvh", FAMILIES["mixamo"], pose, ORIGIN.repeat(3, axis=0))
        made.append(read_motion(tmp_path / f"{name}.bvh").rotations[-1])
    wanted = rotation_about_axis("x", np.radians(50.0))
    for found in made:
        assert np.degrees(geodesic_angle(found[18], wanted)) < 0.1
    np.testing.assert_allclose(made[0], made[1], atol=1e-3)


# --- rest poses ---------------------------------------------------------------------------------------------


def test_a_zero_pose_in_frame_0_is_no_motion(tmp_path, walk):
    family = FAMILIES["lafan"]
    rotations = np.concatenate([T_POSE, walk.rotations])
    write_bvh(tmp_path / "a.bvh", family, rotations, np.concatenate([ORIGIN, walk.translation]))
    check(read_motion(tmp_path / "a.bvh"), family, walk, "y")


def test_a_frame_0_that_is_a_persons_posture_is_motion(tmp_path, walk):
    family = FAMILIES["lafan"]
    spread = walk.rotations.copy()
    spread[0] = rotation_about_axis("y", 0.3) @ T_POSE[0]
    spread[0, [18, 20, 22]] = spread[0, 18] @ rotation_about_axis("z", np.radians(12.0))
    write_bvh(tmp_path / "a.bvh", family, spread, walk.translation)
    check(read_motion(tmp_path / "a.bvh"), family, walk._replace(rotations=spread), "y")


def test_the_t_pose_beside_that_has_the_skeleton_is_taken(tmp_path, walk):
    """Of several files beside one fits; a file of another skeleton alone is named."""
    family, wrong = FAMILIES["lafan"], tmp_path / "t_pose_a.bvh"
    write_bvh(wrong, family, T_POSE, ORIGIN, seed=6)
    write_bvh(tmp_path / "take.bvh", family, walk.rotations, walk.translation, seed=5)
    with pytest.raises(
        EdgeposeError, match=r"t_pose_a\.bvh has another skeleton: joint \w+ has another offset"
    ):
        read_motion(tmp_path / "take.bvh")
    write_bvh(tmp_path / "T-Pose.bvh", family, T_POSE, ORIGIN, seed=5)
    check(read_motion(tmp_path / "take.bvh"), family, walk, "y")
    with pytest.raises(EdgeposeError, match="another skeleton"):
        read_motion(tmp_path / "take.bvh", wrong)
    assert is_t_pose_file(wrong)
    assert is_t_pose_file(tmp_path / "T-Pose.bvh")
    assert not is_t_pose_file(tmp_path / "wd2_t_pose.bvh")


def test_the_best_frame_of_a_t_pose_file_is_taken(tmp_path, walk):
    family = FAMILIES["lafan"]
    rotations = np.concatenate([walk.rotations, rotation_about_axis("y", 1.0) @ T_POSE, walk.rotations])
    translation = np.concatenate([walk.translation, ORIGIN, walk.translation])
    write_bvh(tmp_path / "calibration.bvh", family, rotations, translation, seed=5)
    write_bvh(tmp_path / "take.bvh", family, walk.rotations, walk.translation, seed=5)
    check(read_motion(tmp_path / "take.bvh", tmp_path / "calibration.bvh"), family, walk, "y")


def test_a_file_without_t_pose_is_refused_with_what_to_give(tmp_path, walk):
    write_bvh(tmp_path / "take.bvh", FAMILIES["lafan"], walk.rotations, walk.translation, seed=5)
    with pytest.raises(EdgeposeError, match=r"no T-pose: .*; give --t-pose FILE"):
        read_motion(tmp_path / "take.bvh")
    write_bvh(tmp_path / "walk.bvh", FAMILIES["lafan"], walk.rotations, walk.translation, seed=5)
    with pytest.raises(EdgeposeError, match=r"walk\.bvh contains no T-pose: at best "):
        read_motion(tmp_path / "take.bvh", tmp_path / "walk.bvh")


# --- units and axes -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("unit", UNITS)
def test_units_of_children_and_giants(tmp_path, walk, unit):
    for stature in (1.05, 1.4, 2.0):
        factor = stature / 1.8
        write_bvh(
            tmp_path / "a.bvh", FAMILIES["lafan"], walk.rotations, walk.translation, unit=UNITS[unit] / factor
        )
        found = read_motion(tmp_path / "a.bvh")
        assert found.leg_length == pytest.approx(factor * default_body().leg_length_m, rel=1e-3)


def test_sizes_of_no_person_are_refused(tmp_path, walk):
    write_bvh(tmp_path / "a.bvh", FAMILIES["lafan"], walk.rotations, walk.translation, unit=0.07)
    found = read_motion(tmp_path / "a.bvh", mapping=Mapping(unit=0.07))
    assert found.leg_length == pytest.approx(default_body().leg_length_m, rel=1e-3)
    with pytest.raises(EdgeposeError, match=r"a stature of about 0\.261 m is not plausible"):
        read_motion(tmp_path / "a.bvh", mapping=Mapping(unit="cm"))
    text = (tmp_path / "a.bvh").read_text()
    scaled = re.sub(
        r"OFFSET (.*)", lambda m: "OFFSET " + " ".join(str(9 * float(x)) for x in m[1].split()), text
    )
    (tmp_path / "a.bvh").write_text(scaled)
    with pytest.raises(EdgeposeError, match=r"the unit of length is not clear: .*give `unit`"):
        read_motion(tmp_path / "a.bvh")


def standing_up(tmp_path, walk, rotations, translation):
    """A file whose zero pose has Y up and whose motion has Z up, as some programs write."""
    write_bvh(tmp_path / "a.bvh", FAMILIES["lafan"], AXES["z"] @ rotations, translation @ AXES["z"].T)
    return tmp_path / "a.bvh"


def test_motion_with_another_up_axis_than_the_zero_pose(tmp_path, walk):
    path = standing_up(tmp_path, walk, walk.rotations, walk.translation)
    check(read_motion(path), FAMILIES["lafan"], walk, "y")


def test_a_person_who_does_not_travel_needs_the_up_axis(tmp_path, walk):
    path = standing_up(tmp_path, walk, walk.rotations[:3], walk.translation[:3])
    with pytest.raises(EdgeposeError, match=r"stands along Y, the motion along Z; give `up`"):
        read_motion(path)
    found = read_motion(path, mapping=Mapping(up=np.array([0.0, 0.0, 1.0])))
    assert np.degrees(geodesic_angle(found.rotations, walk.rotations[:3])).max() < 0.1


# --- mappings -----------------------------------------------------------------------------------------------


def renamed(path, names):
    text = path.read_text()
    for old, new in names.items():
        text = re.sub(rf"(ROOT|JOINT) {re.escape(old)}$", rf"\1 {new}", text, flags=re.MULTILINE)
    path.write_text(text)


def test_a_mapping_names_what_is_not_understood(tmp_path, walk):
    family, path = FAMILIES["lafan"], tmp_path / "a.bvh"
    write_bvh(path, family, walk.rotations, walk.translation)
    renamed(path, {"LeftUpLeg": "Bone12", "RightHand": "Bone 9", "Head": "Kopf", "Neck": "Hals"})
    with pytest.raises(EdgeposeError) as caught:
        read_motion(path)
    message = str(caught.value)
    assert "\n" not in message
    for part in ("unknown skeleton", "left_thigh, right_hand", "Bone12", "Bone 9", "--mapping FILE.toml"):
        assert part in message
    (tmp_path / "map.toml").write_text(
        'unit = "cm"\nup = "y"\nleft_thigh = "Bone12"\nright_hand = "Bone 9"\nhead = "Kopf"\n'
    )
    check(read_motion(path, mapping=read_mapping(tmp_path / "map.toml")), family, walk, "y")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('left_tail = "Bone"', "unknown key 'left_tail'; known are unit, up, pelvis"),
        ("left_hand = 3", "left_hand must be the name of a joint"),
        ('left_hand = "a"\nright_hand = "a"', "left_hand and right_hand are the same joint"),
        ('unit = "furlong"', "unit must be one of m, cm"),
        ("unit = -1", "unit must be one of m, cm"),
        ("unit = true", "unit must be one of m, cm"),
        ('up = "w"', "up must be x, y, z, -x, -y or -z"),
        ("up = 1", "up must be x, y, z"),
        ("left_hand = ", "not valid TOML"),
    ],
)
def test_faults_of_mappings(tmp_path, text, message):
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(EdgeposeError, match=r"map\.toml") as caught:
        read_mapping(tmp_path / "map.toml")
    assert message in str(caught.value)


def test_two_bodies_in_one_file_need_a_mapping(tmp_path, walk):
    family, path = FAMILIES["lafan"], tmp_path / "a.bvh"
    more = (("B_LeftUpLeg", "Hips"), ("B_Head", "Neck"))
    write_bvh(path, family._replace(more=more), walk.rotations, walk.translation)
    for joint in ("left thigh", "head"):
        name = {"left thigh": "LeftUpLeg", "head": "Head"}[joint]
        with pytest.raises(EdgeposeError, match=f"joints {name} and B_{name} are both a {joint}; say which"):
            read_motion(path, mapping=None if joint == "left thigh" else Mapping({"left_thigh": "LeftUpLeg"}))
    found = read_motion(path, mapping=Mapping({"left_thigh": "LeftUpLeg", "head": "Head"}))
    check(found, family, walk, "y")


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        ({"pelvis": "Spine"}, "joint LeftUpLeg does not hang on Spine"),
        ({"chest": "LeftArm"}, "not above LeftArm, the chest"),
        ({"neck": "LeftArm"}, "joint Head does not hang on LeftArm"),
        ({"head": "LeftToe"}, "joint LeftToe is not above Spine2, the chest"),
        ({"left_hand": "LeftArm"}, "joint LeftArm does not hang on LeftForeArm"),
    ],
)
def test_mappings_must_be_bodies(tmp_path, walk, joints, message):
    write_bvh(tmp_path / "a.bvh", FAMILIES["lafan"], walk.rotations, walk.translation)
    with pytest.raises(EdgeposeError) as caught:
        read_motion(tmp_path / "a.bvh", mapping=Mapping(joints))
    assert message in str(caught.value)


def test_a_mapping_of_joints_that_are_not_there(tmp_path, walk):
    write_bvh(tmp_path / "a.bvh", FAMILIES["lafan"], walk.rotations, walk.translation)
    with pytest.raises(EdgeposeError, match=r"a\.bvh: the mapping's joint 'Bone12' \(left_hand\) is not in"):
        read_motion(tmp_path / "a.bvh", mapping=Mapping({"left_hand": "Bone12"}))


# --- faults -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ("Hips Spine Neck Head Tail LeftFrontPaw RightFrontPaw LeftHindPaw", "no joint for left_thigh"),
        ("chassis wheel_fl wheel_fr wheel_rl wheel_rr", "joints not understood: chassis, wheel_fl"),
        ("Hips", "unknown skeleton"),
    ],
)
def test_a_dog_and_a_car_are_no_people(tmp_path, names, message):
    joints = names.split()
    lines = [f"ROOT {joints[0]}\n{{\nOFFSET 0 0 0\nCHANNELS 3 Zrotation Xrotation Yrotation"]
    lines += [
        f"JOINT {j}\n{{\nOFFSET 0 9 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n}}" for j in joints[1:]
    ]
    motion = "0 " * 3 * len(joints)
    text = "\n".join(["HIERARCHY", *lines, "}", "MOTION", "Frames: 2", "Frame Time: 0.01", motion, motion])
    (tmp_path / "a.bvh").write_text(text + "\n")
    with pytest.raises(EdgeposeError) as caught:
        read_motion(tmp_path / "a.bvh")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def edited(tmp_path, walk, old, new, **habits):
    """A file of the LAFAN names with a line replaced."""
    path = tmp_path / "a.bvh"
    write_bvh(path, FAMILIES["lafan"], walk.rotations, walk.translation, **habits)
    text = path.read_text()
    assert re.search(old, text)
    path.write_text(re.sub(old, new, text, count=1))
    return path


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            r"(JOINT LeftLeg\n{\n)OFFSET .*",
            r"\1OFFSET 0 0 0",
            "the bone from LeftUpLeg to LeftLeg has no length",
        ),
        (
            r"(JOINT RightForeArm\n{\n)OFFSET .*",
            r"\1OFFSET -60 0 0",
            "the bone from RightArm to RightForeArm is 2.21 times as long as that of the other side",
        ),
        (
            r"JOINT LeftHand\n",
            "JOINT " + "Left" * 40 + "Hand\n",
            "a joint's name has 164 characters: LeftLeftLeftLeftLeft...",
        ),
        (r"Frame Time: .*", "Frame Time: 0.5", "a frame rate of 2 Hz is not that of motion capture"),
        (r"Frame Time: .*", "Frame Time: 0.0001", "a frame rate of 1e+04 Hz"),
        (r"(JOINT Head\n{\n)OFFSET .*", r"\1OFFSET 0 -200 0", "no T-pose"),
        (r"JOINT RightHand", "JOINT RightHoof", "no joint for right_hand; joints not understood: RightHoof"),
        (
            r"(JOINT LeftToe\n{\n)OFFSET .*",
            r"\1OFFSET 0 0 -15",
            "LeftToe points backwards",
        ),
    ],
)
def test_faults_of_skeletons(tmp_path, walk, old, new, message):
    with pytest.raises(EdgeposeError, match=r"a\.bvh: ") as caught:
        read_motion(edited(tmp_path, walk, old, new))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_exchanged_sides_are_refused(tmp_path, walk):
    path = tmp_path / "a.bvh"
    write_bvh(path, FAMILIES["lafan"], walk.rotations, walk.translation)
    text = path.read_text().replace("Left", "?").replace("Right", "Left").replace("?", "Right")
    path.write_text(text)
    with pytest.raises(EdgeposeError, match="points backwards"):
        read_motion(path)


def test_limbs_in_the_wrong_order_are_refused(tmp_path, walk):
    path = tmp_path / "a.bvh"
    write_bvh(path, FAMILIES["lafan"], walk.rotations, walk.translation)
    renamed(path, {"LeftUpLeg": "LeftFoo", "LeftLeg": "LeftUpLeg"})
    renamed(path, {"LeftFoo": "LeftLeg"})
    with pytest.raises(EdgeposeError, match="joint LeftLeg does not hang on LeftUpLeg"):
        read_motion(path)


def test_position_channels_of_all_joints(tmp_path, walk):
    """They repeat the offset, or are all zero; a bone that changes its length is refused."""
    family, path = FAMILIES["lafan"], tmp_path / "a.bvh"
    write_bvh(path, family, walk.rotations, walk.translation, more_positions=True)
    check(read_motion(path), family, walk, "y")
    lines = path.read_text().splitlines()
    rows = np.array([line.split() for line in lines[-10:]], float)
    for joint in range(1, rows.shape[1] // 6):
        rows[:, 6 * joint : 6 * joint + 3] = 0.0
    shifts = [" ".join(map(str, row)) for row in rows]
    path.write_text("\n".join([*lines[:-10], *shifts]))
    check(read_motion(path), family, walk, "y")
    joint = [line.split()[1] for line in lines if line.startswith(("ROOT", "JOINT"))].index("RightForeArm")
    rows = np.array([line.split() for line in lines[-10:]], float)
    rows[5, 6 * joint] *= 1.3
    path.write_text("\n".join([*lines[:-10], *(" ".join(map(str, row)) for row in rows)]))
    with pytest.raises(EdgeposeError, match="RightForeArm do not lie as in its OFFSET"):
        read_motion(path)


def test_takes_of_no_use(walk):
    assert fault(walk) is None
    one = walk._replace(rotations=walk.rotations[:1], translation=walk.translation[:1])
    assert fault(one) == "too short: 1 frame at 120 Hz"
    still = walk._replace(rotations=walk.rotations[:1].repeat(9, axis=0), translation=np.zeros((9, 3)))
    assert fault(still) == "no motion: all 9 frames are the same"
    assert fault(still._replace(translation=np.outer(np.arange(9), [0.0, 0.0, 0.01]))) is None
    short = walk._replace(rotations=walk.rotations[:3], translation=walk.translation[:3])
    assert fault(short, 120.0) is None
    assert fault(short, 60.0) == "too short: 3 frames at 120 Hz"
    folded = walk.rotations.copy()
    folded[:, 0] = folded[:, 0] @ rotation_about_axis("x", np.pi)
    assert "pelvis and chest are 1" in str(fault(walk._replace(rotations=folded)))


# --- the body that follows ----------------------------------------------------------------------------------


def test_translation_is_scaled_by_the_legs(walk):
    body = default_body(1.55)
    found = scaled_to(walk, body.leg_length_m)
    scale = body.leg_length_m / walk.leg_length
    assert 0.7 < scale < 1.0
    np.testing.assert_allclose(found.translation, scale * walk.translation)
    assert found.leg_length == body.leg_length_m
    unknown = walk._replace(leg_length=0.0)
    assert scaled_to(unknown, 0.8) is unknown


def test_bones_are_followed_in_the_picture(tmp_path, walk):
    from edgepose_export.mocap.check_picture import draw_check, figures_of, skeleton_key
    from edgepose_export.mocap.retargeting import retarget

    path = tmp_path / "a.bvh"
    write_bvh(path, FAMILIES["mixamo"], walk.rotations, walk.translation, axes="z, facing x")
    source = read_source(path)
    row = figures_of("walk", source, retarget(source), default_body())
    joints = [source.roles.left.foot, source.roles.right.hand, source.roles.head]
    np.testing.assert_allclose(row.source[:, joints], row.target[:, [7, 21, 15]], atol=2e-3)
    assert row.frames[:2] == (0, 5)
    assert (row.target[:, 1, 0] > row.target[:, 2, 0]).all()  # faces the viewer
    draw_check([row], tmp_path / "a.png", False)
    assert (tmp_path / "a.png").read_bytes()[:4] == b"\x89PNG"
    other = tmp_path / "b.bvh"
    write_bvh(other, FAMILIES["mixamo"], T_POSE, ORIGIN, axes="z, facing x")
    assert skeleton_key(other) == skeleton_key(path)
    write_bvh(other, FAMILIES["mixamo"], T_POSE, ORIGIN)
    assert skeleton_key(other) != skeleton_key(path)
