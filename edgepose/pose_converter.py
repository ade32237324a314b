"""Poses of a file to another kind of file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from edgepose.appending import replace_file
from edgepose.poses import Poses, salvage_poses
from edgepose.sinks.bvh import BvhSink
from edgepose.sinks.csv_file import CsvSink
from edgepose.sinks.npz import write_npz


def _write_csv(path: Path, poses: Poses) -> None:
    with CsvSink(path, translation=poses.translation is not None) as sink:
        for pose in poses.pose_frames():
            sink.write(pose)


def _write_npz(path: Path, poses: Poses) -> None:
    write_npz(path, [poses], len(poses.frames), poses.rate)


def _write_bvh(path: Path, poses: Poses) -> None:
    with BvhSink(path, poses.rate) as sink:
        for pose in poses.pose_frames():
            sink.write(pose)


WRITERS: dict[str, Callable[[Path, Poses], None]] = {
    "csv": _write_csv,
    "npz": _write_npz,
    "bvh": _write_bvh,
}
"""What is written, by ending."""


def convert_poses(source: Path, target: Path) -> tuple[int, float, str | None]:
    """Write what is good in a file of poses; the target appears when it is whole.

    Args:
        source: file that `edgepose.poses.read_poses` reads.
        target: file whose ending is a key of WRITERS.

    Returns:
        Number of poses, seconds from the first to the last, and one line on what was not good.

    Raises:
        EdgeposeError: nothing is good, or it cannot be written.
    """
    poses, damage = salvage_poses(source)
    replace_file(target, lambda path: WRITERS[target.suffix[1:]](path, poses), "poses")
    return len(poses.frames), float(poses.time_s[-1] - poses.time_s[0]), damage
