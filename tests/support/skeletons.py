"""BVH files as other programs write them: their names, units, axes, orders of rotation and zero poses."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from edgepose.rotations import matrix_to_quat, quat_to_matrix, rotation_about_axis, slerp
from edgepose.skeleton import PARENTS, default_body

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048, "cmu": 0.0254 / 0.45}
AXES = {
    "y": np.eye(3),
    "z": np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]),
    "z, facing x": np.array([[0, 0, 1.0], [1.0, 0, 0], [0, 1.0, 0]]),
    "y, facing -z": np.diag([-1.0, 1.0, -1.0]),
    "-y": np.diag([1.0, -1.0, -1.0]),
    "x": np.array([[0, 1.0, 0], [0, 0, 1.0], [1.0, 0, 0]]),
}
"""World axes of files: matrices from T to the file's world, by the axis that is up."""

SPINE, TORSO = (3, 6, 9), (0, 3, 6, 9)


class Family(NamedTuple):
    """Names of a program. `{}` in names of limbs stands for the side; `-` for a joint that is not there."""

    trunk: str
    """Pelvis, spine (one to five), neck, head; separated by commas."""
    limbs: str
    """Thigh, shank, foot, toes, collar, upper arm, forearm, hand; separated by commas."""
    sides: tuple[str, str] = ("Left", "Right")
    more: tuple[tuple[str, str], ...] = ()
    """Joints that mean nothing, with the joints that they hang on."""


def _prefixed(prefix: str, names: str) -> str:
    return ",".join(prefix + name for name in names.split(","))


