"""Files under another name until they are whole, and what is no file on a disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edgepose.errors import EdgeposeError
from edgepose.formats.poses.registry import pose_suffixes
from edgepose.formats.recordings.registry import recording_suffixes
from edgepose.pose import PoseFrame
from edgepose.sinks.csv import CsvSink
from edgepose.sinks.npz import NpzSink
from edgepose.sinks.output_files import check_output, known_endings
from edgepose.sinks.registry import SINKS
from edgepose.sources.replay import CAN_LOGS, CAPTURES
from edgepose.utils.durable_files import replace_file, write_whole
from edgepose.utils.growing_files import GrowingFile
from edgepose.utils.output_targets import descriptor, find_target, has_reader

OLD = b"what was there before\n"


def make_pose(index: int) -> PoseFrame:
    return PoseFrame(index, index / 60, np.tile(np.eye(3, dtype=np.float32), (24, 1, 1)), np.zeros(24))


def test_names_of_open_files(tmp_path):
    assert descriptor(Path("/dev/stdout")) == 1
    assert descriptor(Path("/proc/self/fd/2")) == 2
    (tmp_path / "out").symlink_to("/dev/stdout")
    assert descriptor(tmp_path / "out") == 1
    assert descriptor(Path("/dev/null")) is None
    assert descriptor(tmp_path / "none") is None
    (tmp_path / "loop").symlink_to("loop")
    assert descriptor(tmp_path / "loop") is None
    with pytest.raises(EdgeposeError, match=r"cannot write poses to .*loop: "):
        find_target(tmp_path / "loop", "poses")


def test_a_file_made_meanwhile_is_not_taken(tmp_path):
    output = GrowingFile(tmp_path / "a.csv", "poses", overwrite=False)
    (tmp_path / "a.csv").write_bytes(OLD)
    with pytest.raises(EdgeposeError, match="another program has just created it"):
        output.start()
    output.discard()
    with pytest.raises(EdgeposeError, match="another program has just created it"):
        write_whole(tmp_path / "a.csv", "new", "text", overwrite=False)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [OLD]


@pytest.mark.parametrize("how", ["removed", "replaced"])
def test_a_file_that_goes_during_a_run_is_told(tmp_path, how):
    sink = CsvSink(tmp_path / "a.csv")
    sink.write(make_pose(0))
    (tmp_path / "a.csv").unlink()
    if how == "replaced":
        (tmp_path / "a.csv").write_bytes(OLD)
    with pytest.raises(
        EdgeposeError, match=r"a\.csv was moved, removed or replaced while poses were written"
    ):
        sink.close()


def test_a_part_file_that_goes_during_a_run_is_told(tmp_path):
    sink = NpzSink(tmp_path / "a.npz")
    sink.write(make_pose(0))
    (tmp_path / "a.part.csv").unlink()
    with pytest.raises(EdgeposeError, match=r"a\.part\.csv"):
        sink.close()


def test_a_part_file_that_is_a_link_is_not_followed(tmp_path):
    (tmp_path / "a.part.csv").symlink_to(tmp_path / "elsewhere.csv")
    with pytest.raises(EdgeposeError, match="already exists"):
        NpzSink(tmp_path / "a.npz")
    assert not (tmp_path / "elsewhere.csv").exists()


def test_a_disk_and_a_socket_are_refused(tmp_path):
    import socket

    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "s"))
        with pytest.raises(EdgeposeError, match="it is a socket"):
            find_target(tmp_path / "s", "poses")
    for disk in Path("/dev").iterdir():
        if disk.is_block_device():
            with pytest.raises(EdgeposeError, match="it is a disk"):
                find_target(disk, "poses")
            break


def test_who_reads():
    assert not has_reader("/dev/null")
    assert not has_reader("nowhere/a.csv")


def test_an_error_of_a_writer_leaves_the_old_file(tmp_path):
    (tmp_path / "a").write_bytes(OLD)

    def write(path: Path) -> None:
        path.write_bytes(b"half of it")
        raise ValueError("no more")

    with pytest.raises(ValueError, match="no more"):
        replace_file(tmp_path / "a", write, "text", overwrite=True)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [OLD]


def test_endings_of_files_that_are_read_or_written():
    assert {*recording_suffixes(), *pose_suffixes(), *CAPTURES, *CAN_LOGS} <= known_endings()
    assert {output.suffix for output in SINKS.values()} - {""} <= known_endings()


@pytest.mark.parametrize("ending", [".mvnx", ".sensors", ".log", ".json", ".PKL", ".gltf"])
def test_no_output_replaces_a_file_of_another_kind(tmp_path, ending):
    other = tmp_path / f"walk{ending}"
    other.write_bytes(OLD)
    with pytest.raises(EdgeposeError, match="is the ending of another kind of file; for poses use"):
        check_output(other, "poses", (".csv",), True)
    check_output(tmp_path / "walk.2026-11-30", "poses", (".csv",), True)
