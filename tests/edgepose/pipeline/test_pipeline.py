"""From samples to poses with a shipped network, a real source and a real sink."""

from __future__ import annotations

import tracemalloc
from itertools import islice

import numpy as np
import pytest

from edgepose.calibration import load_calibration
from edgepose.errors import EdgeposeError, ModelError
from edgepose.formats.poses.registry import read_poses
from edgepose.imu import ImuFrame
from edgepose.inference import archive
from edgepose.inference.engine import EngineOutput, StreamEngine
from edgepose.pipeline.run import run
from edgepose.pipeline.wearer_pipeline import LATENCIES, RunSummary, WearerPipeline, pose_frame
from edgepose.placements import PLACEMENTS
from edgepose.pose import parse_status
from edgepose.sinks.base import Sink
from edgepose.sinks.csv import CsvSink
from edgepose.sources import open_source


class Shelf(Sink):
    """Keeps poses, up to its room; then it says that it is full."""

    def __init__(self, room: int = 1 << 30) -> None:
        self.poses, self.asked, self.room = [], 0, room

    def write(self, pose):
        self.asked += 1
        if len(self.poses) == self.room:
            raise EdgeposeError("the shelf is full")
        self.poses.append(pose)

    def close(self):
        """Nothing is open."""


@pytest.fixture(scope="module")
def module():
    return archive.load(archive.read_info(archive.find_archive("birnn")))


@pytest.fixture
def walk(wearer, module):
    """Runs the batches of the short recording, changed by a function of them, to sinks."""

    def go(
        change=lambda batches: batches,
        sinks=(),
        past=4,
        future=3,
        on_pose=lambda summary: None,
        warn=lambda text: None,
        **options,
    ):
        engine = StreamEngine(module, past, future)
        calibration = load_calibration(wearer.calibration)
        walk = WearerPipeline(calibration, 60.0, list(sinks), on_pose=on_pose, warn=warn)
        with open_source(file=wearer.short) as source:
            summary = run(walk, change(source), engine, **options)
        walk.close()
        return summary

    return go


def indices(shelf):
    return [pose.index for pose in shelf.poses]


def imu_frame(*held):
    return ImuFrame(
        0, 0.0, np.zeros((6, 4)), np.zeros((6, 3)), np.array([name in held for name in PLACEMENTS]), 0.0
    )


def test_what_waited_to_be_taken_counts_as_latency(walk):
    summary = walk(lambda batches: (batch._replace(backlog_s=2.5) for batch in batches))
    assert summary.backlog_s == 2.5
    assert min(summary.latencies_s) >= 2.5
    assert max(walk().latencies_s) < 2.5


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_a_network_that_computes_no_numbers(number):
    """A flipped bit in a weight is enough for it."""
    rotations = np.zeros((24, 3, 3), np.float32)
    rotations[7, 1, 2] = number
    with pytest.raises(ModelError, match="computes NaN or infinite numbers, so its archive is damaged"):
        pose_frame(EngineOutput(imu_frame(), rotations, np.zeros(24), False))


@pytest.mark.parametrize(
    ("held", "filling", "text"),
    [
        ((), False, "ok"),
        ((), True, "filling window"),
        (("head",), False, "held head"),
        (("pelvis", "left_forearm"), True, "held left_forearm pelvis; filling window"),
    ],
)
def test_status(held, filling, text):
    pose = pose_frame(EngineOutput(imu_frame(*held), np.zeros((24, 3, 3)), np.zeros(24), filling))
    assert (pose.held, pose.warming_up, pose.status) == (set(held), filling, text)
    assert parse_status(text) == (pose.held, pose.warming_up)


@pytest.mark.parametrize(("rotation", "std"), [(np.nan, 0.0), (np.inf, 0.0), (0.0, np.nan)])
def test_numbers_of_a_damaged_network_reach_no_output(rotation, std):
    """Bits of weights may be flipped in an archive that the user trusts."""
    output = EngineOutput(imu_frame(), np.full((24, 3, 3), rotation), np.full(24, std), False)
    with pytest.raises(EdgeposeError, match="its archive is damaged"):
        pose_frame(output)


def test_every_frame_comes_out_once_and_in_order(walk):
    shelf = Shelf()
    seen = []
    summary = walk(sinks=[shelf], on_pose=lambda s: seen.append(s.poses))
    assert summary.error is None
    assert indices(shelf) == list(range(180))
    assert seen == list(range(1, 181))
    assert [pose.status for pose in shelf.poses] == ["filling window"] * 4 + ["ok"] * 176
    assert (summary.poses, summary.warming_up, summary.held) == (180, 4, 0)
    assert len(summary.latencies_s) == 180
    assert min(summary.latencies_s) > 0
    assert summary.seconds > 0


