"""Retargeting from the skeletons of the motion-capture sources to the 24 SMPL joints.

A bone's rotation is taken relative to the source's T-pose, and its limb direction is kept exactly:

    G_smpl = G_src inv(G0) minrot(SMPL rest direction -> source T-pose direction)

`G_src` is the source bone's global rotation, `G0` the same in the source's T-pose. In the T-pose the SMPL
bone thus points in the source's direction instead of its rest direction (the arms of CMU's T-pose hang by
8 deg), and both point the same way in every pose. All other bones (trunk, neck, head, collars, feet) are the
identity in the source's T-pose, because a wearer's trunk is calibrated to the identity when they stand
straight, whatever the slope of the line between two vertebrae.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError
from edgepose.formats.joint_tree import JointTree, forward
from edgepose.rotations import (
    matrix_to_quat,
    minimal_rotation,
    quat_to_matrix,
    rotation_about_axis,
    transpose,
)

from .motion import Motion

Array = NDArray[np.float64]

LIMBS = {1: "-y", 2: "-y", 4: "-y", 5: "-y", 16: "+x", 17: "-x", 18: "+x", 19: "-x"}
"""Direction of each limb bone in SMPL's zero pose, without the slight tilts of the template."""

_DIRECTIONS = {"+x": (1.0, 0.0, 0.0), "-x": (-1.0, 0.0, 0.0), "-y": (0.0, -1.0, 0.0)}
_FOREARM_OF = {20: 18, 21: 19, 22: 18, 23: 19}  # wrists and hands stay at rest against the forearms

CMU_METRES = 0.0254 / 0.45
"""CMU lengths are inches times 0.45, and the BVH conversion kept them."""
BANDAI_METRES = 0.01


class Names(NamedTuple):
    """Names of a source's joints by their role."""

    joints: tuple[str, ...]
    """(24) the source joint that gives each SMPL joint its rotation."""
    bones: dict[int, tuple[str, str]]
    """Source joints at both ends of each limb (key of `LIMBS`)."""


def _names(trunk: str, left: str, right: str) -> Names:
    """Build `Names` from the trunk (pelvis, three spines, neck, head) and both sides.

    A side lists thigh, shank, foot, toes, collar, upper arm, the joint that rotates with the forearm's far
    end, forearm, hand.
    """
    pelvis, spine1, spine2, spine3, neck, head = trunk.split()
    sides = (left.split(), right.split())
    joints = [""] * 24
    for joint, name in zip((0, 3, 6, 9, 12, 15), (pelvis, spine1, spine2, spine3, neck, head), strict=True):
        joints[joint] = name
    bones: dict[int, tuple[str, str]] = {}
    for side, (thigh, shank, foot, toes, collar, arm, twisting, forearm, hand) in enumerate(sides):
        for joint, name in zip(
            (1, 4, 7, 10, 13, 16, 18), (thigh, shank, foot, toes, collar, arm, twisting), strict=True
        ):
            joints[joint + side] = name
        bones |= {
            1 + side: (thigh, shank),
            4 + side: (shank, foot),
            16 + side: (arm, forearm),
            18 + side: (forearm, hand),
        }
    for joint, forearm_joint in _FOREARM_OF.items():
        joints[joint] = joints[forearm_joint]
    return Names(tuple(joints), bones)


# CMU's forearms do not rotate about their axis: the next joint (wrist) does, and does nothing else. A sensor
# near the wrist measures that rotation.
CMU_BVH = _names(
    "Hips LowerBack Spine Spine1 Neck Head",
    "LeftUpLeg LeftLeg LeftFoot LeftToeBase LeftShoulder LeftArm LeftHand LeftForeArm LeftHand",
    "RightUpLeg RightLeg RightFoot RightToeBase RightShoulder RightArm RightHand RightForeArm RightHand",
)
CMU_AMC = _names(
    "root lowerback upperback thorax lowerneck head",
    "lfemur ltibia lfoot ltoes lclavicle lhumerus lwrist lradius lwrist",
    "rfemur rtibia rfoot rtoes rclavicle rhumerus rwrist rradius rwrist",
)
BANDAI = _names(
    "Hips Spine Chest Chest Neck Head",
    "UpperLeg_L LowerLeg_L Foot_L Toes_L Shoulder_L UpperArm_L LowerArm_L LowerArm_L Hand_L",
    "UpperLeg_R LowerLeg_R Foot_R Toes_R Shoulder_R UpperArm_R LowerArm_R LowerArm_R Hand_R",
)