_MOTION_BUILDER = "{}UpLeg,{}Leg,{}Foot,{}ToeBase,{}Shoulder,{}Arm,{}ForeArm,{}Hand"
FAMILIES = {
    "smpl": Family(
        "pelvis,spine1,spine2,spine3,neck,head",
        "{}_hip,{}_knee,{}_ankle,{}_foot,{}_collar,{}_shoulder,{}_elbow,{}_wrist",
        ("left", "right"),
        (("left_hand", "left_wrist"), ("jaw", "head")),
    ),
    "smpl in fbx": Family(
        "m_avg_Pelvis,m_avg_Spine1,m_avg_Spine2,m_avg_Spine3,m_avg_Neck,m_avg_Head",
        _prefixed("m_avg_{}_", "Hip,Knee,Ankle,Foot,Collar,Shoulder,Elbow,Wrist"),
        ("L", "R"),
    ),
    "mixamo": Family(
        _prefixed("mixamorig:", "Hips,Spine,Spine1,Spine2,Neck,Head"),
        _MOTION_BUILDER.replace("{}", "mixamorig:{}"),
        more=(
            ("mixamorig:HeadTop_End", "mixamorig:Head"),
            ("mixamorig:LeftHandThumb1", "mixamorig:LeftHand"),
            ("mixamorig:LeftToe_End", "mixamorig:LeftToeBase"),
        ),
    ),
    "motionbuilder": Family(
        _prefixed("Character1_", "Hips,Spine,Spine1,Spine2,Neck,Head"),
        _MOTION_BUILDER.replace("{}", "Character1_{}"),
        more=(("Character1_LeftHandIndex1", "Character1_LeftHand"),),
    ),
    "lafan": Family("Hips,Spine,Spine1,Spine2,Neck,Head", _MOTION_BUILDER.replace("ToeBase", "Toe")),
    "unity": Family(
        "Hips,Spine,Chest,UpperChest,Neck,Head",
        "{}UpperLeg,{}LowerLeg,{}Foot,{}Toes,{}Shoulder,{}UpperArm,{}LowerArm,{}Hand",
        more=(("LeftEye", "Head"), ("Left Thumb Proximal", "LeftHand")),
    ),
    "vrm": Family(
        _prefixed("J_Bip_C_", "Hips,Spine,Chest,UpperChest,Neck,Head"),
        "J_Bip_{0}_UpperLeg,J_Bip_{0}_LowerLeg,J_Bip_{0}_Foot,J_Bip_{0}_ToeBase,"
        "J_Bip_{0}_Shoulder,J_Bip_{0}_UpperArm,J_Bip_{0}_LowerArm,J_Bip_{0}_Hand",
        ("L", "R"),
        (("J_Sec_Hair1_01", "J_Bip_C_Head"),),
    ),
    "unreal": Family(
        "pelvis,spine_01,spine_02,spine_03,neck_01,head",
        "thigh_{},calf_{},foot_{},ball_{},clavicle_{},upperarm_{},lowerarm_{},hand_{}",
        ("l", "r"),
        (("upperarm_twist_01_l", "upperarm_l"), ("ik_foot_l", "pelvis"), ("index_01_r", "hand_r")),
    ),
    "unreal 5": Family(
        "pelvis,spine_01,spine_02,spine_03,spine_04,spine_05,neck_01,head",
        "thigh_{},calf_{},foot_{},ball_{},clavicle_{},upperarm_{},lowerarm_{},hand_{}",
        ("l", "r"),
        (("calf_twist_02_r", "calf_r"),),
    ),
    "character creator": Family(
        "CC_Base_Hip,CC_Base_Waist,CC_Base_Spine01,CC_Base_Spine02,CC_Base_NeckTwist01,CC_Base_Head",
        "CC_Base_{0}_Thigh,CC_Base_{0}_Calf,CC_Base_{0}_Foot,CC_Base_{0}_ToeBase,"
        "CC_Base_{0}_Clavicle,CC_Base_{0}_Upperarm,CC_Base_{0}_Forearm,CC_Base_{0}_Hand",
        ("L", "R"),
        (("CC_Base_L_ThighTwist01", "CC_Base_L_Thigh"), ("CC_Base_FacialBone", "CC_Base_Head")),
    ),
    "xsens": Family(
        "Pelvis,L5,L3,T12,T8,Neck,Head",
        "{}UpperLeg,{}LowerLeg,{}Foot,{}Toe,{}Shoulder,{}UpperArm,{}ForeArm,{}Hand",
    ),
    "perception neuron": Family(
        "Hips,Spine,Spine1,Spine2,Spine3,Neck,Head", _MOTION_BUILDER.replace("{}ToeBase", "-")
    ),
    "rokoko": Family(
        "Hips,Spine1,Spine2,Spine3,Spine4,Neck,Head",
        "{}Thigh,{}Shin,{}Foot,{}Toe,{}Shoulder,{}Arm,{}ForeArm,{}Hand",
    ),
    "daz": Family(
        "hip,abdomen,chest,neck,head",
        "{}Thigh,{}Shin,{}Foot,{}Toe,{}Collar,{}Shldr,{}ForeArm,{}Hand",
        ("l", "r"),
        (("rThumb1", "rHand"), ("leftEye", "head")),
    ),
    "genesis": Family(
        "hip,abdomenLower,abdomenUpper,chestLower,neckLower,head",
        "{}ThighBend,{}Shin,{}Foot,{}Toe,{}Collar,{}ShldrBend,{}ForearmBend,{}Hand",
        ("l", "r"),
        (("lShldrTwist", "lShldrBend"),),
    ),
    "biovision": Family("Hips,Chest,Neck,Head", "{}UpLeg,{}LowLeg,{}Foot,-,{}Collar,{}UpArm,{}LowArm,{}Hand"),
    "100style": Family(
        "Hips,Chest,Chest2,Chest3,Chest4,Neck,Head",
        "{}Hip,{}Knee,{}Ankle,{}Toe,{}Collar,{}Shoulder,{}Elbow,{}Wrist",
    ),
    "biped": Family(
        "Bip01 Pelvis,Bip01 Spine,Bip01 Spine1,Bip01 Neck,Bip01 Head",
        "Bip01 {0} Thigh,Bip01 {0} Calf,Bip01 {0} Foot,Bip01 {0} Toe0,"
        "Bip01 {0} Clavicle,Bip01 {0} UpperArm,Bip01 {0} Forearm,Bip01 {0} Hand",
        ("L", "R"),
        (("Bip01 L Finger0", "Bip01 L Hand"),),
    ),
    "rigify": Family(
        "spine,spine.001,spine.002,spine.003,spine.004,spine.006",
        "thigh.{},shin.{},foot.{},toe.{},shoulder.{},upper_arm.{},forearm.{},hand.{}",
        ("L", "R"),
        (("thumb.01.L", "hand.L"),),
    ),
    "optitrack": Family(
        "Hip,Ab,Chest,Neck,Head",
        "{}Thigh,{}Shin,{}Foot,{}Toe,{}Shoulder,{}UArm,{}FArm,{}Hand",
        ("L", "R"),
    ),
    "kinect": Family(
        "SpineBase,SpineMid,SpineShoulder,Neck,Head",
        "Hip{},Knee{},Ankle{},Foot{},-,Shoulder{},Elbow{},Wrist{}",
        more=(("ThumbLeft", "WristLeft"),),
    ),
    "deepmotion": Family(
        "hips_JNT,spine_JNT,spine1_JNT,spine2_JNT,neck_JNT,head_JNT",
        "{}_upleg_JNT,{}_leg_JNT,{}_foot_JNT,{}_toebase_JNT,"
        "{}_shoulder_JNT,{}_arm_JNT,{}_forearm_JNT,{}_hand_JNT",
        ("l", "r"),
    ),
    "arkit": Family(
        "hips_joint,spine_1_joint,spine_4_joint,spine_7_joint,neck_1_joint,head_joint",
        "{0}_upLeg_joint,{0}_leg_joint,{0}_foot_joint,{0}_toes_joint,"
        "{0}_shoulder_1_joint,{0}_arm_joint,{0}_forearm_joint,{0}_hand_joint",
        ("left", "right"),
        (("left_handThumb_1_joint", "left_hand_joint"), ("chin_joint", "head_joint")),
    ),
    "seoul, 20 joints": Family(
        "Hips,Spine,Spine1,-,HEad",
        _MOTION_BUILDER.replace("ToeBase", "Toes").replace("{}Shoulder", "{}Shoulder1"),
    ),
    "seoul, lower case": Family(
        "hip,spine,spine1,-,head",
        "{}upleg,{}leg,{}foot,{}toes,{}shoulder,{}arm,{}forearm,{}hand",
        ("left", "right"),
        (("headdummy", "spine1"),),
    ),
}


