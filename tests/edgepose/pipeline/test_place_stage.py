"""A wearer's place during a run: in each pose, its reset, the distance walked, and what goes wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np
import pytest

import edgepose
from edgepose.calibration import load_calibration
from edgepose.formats.recordings.base import iter_samples
from edgepose.formats.recordings.registry import read_recording
from edgepose.imu import ImuSample
from edgepose.inference.engine import Engine, MultiWearerEngine, StreamEngine
from edgepose.pipeline.multi_wearer import Wearer, run_together
from edgepose.pipeline.place_stage import LOWER_BODY, PlaceStage
from edgepose.pipeline.run import run
from edgepose.pipeline.wearer_pipeline import RunSummary, WearerPipeline
from edgepose.place import PlaceTracker
from edgepose.place.distance import STEP_M, DistanceWalked
from edgepose.placements import PLACEMENTS
from edgepose.pose import PoseFrame
from edgepose.rotations import quat_multiply
from edgepose.sinks.base import Sink
from edgepose.skeleton import default_body
from edgepose.sources import Batch, open_source
from edgepose_export.networks.shape import NetworkShape

BODY = default_body(1.75)
LONGEST_STEP_M = 0.8


class Poses(Sink):
    """Keeps poses."""

    def __init__(self) -> None:
        self.poses: list[PoseFrame] = []

    def write(self, pose: PoseFrame) -> None:
        self.poses.append(pose)

    def close(self) -> None:
        """Nothing is open."""

    @property
    def translations(self) -> np.ndarray:
        return np.array([pose.translation for pose in self.poses])


@pytest.fixture(scope="module")
def model():
    return edgepose.load_model("rnn", precision="f32")


@pytest.fixture(scope="module")
def samples(wearer) -> list[ImuSample]:
    """Half a second of standing and 2.5 s of running."""
    return list(iter_samples(read_recording(wearer.short)))


@pytest.fixture
def follow(wearer, model):
    """Runs samples through a pipeline with the place."""

    def go(
        samples: Iterable[ImuSample], stage: PlaceStage, engine: Engine | None = None
    ) -> tuple[Poses, RunSummary]:
        sink = Poses()
        pipeline = WearerPipeline(load_calibration(wearer.calibration), 60.0, [sink], place=stage)
        batches = (Batch(sample.time_s, [sample]) for sample in samples)
        summary = run(pipeline, batches, engine or model.engine())
        assert summary.error is None
        return sink, summary

    return go


def test_every_pose_has_the_place_that_the_tracker_finds(follow, wearer, samples, model):
    sink, summary = follow(samples, PlaceStage(BODY))
    assert len(sink.poses) == 180
    pipeline = WearerPipeline(load_calibration(wearer.calibration), 60.0, [])
    tracker, engine = PlaceTracker(BODY), model.engine()
    inputs = [*pipeline.process(Batch(samples[-1].time_s, samples)), *pipeline.flush()]
    outputs = [output for each in inputs for output in engine.push(*each)]
    for pose, output in zip(sink.poses, outputs, strict=True):
        place = tracker.update(pose.time_s, output.rotations, output.place)
        np.testing.assert_array_equal(pose.translation, place.translation)
        np.testing.assert_array_equal(pose.contacts, output.place[:7])
    travelled = np.linalg.norm(sink.translations[-1, [0, 2]])
    assert travelled > 1.2
    assert travelled - 1e-9 <= summary.distance_m < travelled + 0.2


def test_without_the_stage_there_is_no_place(wearer, model, samples):
    sink = Poses()
    pipeline = WearerPipeline(load_calibration(wearer.calibration), 60.0, [sink])
    summary = run(pipeline, [Batch(samples[-1].time_s, samples)], model.engine())
    assert {(pose.translation, pose.contacts) for pose in sink.poses} == {(None, None)}
    assert summary.distance_m is None


def test_an_archive_without_a_head_leaves_contacts_unknown(wearer, tiny, samples):
    sink = Poses()
    pipeline = WearerPipeline(load_calibration(wearer.calibration), 60.0, [sink], place=PlaceStage(BODY))
    engine = StreamEngine(tiny(NetworkShape("rnn", 8, "global-6d", "passed")), 0, 0)
    run(pipeline, [Batch(samples[-1].time_s, samples)], engine)
    assert np.isfinite(sink.translations).all()
    assert {pose.contacts for pose in sink.poses} == {None}


# --- the same in every way of running -----------------------------------------------------------------------


def test_a_replay_gives_the_place_of_the_live_run(wearer, model, samples):
    """Sample by sample, in batches, and with a lot that comes late, to the last bit."""
    pipeline = edgepose.Pipeline(load_calibration(wearer.calibration), model)
    one_by_one, in_batches, at_once = (
        list(pipeline.poses((part[-1].time_s, part) for part in parts(samples, size)))
        for size in (1, 60, len(samples))
    )
    assert len(one_by_one) == 180
    for other in (in_batches, at_once):
        for a, b in zip(one_by_one, other, strict=True):
            np.testing.assert_array_equal(a.rotations, b.rotations)
            np.testing.assert_array_equal(a.translation, b.translation)
            np.testing.assert_array_equal(a.contacts, b.contacts)


def test_a_pipeline_without_the_place(wearer, model, samples):
    pipeline = edgepose.Pipeline(load_calibration(wearer.calibration), model, place=False)
    poses = list(pipeline.poses([(samples[299].time_s, samples[:300])]))
    assert {(pose.translation, pose.contacts) for pose in poses} == {(None, None)}
    with pytest.raises(edgepose.EdgeposeError, match="leg length 2 m does not fit"):
        edgepose.Pipeline(load_calibration(wearer.calibration), model, leg_length=2.0)


def parts(samples: list[ImuSample], size: int) -> Iterator[list[ImuSample]]:
    return (samples[i : i + size] for i in range(0, len(samples), size))


def test_several_wearers_have_a_place_each(wearer, tiny):
    """Of one body and one recording, one is put back to the origin on the way."""
    shape = NetworkShape("rnn", 8, "global-6d", "passed", place=True)
    asked = iter([[]] * 100 + [[0.0]])
    stages = [PlaceStage(BODY), PlaceStage(BODY, lambda: next(asked, []))]
    sinks = [Poses(), Poses()]
    sources = [open_source(file=wearer.short, blocking=False) for _ in stages]
    with sources[0] as one, sources[1] as other:
        wearers = [
            Wearer(
                source,
                WearerPipeline(load_calibration(wearer.calibration), 60.0, [sink], place=stage),
                lambda text: None,
            )
            for source, sink, stage in zip((one, other), sinks, stages, strict=True)
        ]
        run_together(wearers, MultiWearerEngine(tiny(shape), 0, 0, 2, place=True), 0.0)
    first, second = (sink.translations for sink in sinks)
    assert len(first) == len(second) == 180
    np.testing.assert_allclose(first[:100], second[:100], atol=1e-5)
    assert second[100, [0, 2]].tolist() == [0.0, 0.0]
    assert np.linalg.norm(first[100, [0, 2]]) > 0.01
    # What they do after that is the same again, seen from another origin.
    np.testing.assert_allclose(
        np.diff(first[101:, [0, 2]], axis=0), np.diff(second[101:, [0, 2]], axis=0), atol=0.01
    )


# --- reset --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("delay_s", [0.0, 0.5])
def test_a_reset_puts_the_wearer_back_to_the_origin(follow, samples, delay_s):
    """Of several requests the earliest counts; the distance walked goes on."""
    said: list[str] = []
    asked = iter([[]] * 120 + [[delay_s + 0.2, delay_s], [delay_s + 0.1] if delay_s else []])
    sink, summary = follow(samples, PlaceStage(BODY, lambda: next(asked, []), said.append))
    at = 120 + round(60 * delay_s)
    plain, whole = follow(samples, PlaceStage(BODY))
    np.testing.assert_array_equal(sink.translations[:at], plain.translations[:at])
    assert sink.translations[at, [0, 2]].tolist() == [0.0, 0.0]
    assert np.linalg.norm(plain.translations[at, [0, 2]]) > 0.5
    assert said == ["place reset: the wearer is back at the origin, on the ground"]
    assert abs(summary.distance_m - whole.distance_m) < 0.2


# --- the distance -------------------------------------------------------------------------------------------


def test_the_distance_is_that_of_walking_not_of_swaying():
    walked, time_s = DistanceWalked(), np.arange(0, 600, 1 / 60)
    sway = 0.03 * np.sin(2 * np.pi * 0.3 * time_s)
    for x in sway:
        walked.add(np.array([x, 0.9, 0.0]))
    assert walked.distance_m <= 0.06
    walked = DistanceWalked()
    for s in np.arange(0, 10, 0.02):
        walked.add(np.array([0.03 * np.sin(9 * s), 0.9 + 0.03 * np.sin(18 * s), s]))
    assert walked.distance_m == pytest.approx(10.0, abs=0.3)
    walked.interrupt()
    walked.add(np.array([0.0, 0.9, 0.0]))
    walked.add(np.array([0.0, 0.9, -2 * STEP_M]))
    assert walked.distance_m == pytest.approx(10.0 + 2 * STEP_M, abs=0.3)


# --- faults -------------------------------------------------------------------------------------------------


def paused(samples: list[ImuSample], seconds: float) -> list[ImuSample]:
    """All sensors stop in the middle of a stride, and go on later."""
    middle_s = samples[0].time_s + 1.5
    return [s._replace(time_s=s.time_s + seconds * (s.time_s > middle_s)) for s in samples]


def still(samples: list[ImuSample], seconds: float, names: list[str]) -> list[ImuSample]:
    """What sensors measure that stay as they are in the middle, in a pause of `paused`."""
    middle_s = samples[0].time_s + 1.5
    last = {s.sensor: s for s in samples if s.time_s <= middle_s}
    count = round(100 * seconds)
    return [
        last[PLACEMENTS.index(name)]._replace(time_s=middle_s + k / 100)
        for k in range(1, count)
        for name in names
    ]


def silent(samples: list[ImuSample], name: str) -> list[ImuSample]:
    start_s, index = samples[0].time_s, PLACEMENTS.index(name)
    return [s for s in samples if s.sensor != index or s.time_s - start_s < 1.0]


def turned(samples: list[ImuSample], name: str) -> list[ImuSample]:
    """A sensor slips round its segment: upside down from one sample to the next."""
    start_s, index = samples[0].time_s, PLACEMENTS.index(name)
    half_turn = np.array([0.0, 1.0, 0.0, 0.0])
    return [
        s._replace(quat=tuple(quat_multiply(np.array(s.quat), half_turn).tolist()))
        if s.sensor == index and s.time_s - start_s > 1.0
        else s
        for s in samples
    ]


def frozen(samples: list[ImuSample]) -> list[ImuSample]:
    """All clocks stand still for half a second, and jump on."""
    from_s = samples[0].time_s + 1.0
    return [s._replace(time_s=from_s if from_s < s.time_s < from_s + 0.5 else s.time_s) for s in samples]


FAULTS: dict[str, Callable[[list[ImuSample]], list[ImuSample]]] = {
    "frozen clock": frozen,
    **{f"silent {name}": lambda samples, name=name: silent(samples, name) for name in PLACEMENTS},
    **{f"turned {name}": lambda samples, name=name: turned(samples, name) for name in PLACEMENTS},
}


def check_path(path: np.ndarray) -> None:
    """There is no jump in a path (T, 3), and it stays on the ground."""
    assert np.isfinite(path).all()
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < LONGEST_STEP_M
    assert 0.0 < path[:, 1].min() <= path[:, 1].max() < 2.0


@pytest.mark.parametrize("fault", FAULTS)
def test_nothing_jumps_by_more_than_a_step(follow, samples, fault):
    sink, _ = follow(FAULTS[fault](samples), PlaceStage(BODY))
    assert len(sink.poses) >= 150
    check_path(sink.translations)


def test_a_restart_of_the_clock_changes_no_place(follow, samples, tiny):
    engine = StreamEngine(tiny(NetworkShape("rnn", 8, "global-6d", "passed", place=True)), 0, 0, place=True)
    sink, _ = follow(paused(samples, 100.0), PlaceStage(BODY), engine)
    (gap,) = np.flatnonzero(np.diff([pose.time_s for pose in sink.poses]) > 1.0)
    check_path(sink.translations)
    assert np.linalg.norm(sink.translations[gap + 1] - sink.translations[gap]) < 0.3


@pytest.mark.parametrize("others", [False, True])
def test_while_no_leg_is_measured_the_wearer_stays(follow, samples, others):
    """For 30 s of silence, or while the upper body goes on; the network runs on with its last inputs."""
    pause = paused(samples, 30.0 if not others else 5.0)
    if others:
        pause += still(samples, 5.0, ["left_forearm", "right_forearm", "head"])
        pause.sort(key=lambda sample: sample.time_s)
    sink, _ = follow(pause, PlaceStage(BODY))
    check_path(sink.translations)
    held = np.array([pose.held >= LOWER_BODY for pose in sink.poses])
    assert held.sum() > (280 if others else 1700)
    places = sink.translations[held]
    assert (places == places[0]).all()
    assert all(pose.contacts is not None for pose in sink.poses)
    after = sink.translations[np.flatnonzero(held)[-1] + 1 :]
    assert np.linalg.norm(after[0] - places[-1]) < 0.3
    assert np.linalg.norm((after[-1] - after[0])[[0, 2]]) > 1.0


@pytest.mark.parametrize(("height_m", "ratio"), [(1.75 * 0.9, 0.9), (1.75 * 1.1, 1.1)])
def test_a_wrong_height_costs_its_share_of_the_distance(follow, samples, height_m, ratio):
    _, true = follow(samples, PlaceStage(BODY))
    sink, wrong = follow(samples, PlaceStage(default_body(height_m)))
    assert wrong.distance_m / true.distance_m == pytest.approx(ratio, abs=0.06)
    assert np.isfinite(sink.translations).all()
