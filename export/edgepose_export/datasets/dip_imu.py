"""DIP's pickles as takes; their layout is that of `edgepose.formats.recordings.dip_imu`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from edgepose.formats.recordings import dip_imu
from edgepose_export.training.dataset import Take

LICENSE = "DIP-IMU (dip.is.tue.mpg.de), for non-commercial scientific research"


def read_dip(path: Path) -> Take:
    """A take of DIP-IMU, or of TotalCapture as DIP's authors publish it; 60 frames a second.

    Frames in which a sensor is missing have its values of the nearest frame.

    Raises:
        EdgeposeError: not such a file.
    """
    take = dip_imu.read_dip(path)
    return Take(
        f"{path.parent.name}_{path.stem}",
        take.orientation.astype(np.float32),
        take.acceleration.astype(np.float32),
        take.pose.astype(np.float32),
        LICENSE,
    )
