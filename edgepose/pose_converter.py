"""Poses of a file to another kind of file."""

from __future__ import annotations

from pathlib import Path

from edgepose.durable_files import replace_file
from edgepose.poses import Poses, salvage_poses
from edgepose.sinks import Sink
from edgepose.sinks.bvh import BvhSink
from edgepose.sinks.csv_file import CsvSink
from edgepose.sinks.npz import write_npz
from edgepose.skeleton import default_body


def _write(path: Path, poses: Poses, height_m: float) -> None:
    if path.suffix == ".npz":
        write_npz(path, [poses], len(poses.frames), poses.rate)
        return
    sink: Sink
    if path.suffix == ".bvh":
        sink = BvhSink(path, poses.rate, default_body(height_m))
    else:
        sink = CsvSink(path, translation=poses.translation is not None)
    with sink:
        for pose in poses.pose_frames():
            sink.write(pose)


def convert_poses(
    source: Path, target: Path, height_m: float, overwrite: bool = True
) -> tuple[int, float, str | None]:
    """Write what is good in a file of poses; the target appears when it is whole.

    Args:
        source: file that `edgepose.poses.read_poses` reads.
        target: .csv, .npz or .bvh file.
        height_m: the wearer's stature, for the bones of a BVH file, metres.
        overwrite: whether it may take the place of a file.

    Returns:
        Number of poses, seconds from the first to the last, and one line on what was not good.

    Raises:
        EdgeposeError: nothing is good, or it cannot be written.
    """
    poses, damage = salvage_poses(source)
    replace_file(target, lambda path: _write(path, poses, height_m), "poses", overwrite=overwrite)
    return len(poses.frames), float(poses.time_s[-1] - poses.time_s[0]), damage
