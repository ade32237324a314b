"""Reader for TotalCapture's own true poses (cvssp.org/data/totalcapture): a Vicon skeleton of 21 joints.

Each take has a folder `S1/acting1` with `gt_skel_gbl_ori.txt` (quaternions x y z w, bone to global frame) and
`gt_skel_gbl_pos.txt` (positions, inches), at 60 frames per second. The first line holds joint names, each
further line a frame. A tab follows each joint, and spaces separate a joint's numbers. The global frame has Y
up and is SMPL's, rotated by 180 deg about Y. In the T-pose each bone has x to the wearer's right, y back, z
down.

Sources: the loaders of gait-tech/gaittoolbox (order, unit, axes of the bones), of TransPose and GlobalPose
(tabs, unit, global frame), and the offsets in the BVH file of subject 1, whose limbs lie along these axes.

The transfer to SMPL is exact for the directions of thighs, shanks, upper arms and forearms, and for the
rotations of pelvis, head and limbs as Vicon's solver found them (the sensors are calibrated to the same
bones). The rest is approximate. Vicon has four joints between pelvis and neck: Spine1 to Spine3 are used for
SMPL's three, Spine is not used. The bones of trunk, neck, head, collars and feet are the identity in the
T-pose, whereas SMPL poses fitted to markers have slopes there. Toes rotate with the feet, wrists and hands
with the forearms. The axes of the bones are not confirmed for subjects 2 to 5; a file whose limbs do not lie
along them is rejected. It is also unknown whether the forearms or the hands rotate about the forearm's axis.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.errors import EdgeposeError
from edgepose.formats.joint_tree import fail, numbers
from edgepose_export.mocap.rest_pose import near_rest
from edgepose_export.mocap.retargeting import to_smpl

Array = NDArray[np.float64]

ORIENTATIONS, POSITIONS = "gt_skel_gbl_ori.txt", "gt_skel_gbl_pos.txt"

BODY_FROM_GLOBAL = np.diag([-1.0, 1.0, -1.0])
THEIR_BONE_FROM_OURS = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])

JOINTS = (
    "Hips", "LeftUpLeg", "RightUpLeg", "Spine1", "LeftLeg", "RightLeg", "Spine2", "LeftFoot", "RightFoot",
    "Spine3", "LeftFoot", "RightFoot", "Neck", "LeftShoulder", "RightShoulder", "Head", "LeftArm",
    "RightArm", "LeftForeArm", "RightForeArm", "LeftForeArm", "RightForeArm", "LeftForeArm", "RightForeArm",
)  # fmt: skip
"""The Vicon joint that gives each SMPL joint its rotation."""

FAR_ENDS = {
    1: "LeftLeg", 2: "RightLeg", 4: "LeftFoot", 5: "RightFoot",
    16: "LeftForeArm", 17: "RightForeArm", 18: "LeftHand", 19: "RightHand",
}  # fmt: skip
"""SMPL joint at the near end of a limb -> Vicon joint at its far end."""


def read_vicon(path: Path) -> Array:
    """Read the true bone rotations R_TB (T, 24, 3, 3) of a take.

    They are transferred to SMPL as motion capture is, see `edgepose_export.mocap.retargeting`.

    Args:
        path: `gt_skel_gbl_ori.txt`, with `gt_skel_gbl_pos.txt` in the same folder.

    Raises:
        EdgeposeError: a file is missing or broken, or the limbs do not lie along the bones' axes.
    """
    orientations = _table(path, 4)
    positions = _table(path.with_name(POSITIONS), 3)
    frames, others = len(orientations[JOINTS[0]]), len(positions[JOINTS[0]])
    if frames != others:
        raise EdgeposeError(f"{path}: has {frames} frames, but {POSITIONS} beside it has {others}")
    rotations = {name: _rotations(path, name, orientations[name]) for name in {*JOINTS}}
    t_pose = THEIR_BONE_FROM_OURS.T
    ends = {
        limb: t_pose @ _direction(rotations[JOINTS[limb]], positions[far] - positions[JOINTS[limb]])
        for limb, far in FAR_ENDS.items()
    }
    if not near_rest(ends):
        raise EdgeposeError(
            f"{path}: the limbs in {POSITIONS} do not lie along the bones' axes, unlike TotalCapture's"
        )
    in_body = BODY_FROM_GLOBAL @ np.stack([rotations[name] for name in JOINTS], axis=1)
    return to_smpl(in_body, np.tile(t_pose, (len(JOINTS), 1, 1)), ends)


def _table(path: Path, width: int) -> dict[str, Array]:
    """Read the numbers (T, width) of each joint of a file."""
    try:
        lines = path.read_text(encoding="ascii", errors="replace").rstrip().splitlines()
    except OSError as error:
        raise EdgeposeError(f"{path}: cannot be read: {error.strerror or error}") from error
    names = lines[0].split() if lines else []
    if missing := sorted({*JOINTS, *FAR_ENDS.values()} - {*names}):
        fail(path, 1, f"joint names are missing: {', '.join(missing)}")
    if len({*names}) < len(names):
        fail(path, 1, "a joint is named twice")
    if len(lines) < 2:
        raise EdgeposeError(f"{path}: has no frames")
    rows = []
    for number, line in enumerate(lines[1:], start=2):
        cells = line.rstrip().split("\t")
        if len(cells) != len(names):
            fail(path, number, f"expected {len(names)} joints, found {len(cells)}")
        rows.append([numbers(path, number, cell.split(), width) for cell in cells])
    return dict(zip(names, np.array(rows).swapaxes(0, 1), strict=True))


def _rotations(path: Path, name: str, quats: Array) -> Array:
    """Return the matrices (T, 3, 3) of a joint's quaternions x y z w."""
    norm = np.linalg.norm(quats, axis=1, keepdims=True)
    broken = np.flatnonzero(np.abs(norm - 1.0) > 0.1)
    if len(broken):
        fail(path, 2 + int(broken[0]), f"the quaternion of {name} is not of unit length")
    return rot.quat_to_matrix(np.roll(quats / norm, 1, axis=1))


def _direction(rotations: Array, bone: Array) -> Array:
    """Return the mean direction (3,) of a bone (T, 3) in its own frame, of length 1 if the bone is rigid."""
    total = (rot.transpose(rotations) @ bone[..., None]).sum(axis=0)[:, 0]
    return total / max(np.linalg.norm(bone, axis=1).sum(), 1e-12)