# Angles of the T-pose in frame 0 of the BVH conversion, degrees; the AMC files have no T-pose.
_CMU_T_POSE = {
    "lfemur": ("z", -21.0),
    "rfemur": ("z", 21.0),
    "lowerneck": ("x", -16.0),
    "upperneck": ("x", 21.0),
    "head": ("x", 11.0),
    "lhumerus": ("z", -8.0),
    "rhumerus": ("z", 8.0),
}


def from_cmu_bvh(recording: JointTree, path: object) -> Motion:
    """Retarget a CMU file in cgspeed's conversion: frame 0 is the T-pose, the motion starts after it.

    In two takes (07_12, 09_10) frames that are all zero follow the T-pose; these are left out, too.

    Raises:
        EdgeposeError: frame 0 is no T-pose, or no frame follows it; the message names `path`.
    """
    filled = (recording.rotations != np.eye(3)).any(axis=(1, 2, 3)) | recording.positions[:, 0].any(axis=1)
    filled[0] = False
    if not filled.any():
        raise EdgeposeError(f"{path}: contains only the T-pose of frame 0, no motion")
    start = int(np.argmax(filled))
    rotations, positions = forward(recording)
    ends = _bone_directions(CMU_BVH, recording.names, positions[0])
    if not near_rest(ends):
        raise EdgeposeError(f"{path}: frame 0 is not the T-pose, with which CMU's BVH files start")
    picked = rotations[:, _indices(CMU_BVH, recording.names)]
    return Motion(
        to_smpl(picked[start:], picked[0], ends),
        positions[start:, recording.names.index(CMU_BVH.joints[0])] * CMU_METRES,
        recording.rate,
        "cmu",
    )


def from_cmu_amc(recording: JointTree, path: object) -> Motion:
    """Retarget a CMU file in ASF/AMC; the result agrees with `from_cmu_bvh` of the same take.

    Raises:
        EdgeposeError: the skeleton is not like CMU's; the message names `path`.
    """
    local = np.broadcast_to(np.eye(3), (1, len(recording.names), 3, 3)).copy()
    for name, (axis, angle) in _CMU_T_POSE.items():
        if name not in recording.names:
            raise EdgeposeError(f"{path}: the skeleton has no {name}, so it is not one of CMU's")
        local[0, recording.names.index(name)] = rotation_about_axis(axis, np.radians(angle))
    pose = recording._replace(rotations=local, positions=recording.offsets[None])
    t_pose, t_positions = forward(pose)
    indices = _indices(CMU_AMC, recording.names)
    rotations, positions = forward(recording)
    ends = _bone_directions(CMU_AMC, recording.names, t_positions[0])
    if not near_rest(ends):
        raise EdgeposeError(f"{path}: the limbs of the skeleton do not lie as in CMU's skeletons")
    return Motion(
        to_smpl(rotations[:, indices], t_pose[0, indices], ends), positions[:, 0], recording.rate, "cmu"
    )


# Angles of people who stand straight, in Bandai-Namco's axes, degrees: means over the 284 takes of dataset 2
# in normal style that contain standing with hanging arms (4450 frames, standard deviation up to 2.3). A
# wearer's calibration makes these angles zero, so they belong to G0.
_BANDAI_HEAD = 8.5  # pitch forward
_BANDAI_NECK = 4.1
_BANDAI_COLLAR = (
    17.5  # yaw backwards, relative to the chest; only in dataset 2, collars are straight in dataset 1
)
_BANDAI_FOOT = 39.0  # pitch of the line from ankle to toe joint when the sole is flat on the floor
_BANDAI_TOES = 23.0


def from_bandai(recording: JointTree, path: object, collars_back: bool = True) -> Motion:
    """Retarget a Bandai-Namco file.

    Its zero pose is no T-pose, so G0 follows from the directions of its bone axes.

    Args:
        recording: content of the file.
        path: the file, for error messages.
        collars_back: collars point 17.5 deg backwards in straight standing (dataset 2; not so in dataset 1).

    Raises:
        EdgeposeError: the skeleton is not like Bandai-Namco's.
    """
    rotations, positions = forward(recording)
    picked = rotations[:, _indices(BANDAI, recording.names)].copy()
    for elbow, hand in ((18, "Hand_L"), (19, "Hand_R")):
        # Some takes rotate the forearm in its own joint, some in the hand's. A sensor near the wrist measures
        # both.
        quats = matrix_to_quat(recording.rotations[:, recording.names.index(hand)])
        quats[:, 2:] = 0.0  # leaves the rotation about x, the forearm's axis
        quats /= np.maximum(np.linalg.norm(quats, axis=-1, keepdims=True), 1e-9)
        picked[:, elbow] @= quat_to_matrix(quats)
    t_pose = bandai_t_pose(_BANDAI_COLLAR if collars_back else 0.0)
    ends = {}
    for limb, (start, end) in BANDAI.bones.items():
        joint, child = recording.names.index(start), recording.names.index(end)
        if recording.parents[child] != joint:
            raise EdgeposeError(f"{path}: {end} is not a child of {start}")
        ends[limb] = t_pose[limb] @ _unit(recording.offsets[child])
    if not near_rest(ends):
        raise EdgeposeError(f"{path}: the limbs of the skeleton do not lie as in Bandai-Namco's skeleton")
    translation = positions[:, recording.names.index(BANDAI.joints[0])] * BANDAI_METRES
    return Motion(to_smpl(picked, t_pose, ends), translation, recording.rate, "bandai-namco")


