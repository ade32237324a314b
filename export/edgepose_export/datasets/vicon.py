"""Reader for TotalCapture's own true poses (cvssp.org/data/totalcapture): a Vicon skeleton of 21 joints.

Each take has a folder `S1/acting1` with `gt_skel_gbl_ori.txt` and `gt_skel_gbl_pos.txt`, 60 frames a second:
a line of joint names, then a line a frame; tabs between joints, also after the last, and blanks within one:
a quaternion x y z w of the bone to the global frame, and a place in inches. The global frame has Y up and is
SMPL's turned by half a turn about Y. In the T-pose each bone has x to the wearer's right, y back, z down.

Sources: the loaders of gait-tech/gaittoolbox (order, unit, axes of the bones), of TransPose and GlobalPose
(tabs, unit, global frame), and the offsets in the BVH file of subject 1, whose limbs lie along these axes.

Against SMPL's joints this is exact for the direction of thighs, shanks, upper arms and forearms, and for the
turn of pelvis, head and limbs as Vicon's solver has it (the sensors are calibrated to the same bones). It is
not exact for the rest: Vicon has four joints between pelvis and neck, of which Spine1 to Spine3 stand for
SMPL's three and Spine is left out; the bones of trunk, neck, head, collars and feet are the identity in the
T-pose, where SMPL poses that were fitted to markers have slopes; toes turn with the feet, wrists and hands
with the forearms. Not confirmed for subjects 2 to 5: the axes of the bones. A file whose limbs do not lie
along them is refused. Whether the forearms turn about their axis or the hands do is not known either.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.errors import EdgeposeError
from edgepose.formats.joint_tree import fail, numbers
from edgepose_export.mocap.retargeting import near_rest, to_smpl

Array = NDArray[np.float64]

ORIENTATIONS, PLACES = "gt_skel_gbl_ori.txt", "gt_skel_gbl_pos.txt"

BODY_FROM_GLOBAL = np.diag([-1.0, 1.0, -1.0])
THEIR_BONE_FROM_OURS = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])

JOINTS = (
    "Hips", "LeftUpLeg", "RightUpLeg", "Spine1", "LeftLeg", "RightLeg", "Spine2", "LeftFoot", "RightFoot",
    "Spine3", "LeftFoot", "RightFoot", "Neck", "LeftShoulder", "RightShoulder", "Head", "LeftArm",
    "RightArm", "LeftForeArm", "RightForeArm", "LeftForeArm", "RightForeArm", "LeftForeArm", "RightForeArm",
)  # fmt: skip
"""The joint whose rotation each SMPL joint takes."""

FAR_ENDS = {
    1: "LeftLeg", 2: "RightLeg", 4: "LeftFoot", 5: "RightFoot",
    16: "LeftForeArm", 17: "RightForeArm", 18: "LeftHand", 19: "RightHand",
}  # fmt: skip
"""SMPL joint at a limb's near end -> joint at its far end."""


def read_vicon(path: Path) -> Array:
    """True bone rotations R_TB (T, 24, 3, 3) of a take.

    The transfer is that of motion capture, see `edgepose_export.mocap.retargeting`.

    Args:
        path: `gt_skel_gbl_ori.txt`, with `gt_skel_gbl_pos.txt` beside it.

    Raises:
        EdgeposeError: one of them is missing or broken, or the limbs do not lie along the bones' axes.
    """
    orientations = _table(path, 4)
    places = _table(path.with_name(PLACES), 3)
    frames, placed = len(orientations[JOINTS[0]]), len(places[JOINTS[0]])
    if frames != placed:
        raise EdgeposeError(f"{path}: has {frames} frames, {PLACES} beside it {placed}")
    rotations = {name: _rotations(path, name, orientations[name]) for name in {*JOINTS}}
    t_pose = THEIR_BONE_FROM_OURS.T
    ends = {
        limb: t_pose @ _direction(rotations[JOINTS[limb]], places[far] - places[JOINTS[limb]])
        for limb, far in FAR_ENDS.items()
    }
    if not near_rest(ends):
        raise EdgeposeError(
            f"{path}: the limbs in {PLACES} do not lie along the bones' axes, as in TotalCapture's skeletons"
        )
    in_body = BODY_FROM_GLOBAL @ np.stack([rotations[name] for name in JOINTS], axis=1)
    return to_smpl(in_body, np.tile(t_pose, (len(JOINTS), 1, 1)), ends)


def _table(path: Path, width: int) -> dict[str, Array]:
    """Numbers (T, width) of each joint of a file."""
    try:
        lines = path.read_text(encoding="ascii", errors="replace").rstrip().splitlines()
    except OSError as error:
        raise EdgeposeError(f"{path}: cannot be read: {error.strerror or error}") from error
    names = lines[0].split() if lines else []
    if missing := sorted({*JOINTS, *FAR_ENDS.values()} - {*names}):
        fail(path, 1, f"the names of joints lack {', '.join(missing)}")
    if len({*names}) < len(names):
        fail(path, 1, "a joint is named twice")
    if len(lines) < 2:
        raise EdgeposeError(f"{path}: has no frame")
    rows = []
    for number, line in enumerate(lines[1:], start=2):
        cells = line.rstrip().split("\t")
        if len(cells) != len(names):
            fail(path, number, f"{len(names)} joints were expected, {len(cells)} found")
        rows.append([numbers(path, number, cell.split(), width) for cell in cells])
    return dict(zip(names, np.array(rows).swapaxes(0, 1), strict=True))


def _rotations(path: Path, name: str, quats: Array) -> Array:
    """Matrices (T, 3, 3) of a joint's quaternions x y z w."""
    norm = np.linalg.norm(quats, axis=1, keepdims=True)
    broken = np.flatnonzero(np.abs(norm - 1.0) > 0.1)
    if len(broken):
        fail(path, 2 + int(broken[0]), f"the quaternion of {name} is not of unit length")
    return rot.quat_to_matrix(np.roll(quats / norm, 1, axis=1))


def _direction(rotations: Array, bone: Array) -> Array:
    """Mean direction (3,) in its own frame of a bone (T, 3); of unit length if the bone is rigid."""
    own = (rot.transpose(rotations) @ bone[..., None]).sum(axis=0)[:, 0]
    return own / max(np.linalg.norm(bone, axis=1).sum(), 1e-12)
