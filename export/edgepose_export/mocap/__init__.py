"""Motion capture: readers for BVH, ASF/AMC and AMASS files, and the transfer of all to the 24 SMPL joints."""

from __future__ import annotations

from pathlib import Path

from edgepose.errors import EdgeposeError
from edgepose.formats.bvh import read_bvh

from .amass import read_amass
from .amc import read_amc
from .motion import Motion, pieces, resample
from .retargeting import BANDAI, CMU_AMC, CMU_BVH, from_bandai, from_cmu_amc, from_cmu_bvh, has_names

__all__ = ["Motion", "pieces", "read_motion", "resample"]


def read_motion(path: str | Path) -> Motion:
    """The motion in a file, transferred to SMPL.

    .npz is AMASS, .amc is CMU (its .asf beside it), .bvh is CMU in cgspeed's conversion or Bandai-Namco.

    Raises:
        EdgeposeError: another kind of file, a skeleton that is not known, or a broken file.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind == ".npz":
        return read_amass(path)
    if kind == ".amc":
        recording = read_amc(path)
        if has_names(CMU_AMC, recording):
            return from_cmu_amc(recording, path)
    elif kind == ".bvh":
        recording = read_bvh(path)
        if has_names(CMU_BVH, recording):
            return from_cmu_bvh(recording, path)
        if has_names(BANDAI, recording):
            # The two datasets share one skeleton and differ in the collars' zero; the name tells which.
            return from_bandai(recording, path, collars_back=not path.name.startswith("dataset-1_"))
    else:
        raise EdgeposeError(f"{path}: motion is read from .npz, .amc and .bvh files")
    raise EdgeposeError(f"{path}: the skeleton is not known; CMU's and Bandai-Namco's are")
