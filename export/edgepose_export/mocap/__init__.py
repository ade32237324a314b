"""Motion capture: readers for BVH, ASF/AMC and AMASS files, and retargeting to the 24 SMPL joints."""

from __future__ import annotations

from pathlib import Path

from edgepose.errors import EdgeposeError

from .amass import read_amass
from .any_bvh import read_any_bvh
from .cmu_amc import read_cmu_amc
from .mapping import Mapping
from .motion import Motion, fault, pieces, resample, scaled_to
from .retargeting import Source, retarget

__all__ = ["Mapping", "Motion", "fault", "pieces", "read_motion", "read_source", "resample", "scaled_to"]


def read_motion(path: str | Path, t_pose: str | Path | None = None, mapping: Mapping | None = None) -> Motion:
    """Read the motion in a file, retargeted to SMPL.

    Args:
        path: .npz is AMASS, .amc is CMU (with its .asf beside it), .bvh is of anyone.
        t_pose: for BVH: a file of the same skeleton with a T-pose in it; None searches, see `find_rest`.
        mapping: for BVH: joints, unit and up axis where they are not understood.

    Raises:
        EdgeposeError: the file is of another kind, has a skeleton that is not understood, or is broken.
    """
    path = Path(path)
    if path.suffix.lower() == ".npz":
        return read_amass(path)
    return retarget(read_source(path, t_pose, mapping))


def read_source(path: str | Path, t_pose: str | Path | None = None, mapping: Mapping | None = None) -> Source:
    """Read the motion in a BVH or AMC file on its own skeleton; see `read_motion`."""
    path = Path(path)
    kind = path.suffix.lower()
    if kind == ".amc":
        return read_cmu_amc(path)
    if kind == ".bvh":
        return read_any_bvh(path, None if t_pose is None else Path(t_pose), mapping)
    raise EdgeposeError(f"{path}: motion is read from .npz, .amc and .bvh files")
