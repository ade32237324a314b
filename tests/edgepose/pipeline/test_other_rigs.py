"""Rigs that have more sensors than the six, or lack some of them, on the real walker."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from edgepose import Pipeline
from edgepose import calibration as cal
from edgepose import rotations as rot
from edgepose.calibration.rezero import START_HOLD_S, HeadingRezero
from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.base import iter_samples
from edgepose.formats.recordings.csv import write_csv
from edgepose.formats.recordings.registry import read_recording, read_sensors
from edgepose.imu import AddedFrame, ImuFrame, Recording, SensorData
from edgepose.inference.model import Model
from edgepose.pipeline.added_sensors import RATE, AddedSensorStage
from edgepose.pipeline.dropout import assumed_bones
from edgepose.pipeline.rig_comparison import unlike_six
from edgepose.placements import PLACEMENTS, ROOT, SENSORS, SITES
from edgepose.pose import PoseFrame
from edgepose.sip.measurements import mounts_from_hold, orientation_at
from edgepose.skeleton import JOINTS, global_rotations
from edgepose.sources import open_source
from edgepose.sources.sensor_map import read_map
from firmware_protocols.registry import PROTOCOLS
from firmware_protocols.sample import Sample

REAL = Path(__file__).parents[2] / "data" / "real"
THIGH = "left_upper_leg"
MORE = ("left_upper_arm", "right_upper_arm", THIGH, "right_upper_leg")
HOLD = (0.5, 3.5)
END_S = 7.6
DEAD = (5.6, 6.6)


@cache
def walker() -> dict[str, SensorData]:
    """The first seconds of the 17 sensors."""
    whole = [read_recording(REAL / "mtw-walk.npz"), read_sensors(REAL / "mtw-walk-reference.npz", SENSORS)]
    return {
        name: cut(data, data.time_s < END_S)
        for recording in whole
        for name, data in recording.sensors.items()
    }


def cut(data: SensorData, rows: np.ndarray) -> SensorData:
    return SensorData(*(None if column is None else column[rows] for column in data))


def rig(*names: str) -> Recording:
    return Recording({name: walker()[name] for name in SENSORS if name in names}, {})


def calibrated(recording: Recording) -> cal.Calibration:
    hold = cal.trim(cal.hold_from_recording(recording, list(recording.sensors)), *HOLD)
    made = cal.calibrate(cal.check_hold(hold), pose="straight", body_frame="heading:28", created="")
    return cal.from_json(cal.to_json(made))


class Walk(NamedTuple):
    poses: list[PoseFrame]
    bones: np.ndarray  # (T, 24, 3, 3) R_TB
    pipeline: Pipeline


@cache
def model() -> Model:
    return Model("rnn", runtime="numpy")


def walk(calibration: cal.Calibration, recording: Recording, end_s: float = END_S) -> Walk:
    sensors = {name: cut(data, data.time_s < end_s) for name, data in recording.sensors.items()}
    recording = recording._replace(sensors=sensors)
    pipeline = Pipeline(calibration, model())
    poses = list(pipeline.poses([(end_s, list(iter_samples(recording)))]))
    bones = global_rotations(np.stack([pose.rotations for pose in poses]))
    return Walk(poses, bones, pipeline)


@pytest.fixture(scope="module")
def six() -> Walk:
    return walk(calibrated(rig(*PLACEMENTS)), rig(*PLACEMENTS))


@pytest.fixture(scope="module")
def ten() -> Walk:
    recording = rig(*PLACEMENTS, *MORE)
    return walk(calibrated(recording), recording)


def apart_deg(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.degrees(rot.geodesic_angle(one, other))


def test_added_sensors_measure_their_bones_and_change_no_other(six: Walk, ten: Walk) -> None:
    recording = rig(*PLACEMENTS, *MORE)
    mounts = mounts_from_hold(recording, calibrated(rig(*PLACEMENTS)), MORE, *HOLD)
    times = np.array([pose.time_s for pose in ten.poses])
    for name, mount in mounts.items():
        data = recording.sensors[name]
        measured = rot.quat_to_matrix(orientation_at(data.time_s, data.quat, times))
        true = mount.body_from_inertial @ measured @ rot.transpose(mount.bone_from_sensor)
        assert apart_deg(ten.bones[:, SITES[name]], true).max() < 0.1
        assert apart_deg(six.bones[:, SITES[name]], true).max() > 10.0
    others = [joint for joint in range(24) if joint not in [SITES[name] for name in MORE]]
    assert apart_deg(ten.bones[:, others], six.bones[:, others]).max() < 0.01
    assert all(pose.std[SITES[name]] == 0.0 for pose in ten.poses for name in MORE)
    assert {pose.status for pose in ten.poses} == {"ok"}
    # Where the wearer is, is found with the measured thighs.
    apart = [a.translation - b.translation for a, b in zip(ten.poses, six.poses, strict=True)]
    assert np.abs(apart).max() > 0.02


def test_an_added_sensor_that_dies_costs_only_its_bone_and_nothing_jumps(six: Walk, ten: Walk) -> None:
    recording = rig(*PLACEMENTS, *MORE)
    data = recording.sensors[THIGH]
    data = cut(data, (data.time_s < DEAD[0]) | (data.time_s > DEAD[1]))
    dying = walk(calibrated(recording), recording._replace(sensors=recording.sensors | {THIGH: data}))
    joint, others = SITES[THIGH], np.arange(24) != SITES[THIGH]
    assert apart_deg(dying.bones[:, others], ten.bones[:, others]).max() < 0.01
    held = np.array([pose.status == f"held {THIGH}" for pose in dying.poses])
    assert 56 <= held.sum() <= 61
    assert {pose.status for pose in dying.poses} == {"ok", f"held {THIGH}"}
    assert dying.pipeline.summary.held_by_sensor == {THIGH: held.sum()}
    off = apart_deg(dying.bones[:, joint], ten.bones[:, joint])
    first, last = np.flatnonzero(held)[[0, -1]]
    assert off[: first - 2].max() < 0.01
    assert apart_deg(dying.bones[last, joint], six.bones[last, joint]) < 0.01
    assert off[last + 40 :].max() < 0.01
    steps = [apart_deg(bones[1:, joint], bones[:-1, joint]).max() for bones in (six.bones, ten.bones)]
    most = max(steps) + math.degrees(RATE) / 60.0
    assert apart_deg(dying.bones[1:, joint], dying.bones[:-1, joint]).max() < most
    # Without the rate limit the bone would have jumped by this much.
    assert apart_deg(ten.bones[first, joint], six.bones[first, joint]) > most + 2.0


def test_an_added_sensor_that_never_sends_costs_nothing_else(six: Walk) -> None:
    calibration = calibrated(rig(*PLACEMENTS, THIGH))
    silent = walk(calibration, rig(*PLACEMENTS), 1.0)
    assert apart_deg(silent.bones, six.bones[:60]).max() < 0.01
    assert {pose.status for pose in silent.poses} == {f"held {THIGH}"}


def test_neck_collars_and_spine_go_with_a_measured_chest() -> None:
    rng = np.random.default_rng(5)
    local = rot.rotvec_to_matrix(rng.normal(0.0, 0.2, (24, 3)))
    bones = global_rotations(local)
    turn = rot.rotvec_to_matrix([0.3, 0.1, -0.2])
    chest = SITES["chest"]
    measured = AddedFrame(np.zeros((1, 4)), np.array([False]), (bones[chest] @ turn)[None])
    pose = AddedSensorStage(["chest"]).correct(PoseFrame(0, 0.0, local, np.ones(24)), measured)
    found = global_rotations(pose.rotations)
    turned = {chest, *map(JOINTS.index, ("neck", "left_collar", "right_collar", "spine1", "spine2"))}
    for joint in set(range(24)) - turned:
        np.testing.assert_allclose(found[joint], bones[joint], atol=1e-9)
    for name in ("neck", "left_collar", "right_collar"):
        np.testing.assert_allclose(pose.rotations[JOINTS.index(name)], local[JOINTS.index(name)], atol=1e-9)
    shares = [rot.geodesic_angle(found[joint], bones[joint]) for joint in (3, 6, 9)]
    np.testing.assert_allclose(np.array(shares) / shares[-1], [1 / 3, 2 / 3, 1.0], atol=1e-6)


def test_headings_of_added_sensors_are_re_zeroed_one_by_one() -> None:
    calibration = calibrated(rig(*PLACEMENTS, *MORE))
    drift = np.array([0.3, -0.5, 0.2, 0.1])
    at_rest = {name: walker()[name].quat[60] for name in [*PLACEMENTS, *MORE]}
    added = rot.quat_multiply(rot.quat_about_z(drift), np.stack([at_rest[name] for name in MORE]))
    lines: list[str] = []
    headings = HeadingRezero(calibration, hold_first=True, notify=lines.append)
    found = None
    for i in range(round(START_HOLD_S * 60) + 2):
        shaken = added.copy()
        shaken[3] = rot.quat_multiply(rot.quat_about_z(0.2 * (-1) ** i), added[3])
        six = np.stack([at_rest[name] for name in PLACEMENTS])
        frame = ImuFrame(i, i / 60, six, np.zeros((6, 3)), np.zeros(6, bool), i / 60)
        found = headings.calibration_for(frame._replace(added=AddedFrame(shaken, np.zeros(4, bool))))
    assert found is not None
    np.testing.assert_allclose(found.added.heading_offset[:3], -drift[:3], atol=0.03)
    assert math.isnan(found.added.heading_offset[3])  # it moved: its bone is predicted until the next hold
    assert "moved: right_upper_leg; the others are re-zeroed" in lines
    assert str(unlike_six(replace(calibration, north=False))).endswith(" the six, without drift correction")


def test_a_rig_without_a_head_runs_and_is_not_reported_as_lost(six: Walk) -> None:
    worn = [name for name in PLACEMENTS if name != "head"]
    recording = rig(*worn)
    calibration = calibrated(recording)
    assert (calibration.without, list(calibration.sensors)) == (["head"], worn)
    lacking = walk(calibration, recording, 1.0)
    assert {pose.status for pose in lacking.poses} == {"ok"}
    measured = [SITES[name] for name in worn]
    assert apart_deg(lacking.bones[:, measured], six.bones[:60, measured]).max() < 0.01
    drifting = walk(replace(calibration, north=False), recording, 2.0).pipeline.summary.corrections_deg
    assert drifting is not None
    assert [name for name, angle in zip(PLACEMENTS, drifting, strict=True) if angle] == worn
    assert str(unlike_six(replace(calibration, north=False))).endswith("poses are less accurate")
    few = replace(calibration, north=False, without=["left_forearm", "right_forearm", "head"])
    assert str(unlike_six(few)).endswith(
        "less accurate; no slip shows; without a forearm, the straight pose does not correct drift"
    )
    with pytest.raises(EdgeposeError, match="this rig has no head sensor"):
        cal.calibrate(
            cal.check_hold(cal.trim(cal.hold_from_recording(recording, worn), *HOLD)),
            pose="straight", body_frame="head", created="",
        )  # fmt: skip


def test_bones_that_are_never_measured_start_as_those_of_a_wearer_who_stands() -> None:
    bones = np.tile(rot.rotation_about_axis("y", 1.0), (6, 1, 1))
    missing = np.array([name.endswith("forearm") for name in PLACEMENTS])
    assumed = assumed_bones(bones, missing)
    np.testing.assert_allclose(assumed[missing], bones[ROOT] @ cal.POSES["straight"][missing])
    np.testing.assert_array_equal(assumed[~missing], bones[~missing])


# --- files, maps, commands ----------------------------------------------------------------------------------


def capture(path: Path, ids: dict[str, int], end_s: float) -> None:
    """Write the bytes that sensors with these ids send on one line."""
    encode = PROTOCOLS["native"].encoder()
    with path.open("wb") as file:
        for sample in iter_samples(rig(*ids)):
            if sample.time_s < end_s:
                number = ids[SENSORS[sample.sensor]]
                time_us = round(sample.time_s * 1e6)
                file.write(encode(Sample(number, time_us, sample.quat, sample.acc, sample.gyr, None, 0), 0))


def test_a_map_gives_ids_to_more_or_fewer_sensors(tmp_path: Path, command) -> None:
    ids = {"left_forearm": 3, "right_forearm": 4, "pelvis": 9, "chest": 7, THIGH: 40}
    rows = "".join(f"{name} = {{ id = {number} }}\n" for name, number in ids.items())
    (tmp_path / "rig.toml").write_text(rows)
    sensor_map = read_map(tmp_path / "rig.toml")
    assert sensor_map.all_places() == {number: SENSORS.index(name) for name, number in ids.items()}
    assert sensor_map.without == ["left_lower_leg", "right_lower_leg", "head"]
    capture(tmp_path / "walk.bin", ids, 4.0)
    line = ("--file", tmp_path / "walk.bin", "--sensors", tmp_path / "rig.toml")
    made = command(
        *("calibrate", *line, "--hold", 3, "--from", "+0.3", "--body-frame", "heading:28"),
        *("--out", tmp_path / "calib.json"),
    )
    assert made.returncode == 0, made.stderr
    assert "A rig without left_lower_leg, right_lower_leg, head: poses are less accurate." in made.stderr
    calibration = cal.load_calibration(tmp_path / "calib.json")
    assert list(calibration.sensors) == ["left_forearm", "right_forearm", "pelvis", "chest", THIGH]
    checked = command("check", *line, "--calibration", tmp_path / "calib.json")
    assert checked.returncode == 0, checked.stdout
    assert "5 of 5 sensors fine" in checked.stdout


def test_a_sensor_that_the_calibration_lacks_is_not_compared_with_it(tmp_path: Path, command) -> None:
    write_csv(tmp_path / "walk.csv", rig(*PLACEMENTS))
    line = ("--file", tmp_path / "walk.csv")
    made = command(
        *("calibrate", *line, "--without", "head", "--hold", 3, "--from", "+0.3"),
        *("--body-frame", "heading:28", "--out", tmp_path / "calib.json"),
    )
    assert made.returncode == 0, made.stderr
    checked = command("check", *line, "--calibration", tmp_path / "calib.json")
    assert checked.returncode == 0, checked.stdout
    assert "6 of 6 sensors fine" in checked.stdout


def test_a_recording_names_its_further_sensors(tmp_path: Path) -> None:
    whole = Recording(
        {name: cut(data, data.time_s < 0.5) for name, data in rig(*SENSORS).sensors.items()}, {}
    )
    write_csv(tmp_path / "walk.csv", whole)
    assert list(read_recording(tmp_path / "walk.csv").sensors) == list(SENSORS)
    with open_source(file=tmp_path / "walk.csv") as source:
        sent = {sample.sensor for batch in source for sample in batch.samples}
    assert sent == set(range(17))
    # A calibration of the six leaves the others out.
    walked = walk(calibrated(rig(*PLACEMENTS)), whole, 0.4)
    assert {pose.status for pose in walked.poses} == {"ok"}
