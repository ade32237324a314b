"""True poses in the pickles of DIP-IMU, and of TotalCapture as DIP's authors publish it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from edgepose.formats.poses.base import PoseFormat, all_new
from edgepose.formats.recordings import dip_imu
from edgepose.pose import PoseSequence


def read_dip(path: Path) -> tuple[PoseSequence, None]:
    """True poses of DIP-IMU or of DIP's TotalCapture."""
    rotations = dip_imu.read_true_pose(path)
    count = len(rotations)
    frames = np.arange(count)
    return PoseSequence(frames, frames / dip_imu.RATE, rotations, None, *all_new(count)), None


# Such a file is a recording of sensors; its poses are read where poses are asked for.
FORMAT = PoseFormat((".pkl",), read_dip, holds_poses=lambda path: False)
