"""Several wearers in one loop: what ends one, and how he ends, is felt by nobody else."""

from __future__ import annotations

import threading
from collections.abc import Callable

import pytest

from edgepose.calibration import load_calibration
from edgepose.engine import BatchEngine
from edgepose.pipeline import Walk
from edgepose.pose import PoseFrame
from edgepose.rezero import Headings
from edgepose.sinks import Sink
from edgepose.sources import Source, open_source
from edgepose.sources.live import Link, LiveSource
from edgepose.sync import FrameClock
from edgepose.wearers import Wearer, run_together
from edgepose_export.networks import NetworkShape
from firmware_protocols.registry import PROTOCOLS


class Maker:
    """A maker's library, whose buses have to be waited for."""

    waiting = None

    def __init__(self, read: Callable[[], tuple[bytes, bool]]) -> None:
        self.read = read
        self.closed = False

    def close(self) -> None:
        self.closed = True


class Shelf(Sink):
    """Keeps what it is given, and what was so when it was."""

    def __init__(self, note: Callable[[], bool] = lambda: False) -> None:
        self.notes: list[bool] = []
        self.closed = threading.Event()
        self._note = note

    def write(self, pose: PoseFrame) -> None:
        self.notes.append(self._note())

    def close(self) -> None:
        self.closed.set()


@pytest.fixture
def join(wearer):
    """Makes a wearer of a source that has been entered, and of a sink."""

    def make(source: Source, sink: Sink, tell: Callable[[str], None] = lambda text: None) -> Wearer:
        headings = Headings(load_calibration(wearer.calibration))
        return Wearer(source, Walk(FrameClock(), headings, [sink]), tell)

    return make


@pytest.fixture
def engine(tiny):
    return BatchEngine(tiny(NetworkShape("rnn", 8, "global-6d", "passed")), 0, 0, 2, False)


def bus(maker: Maker) -> LiveSource:
    def nowhere(protocol: object) -> dict[int | None, int]:
        return {i: i for i in range(6)}

    return LiveSource(
        [Link("pcan:1", lambda: maker, [PROTOCOLS["native"]], nowhere, "bytes", ("", ""))], waits=False
    )


def test_what_nobody_has_foreseen_in_a_library_ends_only_its_wearer(wearer, join, engine):
    def read() -> tuple[bytes, bool]:
        raise TypeError("an integer is required")

    told: list[str] = []
    with bus(Maker(read)) as broken, open_source(file=wearer.short, waits=False) as whole:
        both = [join(broken, Shelf(), told.append), join(whole, Shelf())]
        run_together(both, engine, 0.0)
    first, second = (each.walk.summary for each in both)
    assert (second.poses, second.error) == (180, None)
    assert told == [f"ended: {first.error}"]
    assert str(first.error).startswith("pcan:1: reading it failed (TypeError: an integer is required)")
    assert isinstance(first.error.__cause__, TypeError)


def test_the_end_of_a_wearer_waits_for_no_line(join):
    reading, released = threading.Event(), threading.Event()
    in_time: list[bool] = []

    def read() -> tuple[bytes, bool]:
        reading.set()
        in_time.append(released.wait(5.0))
        return b"", False

    maker = Maker(read)
    with bus(maker) as source:
        one = join(source, Shelf())
        one.look()
        assert reading.wait(5.0)
        one.end()
        assert not maker.closed
        released.set()
    assert all(in_time)
    assert maker.closed


def test_outputs_are_closed_when_their_wearer_ends(wearer, join, engine, tmp_path):
    (tmp_path / "empty.bin").touch()
    short = Shelf()
    long = Shelf(short.closed.is_set)
    with (
        open_source(file=tmp_path / "empty.bin", waits=False) as empty,
        open_source(file=wearer.short, waits=False) as whole,
    ):
        run_together([join(empty, short), join(whole, long)], engine, 0.0)
    assert len(long.notes) == 180
    assert long.notes[-1]
    assert long.closed.is_set()
