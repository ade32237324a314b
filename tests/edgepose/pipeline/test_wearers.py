"""Several wearers in one loop: what ends one, and how he ends, is felt by nobody else."""

from __future__ import annotations

import threading
from collections.abc import Callable

import pytest

from edgepose.calibration import load_calibration
from edgepose.inference.engine import MultiWearerEngine
from edgepose.pipeline.multi_wearer import Wearer, run_together
from edgepose.pipeline.wearer_pipeline import WearerPipeline
from edgepose.pose import PoseFrame
from edgepose.sinks.base import Sink
from edgepose.sources import Source, open_source
from edgepose.sources.line_reader import LineSpec
from edgepose.sources.live import LiveSource
from edgepose_export.networks.shape import NetworkShape
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
        return Wearer(source, WearerPipeline(load_calibration(wearer.calibration), 60.0, [sink]), tell)

    return make


@pytest.fixture
def engine(tiny):
    return MultiWearerEngine(tiny(NetworkShape("rnn", 8, "global-6d", "passed")), 0, 0, 2, False)


def bus(maker: Maker) -> LiveSource:
    def nowhere(protocol: object) -> dict[int | None, int]:
        return {i: i for i in range(6)}

    return LiveSource(
        [LineSpec("pcan:1", lambda: maker, [PROTOCOLS["native"]], nowhere, "bytes", ("", ""))], blocking=False
    )


def test_what_nobody_has_foreseen_in_a_library_ends_only_its_wearer(wearer, join, engine):
    def read() -> tuple[bytes, bool]:
        raise TypeError("an integer is required")

    told: list[str] = []
    with bus(Maker(read)) as broken, open_source(file=wearer.short, blocking=False) as whole:
        both = [join(broken, Shelf(), told.append), join(whole, Shelf())]
        run_together(both, engine, 0.0)
    first, second = (each.pipeline.summary for each in both)
    assert (second.poses, second.error) == (180, None)
    assert told == [f"ended: {first.error}"]
    assert str(first.error).startswith("pcan:1: reading failed (TypeError: an integer is required)")
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
        one.poll()
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
        open_source(file=tmp_path / "empty.bin", blocking=False) as empty,
        open_source(file=wearer.short, blocking=False) as whole,
    ):
        run_together([join(empty, short), join(whole, long)], engine, 0.0)
    assert len(long.notes) == 180
    assert long.notes[-1]
    assert long.closed.is_set()


class Broken(Shelf):
    """An output that fails as nobody has foreseen."""

    def __init__(self, where: str) -> None:
        super().__init__()
        self._where = where

    def write(self, pose: PoseFrame) -> None:
        if self._where == "write" and len(self.notes) == 20:
            raise KeyError("a fault")
        super().write(pose)

    def close(self) -> None:
        super().close()
        if self._where == "close":
            raise KeyError("a fault")


@pytest.mark.parametrize("where", ["write", "close"])
def test_what_nobody_has_foreseen_in_an_output_ends_only_its_wearer(wearer, join, engine, where):
    told: list[str] = []
    good, bad = Shelf(), Broken(where)
    sources = [open_source(file=wearer.short, blocking=False) for _ in range(2)]
    with sources[0] as one, sources[1] as other:
        wearers = [join(one, good), join(other, bad, told.append)]
        run_together(wearers, engine, 0.0)
    assert len(good.notes) == 180
    assert wearers[0].pipeline.summary.error is None
    assert "unexpected error (KeyError: 'a fault'); please report it" in str(
        wearers[1].pipeline.summary.error
    )
    assert bad.closed.is_set()
    if where == "write":
        assert len(bad.notes) == 20
        assert told[0].startswith("ended: unexpected error")


@pytest.mark.parametrize("place", ["clock", "headings", "orient"])
def test_what_nobody_has_foreseen_on_the_way_ends_only_its_wearer(wearer, join, engine, monkeypatch, place):
    good, bad = Shelf(), Shelf()

    def fail(*_: object) -> None:
        raise ZeroDivisionError("a fault")

    with (
        open_source(file=wearer.short, blocking=False) as one,
        open_source(file=wearer.short, blocking=False) as other,
    ):
        wearers = [join(one, good), join(other, bad)]
        pipeline = wearers[1].pipeline
        if place == "clock":
            monkeypatch.setattr(pipeline.clock, "push", fail)
        elif place == "headings":
            monkeypatch.setattr(pipeline._headings, "calibration_for", fail)
        else:
            monkeypatch.setattr(pipeline, "_orient", fail)
        run_together(wearers, engine, 0.0)
    assert len(good.notes) == 180
    assert isinstance(pipeline.summary.error.__cause__, ZeroDivisionError)


def test_the_line_of_a_wearer_who_has_ended_is_free(wearer, join, engine):
    """While the others go on."""
    maker = Maker(lambda: (b"", False))
    free: list[bool] = []
    others = Shelf(lambda: free.append(maker.closed) or maker.closed)
    ending = bus(maker)
    with ending as one, open_source(file=wearer.short, realtime=True, blocking=False) as other:
        ended = join(one, Shelf())
        going = join(other, others)
        ended.end()
        run_together([ended, going], engine, 0.001)
    assert free[-1]
    assert len(others.notes) > 100
