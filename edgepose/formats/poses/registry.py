"""All pose formats, and functions that read poses of any format.

Files are not trusted: poses that are returned are finite, in order and made of valid rotations.
"""

from __future__ import annotations

from pathlib import Path

from edgepose.errors import FileFormatError
from edgepose.formats.bvh import FRAME_TIMES
from edgepose.formats.poses.base import PoseFormat
from edgepose.formats.registered import Reader, all_formats, built_in_format
from edgepose.pose import PoseSequence

READERS = {
    "csv": Reader("edgepose.formats.poses.csv:FORMAT", ".csv"),
    "npz": Reader("edgepose.formats.poses.npz_amass:FORMAT", ".npz with the keys of AMASS"),
    "bvh": Reader("edgepose.formats.poses.bvh:FORMAT", ".bvh"),
    "dip": Reader("edgepose.formats.poses.dip:FORMAT", ".pkl of DIP-IMU"),
}
"""All pose formats; modules are imported in this order until one fits a file."""


def read_poses(path: str | Path) -> PoseSequence:
    """Read poses from a file.

    That is a .npz file with the keys of AMASS, a .bvh file with SMPL's joints, one of DIP's .pkl files with
    true poses, a file of a plug-in's format, or a CSV file with any other ending.

    Args:
        path: file to read; "-" is CSV on standard input.

    Raises:
        FileFormatError: no such file, or not a file of poses.
    """
    poses, problem = _read(Path(path))
    if problem is not None:
        raise FileFormatError(problem)
    return poses


def salvage_poses(path: Path, unit: str | None = None) -> tuple[PoseSequence, str | None]:
    """Read the good poses, and one line on the problem; see `read_poses`.

    Args:
        path: file to read; "-" is CSV on standard input.
        unit: of lengths in BVH, a key of `UNITS` in `edgepose.formats.poses.bvh`; None infers it.

    Raises:
        FileFormatError: no pose is usable.
    """
    poses, problem = _read(path, unit)
    return poses, problem and f"{problem}; {len(poses.frames)} poses are kept"


def is_poses(path: Path) -> bool:
    """Return whether a file seems to contain poses, not a recording of sensors; "-" is standard input."""
    return find_format(path).holds_poses(path)


def find_format(path: Path) -> PoseFormat:
    """Return the format of a file by its ending; CSV for unknown endings and for "-"."""
    suffix = path.suffix.lower()
    if not suffix:
        return built_in_format(PoseFormat, READERS["csv"])
    return next(
        (format for format in all_formats(PoseFormat, READERS.values()) if suffix in format.suffixes), None
    ) or built_in_format(PoseFormat, READERS["csv"])


def pose_suffixes() -> tuple[str, ...]:
    """Return the endings of files that may contain poses."""
    return tuple(suffix for format in all_formats(PoseFormat, READERS.values()) for suffix in format.suffixes)


def _read(path: Path, unit: str | None = None) -> tuple[PoseSequence, str | None]:
    """Read the good poses, and the problem with the file."""
    format = find_format(path)
    poses, problem = format.read(path) if format.read_in is None else format.read_in(path, unit)
    if not FRAME_TIMES[0] < poses.frame_time < FRAME_TIMES[1]:
        raise FileFormatError(f"{path}: {poses.frame_time:g} s from pose to pose is not possible")
    return poses, problem
