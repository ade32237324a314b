"""Reader for AMASS files: SMPL, SMPL-H or SMPL-X poses in .npz files, in a world with Z up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError
from edgepose.formats.joint_tree import LARGEST
from edgepose.rotations import Z_UP_TO_T, rotvec_to_matrix
from edgepose.skeleton import PARENTS
from edgepose.utils.safe_npz import BROKEN, open_npz

from .motion import Motion

Array = NDArray[np.float64]

BODY_JOINTS = 22
"""Joints that SMPL, SMPL-H and SMPL-X share; 22 and 23 are hands in SMPL, fingers or face in the others."""


def read_amass(path: str | Path) -> Motion:
    """Read the motion in an AMASS file.

    The file holds `poses` (T, 72 or more), `trans` (T, 3), and `mocap_framerate` or `mocap_frame_rate`.
    The translation is that of the file. The position of the pelvis in the body's template, a constant offset
    of about 0.2 m, is not added, because it needs the body model.

    Raises:
        EdgeposeError: the file is of another kind, or holds a number that is not finite.
    """
    path = Path(path)
    fields = _load(path)
    if "poses" not in fields or "trans" not in fields:
        raise EdgeposeError(f"{path}: not an AMASS motion: it needs 'poses' and 'trans'")
    rate_field = next((fields[key] for key in ("mocap_framerate", "mocap_frame_rate") if key in fields), None)
    if rate_field is None or rate_field.size != 1:
        raise EdgeposeError(f"{path}: needs one number 'mocap_framerate' or 'mocap_frame_rate'")
    rate = float(rate_field.reshape(()))
    poses, trans = fields["poses"], fields["trans"]
    if not 1e-2 < rate < 1e5:
        raise EdgeposeError(f"{path}: a frame rate of {rate:g} Hz is impossible")
    if poses.ndim != 2 or poses.shape[1] < 72 or poses.shape[1] % 3:
        raise EdgeposeError(f"{path}: 'poses' must have the shape (frames, 72 or more), not {poses.shape}")
    if not len(poses) or trans.shape != (len(poses), 3):
        raise EdgeposeError(
            f"{path}: 'trans' must have the shape ({len(poses)}, 3) and a frame, not {trans.shape}"
        )
    for name, values in (("poses", poses), ("trans", trans)):
        bad = np.flatnonzero(~(np.abs(values) < LARGEST).all(axis=1))
        if len(bad):
            raise EdgeposeError(f"{path}: '{name}' is not finite, or far too large, in frame {bad[0]}")

    local = np.broadcast_to(np.eye(3), (len(poses), 24, 3, 3)).copy()
    joints = 24 if poses.shape[1] == 72 else BODY_JOINTS
    local[:, :joints] = rotvec_to_matrix(poses[:, : 3 * joints].reshape(len(poses), joints, 3))
    rotations = np.empty_like(local)
    rotations[:, 0] = Z_UP_TO_T @ local[:, 0]
    for joint, parent in enumerate(PARENTS[1:], start=1):
        rotations[:, joint] = rotations[:, parent] @ local[:, joint]
    return Motion(rotations, trans @ Z_UP_TO_T.T, rate, "amass")


def _load(path: Path) -> dict[str, Array]:
    """Return the fields of the file that are used, as numbers."""
    wanted = ("poses", "trans", "mocap_framerate", "mocap_frame_rate")
    try:
        with open_npz(path) as archive:
            return {key: np.asarray(archive[key], float) for key in wanted if key in archive.files}
    except OSError as error:
        raise EdgeposeError(f"{path}: cannot be read: {error.strerror or error}") from None
    except BROKEN as error:
        raise EdgeposeError(
            f"{path}: not a readable npz archive of numbers ({error})".replace("\n", " ")
        ) from None
