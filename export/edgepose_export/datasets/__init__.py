"""Readers for real recordings with true poses, as their makers publish them.

Nobody may pass these data on: a user gets them from their makers and has a licence. What a reader needs to
know of a layout comes from its makers and users; the readers' tests make small files of the same layout.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from edgepose.errors import EdgeposeError
from edgepose_export.datasets.dip_imu import read_dip
from edgepose_export.datasets.totalcapture import read_totalcapture, take_name
from edgepose_export.datasets.vicon import ORIENTATIONS, read_vicon
from edgepose_export.training.dataset import Take

__all__ = ["read_dip", "read_published", "read_totalcapture", "read_vicon"]


def read_published(folder: Path) -> Iterator[Take]:
    """All takes below a folder: DIP's .pkl files, or, where there are any, TotalCapture's .sensors files.

    The true pose of TotalCapture's .sensors is DIP's .pkl of the same name, wherever below the folder, or
    where there is none Vicon's `gt_skel_gbl_ori.txt` in a folder of the take's name.

    Raises:
        EdgeposeError: there is none, or one of them is broken.
    """
    pickles = sorted(folder.rglob("*.pkl"))
    # A take may lie there twice, with and without the magnetometers; the orientations are the same.
    sensors = {take_name(path): path for path in sorted(folder.rglob("*.sensors"))}
    if sensors:
        truth = {take_name(path): path for path in sorted(folder.rglob(ORIENTATIONS))}
        truth |= {path.stem.lower(): path for path in pickles}
        for path in sensors.values():
            yield read_totalcapture(path, folder, truth)
        return
    if not pickles:
        raise EdgeposeError(
            f"{folder}: no .pkl file with true poses; unpack DIP-IMU or DIP's TotalCapture there"
        )
    yield from map(read_dip, pickles)
