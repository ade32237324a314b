"""Poses at even steps of time, for formats that hold neither times nor frame numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import FileFormatError
from edgepose.placements import PLACEMENTS
from edgepose.pose import PoseSequence
from edgepose.rotations import Array, matrix_to_quat, quat_to_matrix, slerp

MOST_MISSING = 10
"""Frames per pose that may be missing; a file with more has other frame numbers than edgepose's."""


def fill_missing_frames(poses: PoseSequence, name: str) -> tuple[PoseSequence, int]:
    """Interpolate the frames that are missing between poses; all sensors are held in them.

    Args:
        poses: T poses.
        name: of their file, for the message.

    Returns:
        The poses, whose frame numbers have equal steps, and how many of them were interpolated.

    Raises:
        FileFormatError: far more frames are missing than there are poses.
    """
    frames = np.arange(poses.frames[0], poses.frames[-1] + 1, poses.frame_step)
    missing = len(frames) - len(poses.frames)
    if not missing:
        return poses, 0
    if missing > MOST_MISSING * len(poses.frames):
        raise FileFormatError(
            f"{name}: {missing} frames are missing between its {len(poses.frames)} poses; renumber them"
        )
    after = np.searchsorted(poses.frames, frames)
    before = np.where(poses.frames[after] == frames, after, after - 1)
    share = (frames - poses.frames[before]) / np.maximum(1, poses.frames[after] - poses.frames[before])
    quats = matrix_to_quat(poses.rotations)
    between = share > 0.0
    rotations = poses.rotations[before].copy()
    rotations[between] = quat_to_matrix(
        slerp(quats[before[between]], quats[after[between]], share[between, None])
    )

    def linear(values: NDArray[Any], share: Array) -> Array:
        return np.asarray(values[before] + share * (values[after] - values[before]))

    translation, contacts = poses.translation, poses.contacts
    everything = frozenset(PLACEMENTS)
    filled = PoseSequence(
        frames,
        linear(poses.time_s, share),
        rotations,
        None if translation is None else linear(translation, share[:, None]),
        [everything if gap else poses.held[i] for i, gap in zip(before, between, strict=True)],
        [poses.warming_up[i] for i in before],
        poses.about,
        None if contacts is None else linear(contacts, share[:, None]).astype(np.float32),
    )
    return filled, missing
