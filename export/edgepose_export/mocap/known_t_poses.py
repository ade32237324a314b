"""T-poses of skeletons whose files contain none: CMU's and Bandai-Namco's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from edgepose.rotations import rotation_about_axis

Array = NDArray[np.float64]

# Angles of the T-pose in frame 0 of cgspeed's conversion against the zero pose of CMU's skeletons, degrees,
# by the names in ASF and in BVH. ASF/AMC files have no T-pose, and some conversions leave it out.
_CMU = {
    ("lfemur", "LeftUpLeg"): ("z", -21.0),
    ("rfemur", "RightUpLeg"): ("z", 21.0),
    ("lowerneck", "Neck"): ("x", -16.0),
    ("upperneck", "Neck1"): ("x", 21.0),
    ("head", "Head"): ("x", 11.0),
    ("lhumerus", "LeftArm"): ("z", -8.0),
    ("rhumerus", "RightArm"): ("z", 8.0),
}
_CMU_MORE = ({"lhipjoint", "thorax"}, {"LHipJoint", "LowerBack", "Spine1"})
"""Further names that tell CMU's skeletons from others."""

_BANDAI_NAMES = {"joint_Root", "Hips", "Spine", "Chest", "Neck", "Head"} | {
    f"{name}_{side}"
    for name in ("Shoulder", "UpperArm", "LowerArm", "Hand", "UpperLeg", "LowerLeg", "Foot", "Toes")
    for side in "LR"
}


def is_cmu(names: Sequence[str]) -> bool:
    """Return whether a skeleton has CMU's names, in ASF or in BVH."""
    there = set(names)
    return any({pair[i] for pair in _CMU} | _CMU_MORE[i] <= there for i in range(2))


def is_bandai(names: Sequence[str]) -> bool:
    """Return whether a skeleton has Bandai-Namco's names."""
    return set(names) == _BANDAI_NAMES


def cmu_t_pose(names: Sequence[str]) -> Array:
    """Return local rotations (J, 3, 3) of the T-pose against the zero pose of a skeleton of CMU's."""
    angles = {name: angle for pair, angle in _CMU.items() for name in pair}
    local = np.tile(np.eye(3), (len(names), 1, 1))
    for joint, name in enumerate(names):
        if name in angles:
            axis, degrees = angles[name]
            local[joint] = rotation_about_axis(axis, np.radians(degrees))
    return local


# Angles of people who stand straight, in Bandai-Namco's axes, degrees: means over the 284 takes of dataset 2
# in normal style that contain standing with hanging arms (4450 frames, standard deviation up to 2.3). A
# wearer's calibration makes these angles zero, so they belong to the T-pose.
_HEAD = 8.5  # pitch forward
_NECK = 4.1
_COLLAR = 17.5  # yaw backwards, relative to the chest; only in dataset 2, collars are straight in dataset 1
_FOOT = 39.0  # pitch of the line from ankle to toe joint when the sole is flat on the floor
_TOES = 23.0


def bandai_t_pose(names: Sequence[str], collars_back: bool) -> Array:
    """Return global rotations (J, 3, 3) of Bandai-Namco's joints in a straight T-pose.

    The zero pose is none, so the rotations follow from the directions of the bones' axes.

    Args:
        names: names of the joints.
        collars_back: collars point backwards in straight standing (dataset 2).
    """
    left, up, forward = np.eye(3)
    trunk, left_arm, right_arm = (up, forward, left), (left, up, forward), (left, -up, -forward)
    axes: Mapping[str, tuple[Array, Array, Array]] = {  # directions of a bone's x, y, z
        "joint_Root": (left, up, forward),
        "Hips": (up, -left, forward),
        **dict.fromkeys(("Spine", "Chest", "Neck", "Head"), trunk),
        **{f"{arm}_L": left_arm for arm in ("Shoulder", "UpperArm", "LowerArm", "Hand")},
        **{f"{arm}_R": right_arm for arm in ("Shoulder", "UpperArm", "LowerArm", "Hand")},
        **dict.fromkeys(("UpperLeg_L", "LowerLeg_L"), (-up, left, forward)),
        **dict.fromkeys(("UpperLeg_R", "LowerLeg_R"), (up, left, -forward)),
        **dict.fromkeys(("Foot_L", "Toes_L"), (forward, left, up)),
        **dict.fromkeys(("Foot_R", "Toes_R"), (-forward, left, -up)),
    }
    lean = {"Head": _HEAD, "Neck": _NECK}
    lean |= {f"{name}_{side}": angle for name, angle in (("Foot", _FOOT), ("Toes", _TOES)) for side in "LR"}
    yaw = {"Shoulder_L": _COLLAR, "Shoulder_R": -_COLLAR} if collars_back else {}
    poses = []
    for name in names:
        pose = np.stack(axes[name], axis=1)
        if name in lean:
            pose = rotation_about_axis("x", np.radians(lean[name])) @ pose
        if name in yaw:
            pose = rotation_about_axis("y", np.radians(yaw[name])) @ pose
        poses.append(pose)
    return np.stack(poses)
