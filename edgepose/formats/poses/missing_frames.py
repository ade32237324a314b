"""Poses at even steps of time, for formats that hold neither times nor frame numbers."""

from __future__ import annotations

import numpy as np

from edgepose.errors import FileFormatError
from edgepose.formats.poses.resampling import interpolate
from edgepose.placements import PLACEMENTS
from edgepose.pose import PoseSequence

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
    everything = frozenset(PLACEMENTS)
    filled = interpolate(poses, before, share)
    held = [everything if gap else poses.held[i] for i, gap in zip(before, share > 0.0, strict=True)]
    return filled._replace(frames=frames, held=held), missing