def test_all_sinks_get_the_same(walk, tmp_path):
    shelf, file = Shelf(), tmp_path / "poses.csv"
    with CsvSink(file, "matrix") as sink:
        walk(sinks=[shelf, sink])
    read = read_poses(file)
    frames, time_s, texts, rotations = read.frames, read.time_s, read.status, read.rotations
    assert frames.tolist() == indices(shelf)
    assert texts == [pose.status for pose in shelf.poses]
    np.testing.assert_allclose(time_s, [pose.time_s for pose in shelf.poses], atol=1e-6)
    np.testing.assert_allclose(rotations, [pose.rotations for pose in shelf.poses], atol=2e-6)


def test_a_stop_brings_out_every_frame_that_was_seen(walk):
    all_of_it, shelf = Shelf(), Shelf()
    walk(sinks=[all_of_it])
    asked = []
    summary = walk(sinks=[shelf], stopped=lambda: bool(asked.append(1)) or len(asked) == 100)
    assert summary.error is None
    assert len(asked) == 100
    # Batches hold a hundredth of a second, and the last frames are seen with less future.
    assert indices(shelf) == list(range(60))
    for pose, whole in zip(shelf.poses[:57], all_of_it.poses, strict=False):
        np.testing.assert_array_equal(pose.rotations, whole.rotations)


def test_what_came_before_an_error_of_the_source_comes_out(walk):
    def unplugged(batches):
        yield from islice(batches, 100)
        raise EdgeposeError("the port disappeared")

    shelf = Shelf()
    summary = walk(unplugged, [shelf])
    assert str(summary.error) == "the port disappeared"
    assert indices(shelf) == list(range(60))


def test_what_came_before_a_sample_without_orientation_comes_out(walk):
    def bare(batches):
        for i, batch in enumerate(batches):
            samples = [s._replace(quat=None) for s in batch.samples] if i == 100 else batch.samples
            yield batch._replace(samples=samples)

    shelf = Shelf()
    summary = walk(bare, [shelf])
    assert str(summary.error).startswith("left_forearm: the device sends no orientation")
    assert indices(shelf) == list(range(60))


def test_an_output_that_fails_ends_alone_and_the_last_one_ends_the_run(walk):
    small, full, smaller, lines = Shelf(room=60), Shelf(room=50), Shelf(room=0), []
    summary = walk(sinks=[small, full, smaller], warn=lines.append)
    assert indices(small) == list(range(60))
    assert indices(full) == list(range(50))
    assert (small.asked, full.asked, smaller.asked) == (61, 51, 1)
    assert lines == ["the shelf is full; this output has ended, the others go on"] * 2
    assert str(summary.error) == "3 of 3 outputs failed: the shelf is full"
    assert summary.poses == 60


def test_a_run_of_which_an_output_failed_reports_it_at_its_end(walk):
    good, full = Shelf(), Shelf(room=50)
    summary = walk(sinks=[full, good])
    assert indices(good) == list(range(180))
    assert (summary.poses, str(summary.error)) == (180, "1 of 2 outputs failed: the shelf is full")


def test_a_sensor_that_stops_is_held_and_counted(walk):
    silent = PLACEMENTS.index("head")

    def without_head(batches):
        for i, batch in enumerate(batches):
            samples = [s for s in batch.samples if s.sensor != silent or not 100 <= i < 200]
            yield batch._replace(samples=samples)

    shelf = Shelf()
    summary = walk(without_head, [shelf])
    texts = [pose.status for pose in shelf.poses]
    held = [i for i, text in enumerate(texts) if text == "held head"]
    assert indices(shelf) == list(range(180))
    assert held == list(range(held[0], held[-1] + 1))
    assert 55 <= len(held) <= 60
    assert set(texts[4:]) == {"ok", "held head"}
    assert summary.held == summary.held_by_sensor["head"] == summary.held_by_sensor.total() == len(held)


def test_sensors_that_never_report(walk):
    def four(batches):
        return (b._replace(samples=[s for s in b.samples if s.sensor < 4]) for b in batches)

    shelf = Shelf()
    summary = walk(four, [shelf])
    assert "no samples of head, pelvis" in str(summary.error)
    assert shelf.poses == []


def test_a_source_without_samples(walk):
    summary = walk(lambda batches: iter(()))
    assert summary.error is None
    assert summary.poses == 0


def test_latencies_do_not_fill_the_memory():
    tracemalloc.start()
    summary = RunSummary()
    for i in range(LATENCIES + 10):
        summary.sent(float(i))
    taken, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(summary.latencies_s) == LATENCIES
    assert (min(summary.latencies_s), max(summary.latencies_s)) == (10.0, LATENCIES + 9.0)
    assert (summary.poses, summary.latency_s) == (LATENCIES + 10, LATENCIES + 9.0)
    assert taken < 2_000_000
