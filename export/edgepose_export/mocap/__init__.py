"""Motion capture: readers for BVH, ASF/AMC and AMASS files, and retargeting to the 24 SMPL joints."""

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
    """Read the motion in a file, retargeted to SMPL.

    .npz is AMASS, .amc is CMU (with its .asf beside it), .bvh is CMU in cgspeed's conversion or Bandai-Namco.

    Raises:
        EdgeposeError: the file is of another kind, has an unknown skeleton, or is broken.
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
            # Both datasets share one skeleton; the zero of the collars differs, which only the name reveals.
            return from_bandai(recording, path, collars_back=not path.name.startswith("dataset-1_"))
    else:
        raise EdgeposeError(f"{path}: motion is read from .npz, .amc and .bvh files")
    raise EdgeposeError(f"{path}: unknown skeleton; only those of CMU and Bandai-Namco are supported")