class Made(NamedTuple):
    """Joints of a family: name, parent, and the joint of SMPL whose rotation it has."""

    names: list[str]
    parents: list[int]
    smpl: list[int]
    offsets: np.ndarray
    """(J, 3) position minus the parent's in the T-pose, metres, axes of T."""


def joints_of(family: Family) -> Made:
    """The skeleton of a family, with the default body's bones; extra joints hang where they are said to."""
    trunk, sides = family.trunk.split(","), [family.limbs.format(*[s] * 8).split(",") for s in family.sides]
    pelvis, *spine, neck, head = trunk
    rest = _rest_positions()
    rows: list[tuple[str, str, int, np.ndarray]] = [(pelvis, "", 0, rest[0])]
    for i, name in enumerate(spine):
        where = rest[9] * (i + 1) / len(spine)
        joint = SPINE[i] if len(spine) == 3 else (3 if len(spine) == 2 and i == 0 else 9)
        rows.append((name, rows[-1][0], joint, where))
    chest = rows[-1][0]
    if neck != "-":
        rows.append((neck, chest, 12, rest[12]))
    rows.append((head, rows[-1][0], 15, rest[15]))
    for side, limb in enumerate(sides):
        thigh, shank, foot, toes, collar, arm, forearm, hand = limb
        chain = [(thigh, pelvis, 1), (shank, thigh, 4), (foot, shank, 7), (toes, foot, 10)]
        chain += [(collar, chest, 13), (arm, chest if collar == "-" else collar, 16)]
        chain += [(forearm, arm, 18), (hand, forearm, 20)]
        rows += [(name, above, j + side, rest[j + side]) for name, above, j in chain if name != "-"]
    for name, above in family.more:
        smpl, where = next((row[2], row[3]) for row in rows if row[0] == above)
        rows.append((name, above, smpl, where + np.array([0.0, 0.02, 0.01])))
    names = [row[0] for row in rows]
    parents = [names.index(row[1]) if row[1] else -1 for row in rows]
    offsets = [row[3] - (rows[p][3] if p >= 0 else 0.0) for row, p in zip(rows, parents, strict=True)]
    return Made(names, parents, [row[2] for row in rows], np.array(offsets))


def _rest_positions() -> np.ndarray:
    offsets = default_body().offsets
    positions = np.zeros((24, 3))
    for joint, parent in enumerate(PARENTS):
        positions[joint] = offsets[joint] + (positions[parent] if parent >= 0 else 0.0)
    return positions


def followed(family: Family, rotations: np.ndarray) -> np.ndarray:
    """The rotations (T, 24, 3, 3) that a family's joints can have, given those of SMPL's joints."""
    truth = rotations.copy()
    spine = len(family.trunk.split(",")) - 3
    if spine == 2:
        truth[:, 6] = truth[:, 9]
    elif spine != 3:
        truth[:, 3] = truth[:, 6] = truth[:, 9]
    if family.trunk.split(",")[-2] == "-":
        chest, head = matrix_to_quat(truth[:, 9]), matrix_to_quat(truth[:, 15])
        truth[:, 12] = quat_to_matrix(slerp(chest, head, np.full(len(chest), 0.5)))
    limbs = family.limbs.split(",")
    if limbs[3] == "-":
        truth[:, 10:12] = truth[:, 7:9]
    if limbs[4] == "-":
        truth[:, 13] = truth[:, 14] = truth[:, 9]
    return truth