def bandai_t_pose(collar: float) -> Array:
    """Return rotations (24, 3, 3) of Bandai-Namco's bones in a straight T-pose; `collar`: yaw, degrees."""
    left, up, forward_ = np.eye(3)
    axes = {  # directions of a bone's x, y, z
        "pelvis": (up, -left, forward_),
        "trunk": (up, forward_, left),
        "left_arm": (left, up, forward_),
        "right_arm": (left, -up, -forward_),
        "left_leg": (-up, left, forward_),
        "right_leg": (up, left, -forward_),
        "left_foot": (forward_, left, up),
        "right_foot": (-forward_, left, -up),
    }
    kinds = {0: "pelvis", **dict.fromkeys((3, 6, 9, 12, 15), "trunk")}
    for side, name in enumerate(("left", "right")):
        kinds |= {joint + side: f"{name}_arm" for joint in (13, 16, 18, 20, 22)}
        kinds |= {joint + side: f"{name}_leg" for joint in (1, 4)}
        kinds |= {joint + side: f"{name}_foot" for joint in (7, 10)}
    t_pose = np.stack([np.stack(axes[kinds[joint]], axis=1) for joint in range(24)])
    lean = {
        15: _BANDAI_HEAD,
        12: _BANDAI_NECK,
        7: _BANDAI_FOOT,
        8: _BANDAI_FOOT,
        10: _BANDAI_TOES,
        11: _BANDAI_TOES,
    }
    for joint, angle in lean.items():
        t_pose[joint] = rotation_about_axis("x", np.radians(angle)) @ t_pose[joint]
    for joint, angle in ((13, collar), (14, -collar)):
        t_pose[joint] = rotation_about_axis("y", np.radians(angle)) @ t_pose[joint]
    return t_pose


def to_smpl(rotations: Array, t_pose: Array, ends: dict[int, Array]) -> Array:
    """Convert global rotations of a source to global SMPL rotations.

    Args:
        rotations: (T, 24, 3, 3) global rotation of each SMPL joint's source joint.
        t_pose: (24, 3, 3) the same in the source's T-pose.
        ends: unit direction (3,) of each limb bone (`LIMBS`) in the source's T-pose.

    Returns:
        (T, 24, 3, 3) rotations that take the SMPL rest direction of each limb to its direction in the source.
    """
    correction = transpose(t_pose)
    for limb, direction in LIMBS.items():
        correction[limb] = correction[limb] @ minimal_rotation(_DIRECTIONS[direction], ends[limb])
    result = rotations @ correction
    for joint, forearm in _FOREARM_OF.items():
        result[:, joint] = result[:, forearm]
    return result


def has_names(names: Names, recording: JointTree) -> bool:
    """Return whether a recording has the joints of a source."""
    return {*names.joints, *(end for bone in names.bones.values() for end in bone)} <= set(recording.names)


def _indices(names: Names, joints: tuple[str, ...]) -> list[int]:
    return [joints.index(name) for name in names.joints]


def _bone_directions(names: Names, joints: tuple[str, ...], positions: Array) -> dict[int, Array]:
    """Return the unit direction of each limb bone for joint positions (J, 3)."""
    return {
        limb: _unit(positions[joints.index(end)] - positions[joints.index(start)])
        for limb, (start, end) in names.bones.items()
    }


def near_rest(ends: dict[int, Array]) -> bool:
    """Return whether all limbs lie within 20 deg of their directions in SMPL's zero pose."""
    least = np.cos(np.radians(20.0))
    return all(ends[limb] @ _DIRECTIONS[direction] > least for limb, direction in LIMBS.items())


def _unit(v: Array) -> Array:
    return v / max(float(np.linalg.norm(v)), 1e-12)
