"""Several outputs of one wearer: opened all or none, and each fails alone."""

from __future__ import annotations

import os
import socket
from contextlib import ExitStack

import pytest

from edgepose.config import OutputConfig
from edgepose.errors import EdgeposeError
from edgepose.formats.poses.registry import read_poses
from edgepose.sinks.csv import CsvSink
from edgepose.sinks.group import SinkGroup
from edgepose.sinks.open import open_outputs
from tests.support.datagrams import free_address
from tests.support.poses import pose


@pytest.mark.parametrize(
    ("last", "says"),
    [
        ({"csv": ["a.csv", "nowhere/b.csv"]}, "cannot write poses to nowhere/b.csv"),
        (
            {"csv": "a.csv", "mocopi": ["127.0.0.1:9", "nosuch.invalid:9"]},
            "cannot find host 'nosuch.invalid'",
        ),
    ],
)
def test_if_the_last_cannot_be_opened_nothing_of_the_others_is_left(tmp_path, monkeypatch, last, says):
    monkeypatch.chdir(tmp_path)
    host, _, port = free_address().partition(":")
    (tmp_path / "old.bvh").write_text("a take")
    outputs = OutputConfig(tcp=f"{host}:{port}", bvh="old.bvh", npz="a.npz", overwrite=True, **last)
    with pytest.raises(EdgeposeError, match=says), ExitStack() as stack:
        open_outputs(stack, outputs)
    socket.create_server((host, int(port))).close()  # nobody listens there any more
    assert [path.name for path in tmp_path.iterdir()] == ["old.bvh"]
    assert (tmp_path / "old.bvh").read_text() == "a take"


def test_errors_of_several_outputs_are_all_reported(tmp_path):
    reader, writer = os.pipe()
    pipe, removed, good = (
        CsvSink(name) for name in (f"/dev/fd/{writer}", tmp_path / "a.csv", tmp_path / "b.csv")
    )
    os.close(writer)
    for sink in (pipe, removed, good):
        sink.start()
    lines: list[str] = []
    group = SinkGroup([pipe, removed, good], lines.append)
    group.write(pose(0))
    os.close(reader)
    group.write(pose(1))
    (tmp_path / "a.csv").unlink()
    group.write(pose(2))
    group.close()
    group.close()
    ended = f"the program that read the poses from /dev/fd/{writer} has ended"
    moved = f"{tmp_path / 'a.csv'} was moved, removed or replaced while poses were written to it"
    assert lines == [f"{ended}; this output has ended, the others go on"]
    assert str(group.error) == f"2 of 3 outputs failed: {ended}; {moved}"
    assert len(read_poses(tmp_path / "b.csv").frames) == 3
