"""Drift of headings, and how a run corrects it: what shows it, what does not, and how fast."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from edgepose import rotations as rot
from edgepose.calibration import POSES, apply_calibration, load_calibration
from edgepose.formats.recordings.base import iter_samples
from edgepose.formats.recordings.registry import read_recording
from edgepose.imu import GRAVITY, ImuFrame, ImuSample
from edgepose.inference.engine import EngineInput
from edgepose.orientation.drift import DriftCorrector
from edgepose.orientation.drift.corrector import FASTEST
from edgepose.orientation.drift.estimator import ODDS, DriftEstimator
from edgepose.orientation.drift.evidence import Block
from edgepose.pipeline.wearer_pipeline import WearerPipeline
from edgepose.placements import PLACEMENTS, ROOT
from edgepose.sources import Batch

STRAIGHT = POSES["straight"]
IN_INERTIAL = rot.transpose(rot.Z_UP_TO_T)
FOREARM, SHIN, HEAD = 0, 2, 4
DEG = np.radians(1.0)
MINUTE = 120
"""Blocks."""
RATE = 20
"""Frames per second."""


# --- evidence, block by block -------------------------------------------------------------------------------


def block(heading: dict[int, float], **changes: object) -> Block:
    """Half a second of standing; headings in deg, by sensor."""
    angles = np.zeros(6)
    for sensor, angle in heading.items():
        angles[sensor] = angle * DEG
    moving = Block(
        0.5, np.zeros(6), np.full(6, 20.0 * DEG), angles, np.zeros(6), np.full(6, 0.97), np.zeros(6, bool)
    )
    return moving._replace(**changes)


KNOWN_TO_DRIFT = 20.0
"""Odds."""


def after(
    blocks: int, heading: Callable[[float], dict[int, float]], odds: float = KNOWN_TO_DRIFT, **changes: object
) -> np.ndarray:
    """Heading errors, deg, found after blocks whose headings depend on the minutes that have passed."""
    estimator = DriftEstimator(PLACEMENTS, ROOT, odds)
    for k in range(blocks):
        estimator.update(block(heading(k / MINUTE), **changes))
    return np.degrees(estimator.error)


def all_drift(minutes: float) -> dict[int, float]:
    return {sensor: rate * minutes for sensor, rate in enumerate((10.0, -9.0, 10.0, -8.0, -9.0))}


def test_shins_and_head_are_pulled_to_the_pelvis_while_the_wearer_is_upright():
    found = after(6 * MINUTE, all_drift)
    np.testing.assert_allclose((found - found[ROOT])[2:5], [60.0, -48.0, -54.0], rtol=0.4)


@pytest.mark.parametrize(
    "changes",
    [
        {"upright": np.zeros(6)},
        {"turned": np.full(6, 40.0 * DEG)},
        {"held": np.arange(6) == ROOT},
        {"held": np.ones(6, bool)},
        {"spread": np.full(6, 0.5)},
    ],
    ids=["lying", "turning on the spot", "pelvis held", "all held", "unsteady"],
)
def test_nothing_is_pulled_where_headings_show_nothing(changes):
    assert not after(3 * MINUTE, all_drift, **changes).any()


def test_a_held_sensor_is_not_pulled():
    found = after(3 * MINUTE, all_drift, held=np.arange(6) == SHIN)
    assert abs(found[SHIN]) < 1.0
    assert found[HEAD] < -3.0


def test_arms_that_are_level_show_nothing():
    level = np.array([0.1, 0.1, 0.97, 0.97, 0.97, 0.97])
    found = after(3 * MINUTE, lambda minutes: {FOREARM: 10.0 * minutes}, upright=level)
    assert abs(found[FOREARM]) < 0.1


@pytest.mark.parametrize("sensor", [FOREARM, SHIN, HEAD])
def test_an_odd_posture_of_good_gyroscopes_stays(sensor):
    """The same for minutes, and from one moment to the next: drift does neither."""
    angle = {FOREARM: 60.0, SHIN: 20.0, HEAD: 35.0}[sensor]
    found = after(5 * MINUTE, lambda minutes: {sensor: angle if minutes > 0.5 else 0.0}, ODDS)
    assert abs(found - found[ROOT]).max() < 2.0


def test_a_rest_shows_the_bias_of_every_sensor():
    rates = np.array([10.0, -10.0, 0.5, 5.0, -3.0, 8.0])
    estimator = DriftEstimator(PLACEMENTS, ROOT)
    for _ in range(MINUTE):
        # Lying: there is nothing else to go by.
        estimator.update(block({}, turned=rates * DEG / MINUTE, moved=np.zeros(6), upright=np.full(6, 0.0)))
    np.testing.assert_allclose(np.degrees(estimator.bias) * 60.0, rates, atol=1.0)


def test_a_held_sensor_is_not_at_rest():
    estimator = DriftEstimator(PLACEMENTS, ROOT)
    held = np.arange(6) == FOREARM
    for _ in range(MINUTE):
        estimator.update(block({}, turned=np.full(6, 10.0 * DEG / MINUTE), moved=np.zeros(6), held=held))
    assert abs(estimator.bias[FOREARM]) < 0.1 * estimator.bias[HEAD]


def test_the_straight_pose_sets_all_headings_at_once():
    estimator = DriftEstimator(PLACEMENTS, ROOT, KNOWN_TO_DRIFT)
    lying, drifted = np.zeros(6), np.array([25.0, -25.0, 15.0, -15.0, 20.0, 0.0])
    for _ in range(3 * MINUTE):
        estimator.update(block({}, upright=lying))
    for _ in range(4):
        estimator.update(block(dict(enumerate(drifted)), upright=np.ones(6), moved=np.full(6, DEG)))
    found = np.degrees(estimator.error)
    np.testing.assert_allclose(found - found[ROOT], drifted, atol=10.0)


@pytest.mark.parametrize(
    ("lacking", "recognised"), [({0}, True), ({0, 4}, True), ({0, 1}, False), ({5}, False)]
)
def test_the_straight_pose_of_a_rig_that_lacks_sensors(lacking, recognised):
    """With one forearm that hangs it is one; without any, the wearer might sit."""
    estimator = DriftEstimator(PLACEMENTS, ROOT, KNOWN_TO_DRIFT)
    held = np.isin(np.arange(6), list(lacking))
    for _ in range(3 * MINUTE):
        estimator.update(block({}, upright=np.zeros(6), held=held))
    posed = {"upright": np.where(held, 0.0, 1.0), "moved": np.full(6, DEG), "spread": np.ones(6)}
    for _ in range(4):
        estimator.update(block({3: 15.0}, held=held, **posed))
    found = np.degrees(estimator.error)
    assert found[3] - found[ROOT] == pytest.approx(15.0 if recognised else 0.0, abs=7.0)


def test_a_rezero_reveals_scale_errors():
    """After thirteen turns of someone who lies, so that nothing else shows headings."""
    estimator = DriftEstimator(PLACEMENTS, ROOT)
    turned = np.full(6, 10.0 * DEG)
    for _ in range(4 * MINUTE):
        estimator.update(block({}, turned=turned, upright=np.zeros(6)))
    scale = np.array([0.004, -0.005, 0.003, -0.004, 0.005, 0.0])
    estimator.rezero(scale * turned * 4 * MINUTE, np.zeros(6), np.zeros(6, bool))
    assert not estimator.error.any()
    for _ in range(MINUTE):
        estimator.update(block({}, turned=turned, upright=np.zeros(6)))
    grown = estimator.error - estimator.error[ROOT]
    np.testing.assert_allclose(grown, scale * turned * MINUTE, atol=1.0 * DEG)


# --- frame by frame -----------------------------------------------------------------------------------------


class Stand:
    """A wearer who stands straight or lies, and whose sensors drift."""

    def __init__(self, rates_deg_min: np.ndarray, lying: bool = False) -> None:
        self.corrector = DriftCorrector(STRAIGHT, PLACEMENTS, ROOT)
        self.rates, self.error, self.offset = rates_deg_min * DEG / 60.0, np.zeros(6), np.zeros(6)
        self.index = 0
        leant = rot.rotation_about_axis("x", -np.pi / 2.0) if lying else np.eye(3)
        self.quats = rot.matrix_to_quat(IN_INERTIAL @ leant @ STRAIGHT)
        self.corrections: list[np.ndarray] = []
        self.bones: list[np.ndarray] = []

    def go(self, seconds: float, held: np.ndarray | None = None) -> None:
        held = np.zeros(6, bool) if held is None else held
        for _ in range(round(seconds * RATE)):
            self.index += 1
            self.error = self.error + self.rates / RATE
            quats = rot.quat_multiply(rot.quat_about_z(self.error), self.quats)
            force = np.tile([0.0, 0.0, GRAVITY], (6, 1))
            time_s = self.index / RATE
            frame = self.corrector.correct(ImuFrame(self.index, time_s, quats, force, held, time_s))
            fixed = rot.quat_multiply(rot.quat_about_z(self.offset), frame.orientation)
            self.bones.append(rot.Z_UP_TO_T @ rot.quat_to_matrix(fixed))
            self.corrector.observe(self.bones[-1], self.offset)
            self.corrections.append(self.corrector.corrections)

    def rezero(self, offset: np.ndarray, held: np.ndarray | None = None) -> None:
        """Let a re-zero go on for a second, to heading offsets (6,)."""
        for share in np.linspace(0.0, 1.0, RATE)[1:]:
            self.offset = share * offset
            self.go(1.0 / RATE, held)

    @property
    def headings_deg(self) -> np.ndarray:
        """Headings (6,) of the corrected bones, against the pelvis."""
        yaw = rot.yaw_of_matrix(self.bones[-1] @ rot.transpose(STRAIGHT))
        return np.degrees(yaw - yaw[ROOT])


RATES = np.array([10.0, -10.0, 8.0, -6.0, 9.0, -5.0])


def test_a_rig_at_rest_is_locked():
    stand = Stand(RATES)
    stand.go(30.0)
    assert abs(stand.headings_deg).max() < 2.0
    before = stand.headings_deg
    stand.go(30.0)
    assert abs(stand.headings_deg - before).max() < 1.0


def test_no_correction_is_faster_than_its_limit():
    stand = Stand(6.0 * RATES)
    stand.go(15.0)
    steps = np.abs(np.diff(stand.corrections, axis=0)) * RATE
    assert steps.max() == pytest.approx(FASTEST)


def test_the_correction_of_a_silent_sensor_stands_still():
    stand = Stand(RATES)
    stand.go(20.0)
    stand.go(1.0, held=np.arange(6) == SHIN)
    last = np.array(stand.corrections[-RATE:])
    assert np.ptp(last[:, SHIN]) == 0.0
    assert np.ptp(last[:, HEAD]) > 0.0
    stand.go(1.0, held=np.arange(6) == ROOT)
    assert np.ptp(np.array(stand.corrections[-RATE:]), axis=0).max() == 0.0


def test_known_drift_goes_on_while_nothing_is_received():
    """For a minute and a half; the sensors lie, so that nothing shows their headings before or after."""
    stand = Stand(RATES, lying=True)
    stand.go(30.0)
    before = stand.headings_deg
    stand.index += 90 * RATE
    stand.error = stand.error + 90.0 * stand.rates
    stand.go(40.0)
    assert abs(stand.headings_deg - before).max() < 2.0


def test_after_a_long_pause_a_correction_takes_the_shorter_way():
    """The forearm has drifted by nearly a whole turn, which would take eleven minutes to correct."""
    stand = Stand(RATES, lying=True)
    stand.go(30.0)
    pause_s = 35 * 60
    stand.index += pause_s * RATE
    stand.error = stand.error + pause_s * stand.rates
    stand.go(60.0)
    assert -40.0 < np.degrees(stand.corrector.corrections[FOREARM]) < 0.0


def test_a_rezero_is_kept_and_not_undone():
    stand = Stand(np.zeros(6))
    stand.go(3.0)
    found = np.array([12.0, -20.0, 15.0, 5.0, -9.0, 40.0]) * DEG
    stand.rezero(found)
    before = stand.headings_deg
    stand.error = -found
    stand.go(10.0)
    assert abs(stand.headings_deg).max() < 1.0
    assert abs(before).max() > 20.0


def test_a_wearer_who_re_zeroes_facing_another_way_shows_no_drift_of_a_sensor_that_the_rig_lacks():
    lacking, drifts = np.arange(6) < 2, []
    for angle in (0.01, 40.0):
        stand = Stand(np.zeros(6))
        stand.go(15.0, lacking)
        stand.rezero(np.where(lacking, 0.0, angle * DEG), lacking)
        stand.go(1.0, lacking)
        drifts.append(stand.corrector._estimator.drifts)
    assert drifts[0] == pytest.approx(drifts[1], rel=1e-3)


# --- in a run -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def samples(wearer) -> list[ImuSample]:
    """Three seconds, at whose end sensors have drifted by up to ten degrees."""
    drifting = []
    for sample in iter_samples(read_recording(wearer.short)):
        angle = RATES[sample.sensor] * DEG * 20.0 * (sample.time_s - 5.5) / 60.0
        turn = rot.quat_multiply(rot.quat_about_z(angle), sample.quat)
        drifting.append(sample._replace(quat=tuple(turn.tolist())))
    return drifting


def inputs(wearer, samples: list[ImuSample], size: int, *, north: bool = False) -> Iterator[EngineInput]:
    calibration = replace(load_calibration(wearer.calibration), north=north)
    pipeline = WearerPipeline(calibration, 60.0, [])
    for k in range(0, len(samples), size):
        part = samples[k : k + size]
        yield from pipeline.process(Batch(part[-1].time_s, part))
    yield from pipeline.flush()
    assert (pipeline.summary.corrections_deg is None) == north


def assert_same(one: list[EngineInput], other: list[EngineInput]) -> None:
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.orientation, b.orientation)
        np.testing.assert_array_equal(a.acceleration, b.acceleration)


def test_live_and_replayed_samples_and_other_wearers_give_the_same_to_the_last_bit(wearer, samples):
    alone = list(inputs(wearer, samples, len(samples)))
    assert_same(alone, list(inputs(wearer, samples, 7)))
    beside = zip(inputs(wearer, samples, 7), inputs(wearer, samples[:-30], 7), strict=False)
    assert_same(alone[:100], [mine for mine, _ in beside][:100])


def test_a_common_north_is_left_alone_and_a_drifting_rig_is_not(wearer, samples):
    north = list(inputs(wearer, samples, 60, north=True))
    calibration = load_calibration(wearer.calibration)
    for each in north:
        bones, acceleration = apply_calibration(calibration, each.frame.orientation, each.frame.force)
        np.testing.assert_array_equal(each.orientation, bones.astype(np.float32))
        np.testing.assert_array_equal(each.acceleration, acceleration.astype(np.float32))
    corrected = list(inputs(wearer, samples, 60))
    assert not np.array_equal(corrected[-1].orientation, north[-1].orientation)


def test_the_run_says_what_it_corrected_unless_it_is_not_to(command, wearer, tmp_path):
    calibration = tmp_path / "no-north.json"
    text = wearer.calibration.read_text(encoding="utf-8")
    calibration.write_text(text.replace('"north": true', '"north": false'), encoding="utf-8")
    assert calibration.read_text(encoding="utf-8") != text
    told, corrections = {}, {}
    for flags in ((), ("--no-drift-correction",)):
        result = command(
            *("run", "--file", wearer.short, "--calibration", calibration, "--model", "rnn", "--runtime"),
            *("numpy", "--csv", tmp_path / "poses.csv", "--overwrite", "--json", *flags),
        )
        assert result.returncode == 0, result.stderr
        corrections[flags] = json.loads(result.stdout)["runs"][0]["corrections_deg"]
        told[flags] = [line for line in result.stderr.splitlines() if line.startswith("drift ")]
    assert told["--no-drift-correction",] == []
    assert corrections["--no-drift-correction",] is None
    (line,) = told[()]
    assert list(corrections[()]) == list(PLACEMENTS)
    assert all(f"{name} {angle:+.1f}" in line for name, angle in corrections[()].items())
