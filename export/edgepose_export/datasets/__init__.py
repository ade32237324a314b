"""Readers for published recordings of real sensors with true poses.

The licences forbid redistribution, so users download these datasets themselves. The layouts are known from
the publications and from code that uses them; the readers' tests make small files of the same layout.
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
    """Yield all takes below a folder, from TotalCapture's .sensors files or else from DIP's .pkl files.

    The true poses of a .sensors file are in DIP's .pkl of the same name, anywhere below the folder, or else
    in Vicon's `gt_skel_gbl_ori.txt` in a folder with the take's name.

    Raises:
        EdgeposeError: the folder has no such file, or one of them is broken.
    """
    pickles = sorted(folder.rglob("*.pkl"))
    # A take may be there twice, with and without magnetometers; its orientations are the same in both.
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
