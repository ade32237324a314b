"""All formats of poses, and the functions that read poses of any of them.

Files are hostile until checked: what comes out is finite, in order and made of rotations.
"""

from __future__ import annotations

from pathlib import Path

from edgepose.errors import FileFormatError
from edgepose.formats.bvh import FRAME_TIMES
from edgepose.formats.poses.base import PoseFormat
from edgepose.formats.registered import all_formats, built_in_format
from edgepose.pose import PoseSequence

READERS = {
    "csv": "edgepose.formats.poses.csv:FORMAT",
    "npz": "edgepose.formats.poses.npz_amass:FORMAT",
    "bvh": "edgepose.formats.poses.bvh:FORMAT",
    "dip": "edgepose.formats.poses.dip:FORMAT",
}
"""Where each `PoseFormat` is; modules are imported in this order until one fits a file."""


def read_poses(path: str | Path) -> PoseSequence:
    """Poses of a .npz file with the keys of AMASS, a .bvh file with SMPL's joints, a .pkl of DIP's with true
    poses, a file of an installed format, or of a CSV file, whatever its ending.

    Args:
        path: file to read; "-" is CSV on standard input.

    Raises:
        FileFormatError: no such file, or not a file of poses.
    """
    poses, problem = _read(Path(path))
    if problem is not None:
        raise FileFormatError(problem)
    return poses


def salvage_poses(path: Path) -> tuple[PoseSequence, str | None]:
    """The poses before the first bad one, and one line on what is bad; see `read_poses`.

    Raises:
        FileFormatError: there is none.
    """
    poses, problem = _read(path)
    return poses, problem and f"{problem}; {len(poses.frames)} poses are taken"


def is_poses(path: Path) -> bool:
    """Whether a file seems to hold poses and not a recording of sensors; "-" is standard input."""
    return find_format(path).holds_poses(path)


def find_format(path: Path) -> PoseFormat:
    """The format of a file by its ending; CSV is also that of unknown endings and of "-"."""
    suffix = path.suffix.lower()
    if not suffix:
        return built_in_format(PoseFormat, READERS["csv"])
    return next(
        (known for known in all_formats(PoseFormat, READERS.values()) if suffix in known.suffixes), None
    ) or built_in_format(PoseFormat, READERS["csv"])


def pose_suffixes() -> tuple[str, ...]:
    """Endings of files that may hold poses."""
    return tuple(suffix for known in all_formats(PoseFormat, READERS.values()) for suffix in known.suffixes)


def _read(path: Path) -> tuple[PoseSequence, str | None]:
    """The poses before the first bad one, and what is wrong with the file."""
    poses, problem = find_format(path).read(path)
    if not FRAME_TIMES[0] < poses.frame_time < FRAME_TIMES[1]:
        raise FileFormatError(f"{path}: {poses.frame_time:g} s from pose to pose is not possible")
    return poses, problem
