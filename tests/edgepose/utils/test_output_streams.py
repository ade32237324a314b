"""Pipes whose readers are slow or have stopped."""

import os

import pytest

from edgepose.errors import EdgeposeError
from edgepose.utils import output_streams
from edgepose.utils.output_streams import OutputStream
from edgepose.utils.output_targets import find_target


@pytest.fixture
def pipe():
    """The end to read of a pipe, and the stream that writes to it without waiting."""
    reader, writer = os.pipe()
    stream = OutputStream(find_target(f"/dev/fd/{writer}", "rows"), "rows", waits=False)
    os.close(writer)
    with os.fdopen(reader, "rb", 0) as file:
        yield file, stream


def test_what_a_sleeping_reader_has_not_read_waits_for_it(pipe):
    file, stream = pipe
    rows = [b"%06d\n" % i for i in range(20_000)]  # more than a pipe holds
    for row in rows:
        assert stream.write(row) == len(row)
    got = b""
    while len(got) < 60_000:
        got += file.read(65_536)
    stream.write(b"last\n")
    while not got.endswith(rows[-1] + b"last\n"):
        got += file.read(65_536)
        stream.write(b"")
    stream.close()
    assert got == b"".join([*rows, b"last\n"])
    assert file.read() == b""


def test_a_reader_that_never_reads_is_given_up(pipe, monkeypatch):
    _, stream = pipe
    monkeypatch.setattr(output_streams, "BACKLOG", 10_000)
    said = "the program that reads the rows from /dev/fd/\\d+ has stopped reading: \\d+ bytes were not"
    with pytest.raises(EdgeposeError, match=said):
        stream.write(bytes(100_000))
    with pytest.raises(EdgeposeError, match=said):
        stream.close()
