"""Joint names in BVH files: SMPL's, and those of other skeletons with the same joints."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from edgepose.skeleton import JOINTS

_PREFIX = re.compile(r"^(?:mixamorig\d*:?|.*:)")
"""Namespace before a name, such as `mixamorig:` or `Character1:`."""

_ALIKE = {
    "pelvis": "Hips",
    "neck": "Neck",
    "head": "Head",
    "left_ankle": "LeftFoot",
    "left_collar": "LeftShoulder",
    "left_wrist": "LeftHand",
    "left_hand": "LeftHandEnd",
}
"""Names that are the same everywhere outside SMPL; those of the right side follow."""

_MOTION_BUILDER = _ALIKE | {
    "spine1": "Spine",
    "spine2": "Spine1",
    "spine3": "Spine2",
    "left_hip": "LeftUpLeg",
    "left_knee": "LeftLeg",
    "left_foot": "LeftToeBase",
    "left_shoulder": "LeftArm",
    "left_elbow": "LeftForeArm",
}
_UNITY = _ALIKE | {
    "spine1": "Spine",
    "spine2": "Chest",
    "spine3": "UpperChest",
    "left_hip": "LeftUpperLeg",
    "left_knee": "LeftLowerLeg",
    "left_foot": "LeftToes",
    "left_shoulder": "LeftUpperArm",
    "left_elbow": "LeftLowerArm",
}
_ROKOKO = _ALIKE | {
    "spine1": "Spine1",
    "spine2": "Spine2",
    "spine3": "Spine3",
    "left_hip": "LeftThigh",
    "left_knee": "LeftShin",
    "left_foot": "LeftToe",
    "left_shoulder": "LeftArm",
    "left_elbow": "LeftForeArm",
}


def _both_sides(names: dict[str, str], prefix: str = "") -> tuple[str, ...]:
    right = {joint.replace("left", "right"): name.replace("Left", "Right") for joint, name in names.items()}
    return tuple(prefix + (right | names)[joint] for joint in JOINTS)


BVH_NAMES = {
    "smpl": JOINTS,
    "mixamo": _both_sides(_MOTION_BUILDER, "mixamorig:"),
    "unity": _both_sides(_UNITY),
    "motionbuilder": _both_sides(_MOTION_BUILDER),
    "rokoko": _both_sides(_ROKOKO),
}
"""Names of the 24 joints in SMPL's order, by skeleton."""

_NEWTON = _both_sides(_ROKOKO | {"spine3": "Spine4"})
"""Rokoko's own files, whose chest is the fourth joint of the spine."""

_BODY = 22
"""Joints without the hands, which may be missing."""


def find_joints(names: Sequence[str]) -> dict[int, int] | None:
    """Return the index in `names` of each of SMPL's joints; None if the names are of no known skeleton.

    Case and namespaces do not matter. Hands may be missing.
    """
    indices = {_plain(name): index for index, name in enumerate(names)}
    for skeleton in (_NEWTON, *BVH_NAMES.values()):
        found = {joint: indices[name] for joint, name in enumerate(map(_plain, skeleton)) if name in indices}
        if set(range(_BODY)) <= found.keys():
            return found
    return None


def missing_joints(names: Iterable[str]) -> list[str]:
    """Return those of SMPL's joints, without hands, that are missing."""
    there = set(map(_plain, names))
    return [name for name in JOINTS[:_BODY] if name not in there]


def without_namespace(name: str) -> str:
    """Return a joint's name without a namespace such as `mixamorig:`."""
    return _PREFIX.sub("", name)


def _plain(name: str) -> str:
    return without_namespace(name).lower()
