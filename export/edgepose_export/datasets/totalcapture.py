"""Reader for TotalCapture's own files (cvssp.org/data/totalcapture): Xsens sensors and their calibration.

`edgepose.formats.recordings.totalcapture` reads the sensors' readings. The calibration is in
`sN_NAME_calib_imu_ref.txt` (inertial to global frame) and `sN_NAME_calib_imu_bone.txt` (sensor to bone): the
number of sensors, then for each its name and a quaternion x y z w. Global frame and bones are those of
`vicon`. True poses are DIP's SMPL poses, whose last frame is that of the sensors, or else TotalCapture's own.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.calibration import GRAVITY
from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.dip_imu import read_true_pose
from edgepose.formats.recordings.totalcapture import NAMES, read_sensors
from edgepose.placements import BONES
from edgepose.skeleton import local_from_global
from edgepose_export.datasets.vicon import BODY_FROM_GLOBAL, THEIR_BONE_FROM_OURS, read_vicon
from edgepose_export.training.dataset import Take

Array = NDArray[np.float64]

LICENSE = "TotalCapture (cvssp.org/data/totalcapture), for non-commercial research"

_MAX_DISTANCE_DEG = (
    30.0  # between sensors and Vicon of one take; medians of 2 to 8 are reported for real ones
)


def read_totalcapture(path: Path, folder: Path, truth: Mapping[str, Path]) -> Take:
    """Read a take of Xsens sensors, at 60 frames per second.

    Args:
        path: `NAME_Xsens_AuxFields.sensors` in the folder of its subject, `s1` to `s5`.
        folder: folder that is searched for the calibration files.
        truth: DIP's pickles or TotalCapture's `gt_skel_gbl_ori.txt`, by `take_name`.

    Raises:
        EdgeposeError: a file is missing or broken; names the file and the line.
    """
    name = take_name(path)
    readings = read_sensors(path)
    if readings.damage:
        raise EdgeposeError(readings.damage)
    orientation, force = readings.orientation, readings.force
    refs = _calibration(folder, f"{name}_calib_imu_ref.txt")
    bones = _calibration(folder, f"{name}_calib_imu_bone.txt")
    if name not in truth:
        raise EdgeposeError(
            f"{path}: needs the true poses: {name}.pkl from DIP's authors, or "
            f"{name.replace('_', '/')}/gt_skel_gbl_ori.txt of TotalCapture"
        )
    to_body = BODY_FROM_GLOBAL @ refs
    r_tb = to_body @ orientation @ rot.transpose(bones) @ THEIR_BONE_FROM_OURS
    acceleration = (to_body @ orientation @ force[..., None])[..., 0] - [0.0, GRAVITY, 0.0]
    pose, common = _true_pose(truth[name], r_tb)
    return Take(
        name,
        r_tb[common].astype(np.float32),
        acceleration[common].astype(np.float32),
        pose[common].astype(np.float32),
        LICENSE,
    )


def take_name(path: Path) -> str:
    """Return subject and action, such as `s1_acting1`, of a sensor file or of a Vicon file.

    Sensor files are called `s1/acting1_Xsens_AuxFields.sensors` or `s1_acting1_Xsens.sensors`, Vicon files
    `S1/acting1/gt_skel_gbl_ori.txt`.
    """
    stem = path.stem if path.suffix == ".sensors" else path.parent.name
    action = stem.lower().partition("_xsens")[0]
    if re.match(r"s\d_", action):
        return action
    subject = next((p.name.lower() for p in path.parents if re.fullmatch(r"[sS]\d", p.name)), "")
    return f"{subject}_{action}"


def _true_pose(path: Path, r_tb: Array) -> tuple[Array, slice]:
    """Return local rotations (T, 24, 3, 3) from either file, and the frames shared with the sensors."""
    if path.suffix == ".pkl":
        pose = read_true_pose(path)
        return pose, slice(-min(len(pose), len(r_tb)), None)
    bones = read_vicon(path)
    return local_from_global(bones), _shared_frames(path, r_tb, bones[:, list(BONES)])


def _shared_frames(path: Path, r_tb: Array, true: Array) -> slice:
    """Return the frames that two recordings (T, 6, 3, 3) of a take share: the first or the last ones.

    Users of the data disagree on whether the longer one is cut at its start or its end, so the orientations
    decide.
    """
    frames = min(len(r_tb), len(true))
    choices = (slice(-frames, None), slice(frames))
    distances = [np.median(rot.geodesic_angle(r_tb[part], true[part]), axis=0).mean() for part in choices]
    best = int(np.argmin(distances))
    if distances[best] > np.radians(_MAX_DISTANCE_DEG):
        raise EdgeposeError(
            f"{path}: its bones are {np.degrees(distances[best]):.0f} degrees off the sensors; "
            f"it belongs to another take, or its layout is not TotalCapture's"
        )
    return choices[best]


def _calibration(folder: Path, name: str) -> Array:
    """Read rotations (6, 3, 3) from a calibration file, anywhere below a folder."""
    path = next(iter(sorted(p for p in folder.rglob("*.txt") if p.name.lower() == name)), None)
    if path is None:
        raise EdgeposeError(f"{folder}: no {name}, the calibration of these sensors")
    try:
        rows = {
            line.split()[0]: line.split()[1:] for line in path.read_text().splitlines()[1:] if line.strip()
        }
        x, y, z, w = np.array([[float(v) for v in rows[name]] for name in NAMES]).T
        quats = np.stack([w, x, y, z], axis=1)
    except (OSError, ValueError, KeyError) as error:
        raise EdgeposeError(f"{path}: not a calibration of {', '.join(NAMES)} ({error})") from error
    norm = np.linalg.norm(quats, axis=1, keepdims=True)
    if not (np.abs(norm - 1.0) < 0.1).all():
        raise EdgeposeError(f"{path}: a quaternion is not of unit length")
    return rot.quat_to_matrix(quats / norm)
