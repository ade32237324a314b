"""True poses from the pickles of DIP-IMU, and of TotalCapture as published by DIP's authors."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from edgepose.formats.poses.base import PoseFormat, all_new
from edgepose.formats.recordings import dip_imu
from edgepose.pose import PoseSequence


def read_dip(path: Path) -> tuple[PoseSequence, None]:
    """Read the true poses of DIP-IMU or of DIP's TotalCapture."""
    rotations = dip_imu.read_true_pose(path)
    count = len(rotations)
    frames = np.arange(count)
    return PoseSequence(frames, frames / dip_imu.RATE, rotations, None, *all_new(count)), None


# Such a file counts as a recording of sensors; its poses are only read where poses are needed.
FORMAT = PoseFormat((".pkl",), read_dip, holds_poses=lambda path: False)