def lowered_arms(degrees: float) -> np.ndarray:
    """Rotations (24, 3, 3) of an A-pose: a T-pose with arms lowered by some degrees."""
    pose = np.tile(np.eye(3), (24, 1, 1))
    for side, joints in ((-1.0, (16, 18, 20, 22)), (1.0, (17, 19, 21, 23))):
        pose[list(joints)] = rotation_about_axis("z", side * np.radians(degrees))
    return pose


def write_bvh(
    path: Path,
    family: Family,
    rotations: np.ndarray,
    translation: np.ndarray,
    *,
    unit: str | float = "cm",
    axes: str = "y",
    order: str = "ZXY",
    zero: np.ndarray | None = None,
    seed: int | None = None,
    frame_time: float = 1 / 60,
    more_positions: bool = False,
) -> None:
    """Write a motion of SMPL's joints as a program would.

    Args:
        path: file to write.
        family: names.
        rotations: (T, 24, 3, 3) global rotations.
        translation: (T, 3) pelvis position, metres.
        unit: of length, a key of `UNITS`, or metres.
        axes: of the world, a key of `AXES`.
        order: of the rotation channels.
        zero: (24, 3, 3) rotations of the pose in which all angles are zero; None is the T-pose.
        seed: of random axes for each joint, in which the zero pose is no pose of a body.
        frame_time: seconds.
        more_positions: whether each joint has position channels.
    """
    made, world = joints_of(family), AXES[axes]
    metre = UNITS[unit] if isinstance(unit, str) else unit
    frames = np.tile(np.eye(3), (24, 1, 1)) if zero is None else np.swapaxes(zero, -1, -2)
    own = frames[made.smpl]  # axes of each joint in the T-pose, seen from T
    if seed is not None:
        own = Rotation.random(len(made.names), np.random.default_rng(seed)).as_matrix()
    turned = world @ rotations[:, made.smpl] @ own @ world.T  # files' joints have the files' axes
    local = np.array(
        [
            turned[:, j] if p < 0 else np.swapaxes(turned[:, p], -1, -2) @ turned[:, j]
            for j, p in enumerate(made.parents)
        ]
    )
    offsets = [
        world @ (offset if p < 0 else own[p].T @ offset) / metre
        for offset, p in zip(made.offsets, made.parents, strict=True)
    ]
    lines = ["HIERARCHY", *_hierarchy(made, offsets, order, 0, more_positions)]
    lines += ["MOTION", f"Frames: {len(rotations)}", f"Frame Time: {frame_time:.7f}"]
    angles = [Rotation.from_matrix(joint).as_euler(order, degrees=True) for joint in local]
    roots = translation @ world.T / metre
    for frame in range(len(rotations)):
        row = []
        for joint in _depth_first(made, 0):
            if joint == 0 or more_positions:
                row += (roots[frame] if joint == 0 else offsets[joint]).tolist()
            row += angles[joint][frame].tolist()
        lines.append(" ".join(f"{value:.6f}" for value in row))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _depth_first(made: Made, joint: int) -> list[int]:
    children = [child for child, parent in enumerate(made.parents) if parent == joint]
    return [joint, *(below for child in children for below in _depth_first(made, child))]


def _hierarchy(
    made: Made, offsets: Sequence[np.ndarray], order: str, joint: int, more_positions: bool
) -> list[str]:
    channels = [f"{axis}rotation" for axis in order]
    if joint == 0 or more_positions:
        channels = ["Xposition", "Yposition", "Zposition", *channels]
    lines = [f"{'JOINT' if joint else 'ROOT'} {made.names[joint]}", "{"]
    lines.append("OFFSET " + " ".join(f"{value:.6f}" for value in offsets[joint]))
    lines.append(f"CHANNELS {len(channels)} {' '.join(channels)}")
    children = [child for child, parent in enumerate(made.parents) if parent == joint]
    for child in children:
        lines += _hierarchy(made, offsets, order, child, more_positions)
    if not children:
        lines += ["End Site", "{", "OFFSET 0 0 0", "}"]
    return [*lines, "}"]
