"""Reader for takes in DIP's pickles; see `edgepose.formats.recordings.dip_imu` for their layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from edgepose.formats.recordings import dip_imu
from edgepose_export.training.dataset import Take

LICENSE = "DIP-IMU (dip.is.tue.mpg.de), for non-commercial scientific research"


def read_dip(path: Path) -> Take:
    """Read a take of DIP-IMU, or of TotalCapture as DIP's authors publish it, at 60 frames per second.

    A sensor that is missing in a frame gets its values of the nearest frame.

    Raises:
        EdgeposeError: the file is not of this kind.
    """
    take = dip_imu.read_dip(path)
    return Take(
        f"{path.parent.name}_{path.stem}",
        take.orientation.astype(np.float32),
        take.acceleration.astype(np.float32),
        take.pose.astype(np.float32),
        LICENSE,
    )
