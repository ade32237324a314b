"""Calibrations that cannot be the wearer's: `check` and `run` tell of them, and of no others."""

from __future__ import annotations

import json
import re
from collections import deque
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edgepose import rotations as rot
from edgepose.calibration import POSES, load_calibration
from edgepose.calibration.fit import fit_pose
from edgepose.calibration.impossible import ImpossibleBones, impossible_bones
from edgepose.calibration.misfit import MisfitDetector
from edgepose.formats.recordings.npz import write_npz
from edgepose.formats.recordings.registry import read_recording
from edgepose.imu import ImuFrame, Recording
from edgepose.pipeline.rig_comparison import other_devices
from edgepose.placements import BONES, PLACEMENTS
from edgepose.sources import Device
from edgepose_export.synthesis.heading_routine import exercises

REAL = Path(__file__).parents[2] / "data" / "imu" / "six-sites-walk.npz"


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    """A real wearer: two seconds in the pose, and eight of walking, without the minute between."""
    recording = read_recording(REAL)
    sensors = {
        name: data._replace(time_s=np.where(data.time_s > 60.0, data.time_s - 58.0, data.time_s))
        for name, data in recording.sensors.items()
    }
    path = tmp_path_factory.mktemp("real") / "walk.npz"
    write_npz(path, Recording(sensors, recording.metadata))
    return path


@pytest.fixture(scope="module")
def calibrated(command, real, tmp_path_factory):
    """The calibration of the real wearer."""
    path = tmp_path_factory.mktemp("real") / "c.json"
    result = command("calibrate", "--file", real, "--hold", 1.5, "--out", path)
    assert result.returncode == 0, result.stderr
    return path


def exchanged(real: Path, tmp_path: Path, pairs: list[tuple[str, str]]) -> Path:
    """The recording of a wearer who has put sensors on each other's places."""
    recording = read_recording(real)
    sensors = dict(recording.sensors)
    for one, other in pairs:
        sensors[one], sensors[other] = sensors[other], sensors[one]
    path = tmp_path / "exchanged.npz"
    write_npz(path, Recording(sensors, recording.metadata))
    return path


def told(command, recording: Path, calibration: Path) -> tuple[list[str], str, int]:
    """Warnings of `run`, and the table and exit code of `check`."""
    flags = ("--file", recording, "--calibration", calibration)
    run = command("run", *flags, "--model", "rnn", "--csv", "/dev/null")
    assert run.returncode == 0, run.stderr
    check = command("check", *flags)
    return re.findall(r"^warning: .*", run.stderr, re.MULTILINE), check.stdout, check.returncode


def test_its_own_calibration_says_nothing(command, real, calibrated):
    warnings, table, code = told(command, real, calibrated)
    assert warnings == []
    assert "6 of 6 sensors fine" in table
    assert code == 0


@pytest.mark.parametrize(
    "pairs",
    [
        [("left_forearm", "right_forearm")],
        [("left_lower_leg", "right_lower_leg")],
        [("left_forearm", "right_forearm"), ("left_lower_leg", "right_lower_leg")],
        [("head", "pelvis")],
        [("left_forearm", "left_lower_leg")],
        [("left_forearm", "head"), ("head", "pelvis")],
    ],
    ids=str,
)
def test_exchanged_sensors(command, real, calibrated, tmp_path, pairs):
    warnings, table, code = told(command, exchanged(real, tmp_path, pairs), calibrated)
    moved = {name for pair in pairs for name in pair}
    message = next(line for line in warnings if "swapped since the calibration" in line)
    assert set(re.findall(r"(\w+) is where", message)) == moved
    assert set(re.findall(r"^(\w+): it is where", table, re.MULTILINE)) == moved
    assert code == 3


@pytest.mark.parametrize("seed", range(2))
def test_the_calibration_of_another_rig(command, real, calibrated, tmp_path, seed):
    """Its sensors sit at other angles."""
    document = json.loads(calibrated.read_text())
    rng = np.random.default_rng(seed)
    for sensor in document["sensors"].values():
        quat = rng.normal(size=4)
        sensor["bone_from_sensor"] = (quat / np.linalg.norm(quat)).tolist()
    (tmp_path / "other.json").write_text(json.dumps(document))
    warnings, table, code = told(command, real, tmp_path / "other.json")
    assert any("the wearer has not stood still in the calibration's pose" in line for line in warnings)
    assert re.search(r" [0-2] of 6 sensors fine", table)
    assert code == 3


def turned(recording: Recording, name: str, axis: str, angle_deg: float) -> Recording:
    """A recording in which one sensor was turned about an axis of the inertial frame."""
    data = recording.sensors[name]
    about = rot.quat_rotate(rot.quat_conjugate(data.quat[0]), np.eye(3)["xyz".index(axis)])
    turn = rot.matrix_to_quat(rot.rotvec_to_matrix(np.radians(angle_deg) * about))
    back = rot.quat_conjugate(turn)
    acc, gyr = (rot.quat_rotate(back, column) for column in (data.acc, data.gyr))
    moved = data._replace(quat=rot.quat_multiply(data.quat, turn), acc=acc, gyr=gyr)
    return Recording(recording.sensors | {name: moved}, recording.metadata)


@pytest.mark.parametrize(
    ("name", "axis", "angle_deg", "says"),
    [
        ("head", "x", 180, "it sits upside down"),
        ("pelvis", "y", 180, "it sits upside down"),
        ("left_forearm", "x", 40, "has slipped"),
        ("right_lower_leg", "z", 40, "has slipped"),
    ],
)
def test_one_sensor_that_sits_otherwise(command, real, calibrated, tmp_path, name, axis, angle_deg, says):
    write_npz(tmp_path / "turned.npz", turned(read_recording(real), name, axis, angle_deg))
    warnings, table, code = told(command, tmp_path / "turned.npz", calibrated)
    (line,) = [line for line in warnings if line.startswith(f"warning: {name} is turned by {angle_deg} deg")]
    assert says in line
    assert warnings == [line]
    assert re.findall(r"^(\w+): it", table, re.MULTILINE) == [name]
    assert code == 3


def test_a_protocol_and_a_height_that_are_not_the_calibrations(command, wearer, tmp_path):
    """Both are named by `run`, which goes on, and by `check`, which ends with 1."""
    capture(wearer, tmp_path / "a.bin")
    calibration = tmp_path / "c.json"
    flags = ("--body-frame", "heading:0", "--from", 1, "--height", 1.68, "--out", calibration)
    result = command("calibrate", "--file", tmp_path / "a.bin", "--protocol", "native", *flags)
    assert result.returncode == 0, result.stderr
    calibration.write_text(calibration.read_text().replace('"native"', '"xsens"'))
    flags = ("--file", tmp_path / "a.bin", "--protocol", "native", "--calibration", calibration)
    for words, code in ((("run", "--model", "rnn", "--csv", "/dev/null"), 0), (("check",), 3)):
        result = command(*words, *flags, "--height", 1.9)
        assert result.returncode == code
        assert "left_forearm was xsens id 0 and is native id 0 (and 5 others)" in result.stderr
        assert "the calibration is of a wearer of 1.68 m, and --height is 1.9: leave" in result.stderr


def test_a_run_takes_the_height_of_its_calibration(command, wearer, tmp_path):
    calibration = tmp_path / "c.json"
    flags = ("--body-frame", "heading:0", "--from", 1, "--height", 1.5, "--out", calibration)
    assert command("calibrate", "--file", wearer.recording, *flags).returncode == 0
    flags = ("--file", wearer.short, "--model", "rnn", "--calibration", calibration)
    for name, more in (("taken", ()), ("given", ("--height", 1.52)), ("told", ("--height", 1.8))):
        result = command("run", *flags, *more, "--bvh", tmp_path / f"{name}.bvh")
        assert result.returncode == 0, result.stderr
        assert ("of a wearer of 1.5 m" in result.stderr) == (name == "told")
    offsets = {
        name: re.findall(r"OFFSET (.*)", (tmp_path / f"{name}.bvh").read_text())
        for name in ("taken", "given", "told")
    }
    length = {name: sum(abs(float(v)) for row in rows for v in row.split()) for name, rows in offsets.items()}
    assert length["taken"] == pytest.approx(length["told"] * 1.5 / 1.8, rel=0.02)
    assert length["given"] > length["taken"]


def test_a_map_that_denies_the_mounting(command, real, calibrated, tmp_path):
    lines = [f"{name} = {{ id = {i} }}" for i, name in enumerate(PLACEMENTS)]
    words = json.loads(calibrated.read_text())["sensors"]["head"]["mounting"]
    opposite = {"up": "down", "down": "up", "left": "right", "right": "left", "forward": "back"}
    axes = [part.split() for part in words.split(", ")]
    other = ", ".join(f"{axis} {opposite.get(way, 'forward')}" for axis, way in axes)
    lines[4] = f'head = {{ id = 4, mounting = "{other}" }}'
    (tmp_path / "map.toml").write_text("\n".join(lines))
    flags = ("--file", real, "--calibration", calibrated, "--sensors", tmp_path / "map.toml")
    for command_words in (("run", "--model", "rnn", "--csv", "/dev/null"), ("check",)):
        assert f"head is mounted {words}" in command(*command_words, *flags).stderr


def test_other_devices_are_told(calibrated):
    calibration = load_calibration(calibrated)
    noted = {name: Device("native", "/dev/ttyUSB0", i)._asdict() for i, name in enumerate(PLACEMENTS)}
    made = replace(calibration, metadata={"devices": noted})
    same = {i: Device("native", "/dev/ttyUSB0", i) for i in range(6)}
    assert other_devices(made, same) == []
    assert other_devices(calibration, same) == []  # unknown
    assert other_devices(made, {i: device._replace(line=None) for i, device in same.items()}) == []
    (line,) = other_devices(made, same | {2: Device("native", "/dev/ttyUSB0", 7)})
    assert "left_lower_leg was native id 2 on /dev/ttyUSB0 and is native id 7 on /dev/ttyUSB0" in line
    (line,) = other_devices(made, {i: device._replace(protocol="xsens") for i, device in same.items()})
    assert "left_forearm was native id 0 on /dev/ttyUSB0 and is xsens id 0" in line
    assert "(and 5 others)" in line
    assert "ttyUSB1" in other_devices(made, {0: Device("native", "/dev/ttyUSB1", 0)})[0]


@pytest.mark.parametrize(
    "noted", [1, [], {"head": 2}, {"head": {"protocol": 1}}, {"head": {"id": "a"}}, None]
)
def test_devices_that_somebody_has_edited(calibrated, noted):
    made = replace(load_calibration(calibrated), metadata={"devices": noted})
    assert other_devices(made, {4: Device("native", "a", 1)}) == []


def capture(wearer, path: Path) -> None:
    """Writes the wearer's recording as a capture of native packets."""
    from firmware_protocols.native import encode
    from firmware_protocols.native_packet import Packet

    recording, data = read_recording(wearer.recording), b""
    for row, time_s in enumerate(recording.sensors["head"].time_s):
        for i, name in enumerate(PLACEMENTS):
            own = recording.sensors[name]
            data += encode(Packet(i, row, int(time_s * 1e6), tuple(own.quat[row]), tuple(own.acc[row])))
    path.write_bytes(data)


def test_a_capture_keeps_its_devices(command, wearer, tmp_path):
    """From calibrate to run: the protocol and ids of a log go with the calibration."""
    capture(wearer, tmp_path / "a.bin")
    calibration = tmp_path / "c.json"
    flags = ("--body-frame", "heading:0", "--from", 1, "--out", calibration)
    result = command("calibrate", "--file", tmp_path / "a.bin", "--protocol", "native", *flags)
    assert result.returncode == 0, result.stderr
    devices = json.loads(calibration.read_text())["metadata"]["devices"]
    assert devices["head"] == {"protocol": "native", "line": None, "id": 4}
    order = [1, 0, 2, 3, 4, 5]
    lines = "\n".join(f"{name} = {{ id = {i} }}" for name, i in zip(PLACEMENTS, order, strict=True))
    (tmp_path / "map.toml").write_text(lines)
    flags = ("--file", tmp_path / "a.bin", "--protocol", "native", "--sensors", tmp_path / "map.toml")
    for command_words in (("run", "--model", "rnn", "--csv", "/dev/null"), ("check",)):
        result = command(*command_words, *flags, "--calibration", calibration)
        assert "left_forearm was native id 0 and is native id 1 (and 1 others)" in result.stderr


# --- parts --------------------------------------------------------------------------------------------------


def test_bones_in_every_pose_of_a_body_are_possible():
    for pose in POSES.values():
        assert impossible_bones(pose) == []
    bones = POSES["straight"].copy()
    about_x = rot.rotation_about_axis("x", np.radians(150.0))  # a heel at the buttock
    bones[PLACEMENTS.index("left_lower_leg")] = about_x
    assert impossible_bones(bones) == []
    lying = rot.rotation_about_axis("x", np.radians(-90.0)) @ bones
    assert impossible_bones(lying) == []


def test_bones_that_no_body_has():
    bones = POSES["straight"].copy()
    bones[PLACEMENTS.index("head")] = rot.rotation_about_axis("x", np.radians(170.0))
    bones[PLACEMENTS.index("right_lower_leg")] = rot.rotation_about_axis("y", np.radians(180.0))
    assert sorted(impossible_bones(bones)) == ["head", "right_lower_leg"]


def frames(calibration, poses, seconds, rate=60.0, start=0):
    """Frames of a wearer who holds a pose (6, 3, 3) as this calibration sees it."""
    r_it = rot.quat_to_matrix(calibration.body_from_inertial).T
    quats = rot.matrix_to_quat(r_it @ poses @ rot.quat_to_matrix(calibration.bone_from_sensor))
    for i in range(int(seconds * rate)):
        held = np.zeros(6, bool)
        yield ImuFrame(start + i, (start + i) / rate, quats, np.tile([0.0, 0.0, 9.81], (6, 1)), held, 0.0)


def test_who_sits_at_first_and_stands_later(calibrated):
    """Arms in the lap are no foreign calibration; nor is a wearer who finds the pose later on."""
    calibration = load_calibration(calibrated)
    sitting = POSES["straight"].copy()
    for i in (0, 1):
        sitting[i] = rot.rotation_about_axis("x", np.radians(-50.0)) @ sitting[i]
    misfits = MisfitDetector(calibration)
    lines = [line for frame in frames(calibration, sitting, 25) for line in misfits.update(frame, sitting)]
    assert lines + misfits.at_end() == []


def test_an_impossible_bone_is_told_once(calibrated):
    calibration = load_calibration(calibrated)
    bones = POSES["straight"].copy()
    bones[PLACEMENTS.index("head")] = rot.rotation_about_axis("x", np.radians(170.0))
    misfits = MisfitDetector(calibration)
    lines = [
        line for frame in frames(calibration, POSES["straight"], 60) for line in misfits.update(frame, bones)
    ]
    assert len(lines) == 1
    assert lines[0].startswith("warning: head: turned against the pelvis as no body can turn")


def test_forearms_that_bend_backwards(calibrated):
    """Left and right forearm exchanged, both worn with X up, Z out: in the pose all is well."""
    bones = exercises(60.0)[:, list(BONES)]
    half_turn = rot.rotation_about_axis("y", np.pi)
    pose = POSES["straight"]
    exchanged = bones.copy()
    for own, other in ((0, 1), (1, 0)):
        exchanged[:, own] = half_turn @ bones[:, other] @ pose[other].T @ half_turn.T @ pose[own]
    assert fit_pose(
        load_calibration(calibrated),
        next(iter(frames(load_calibration(calibrated), exchanged[0], 1))).orientation,
    ).good

    def reported(motion):
        impossible = ImpossibleBones()
        found = [
            impossible.update(instant, [False] * 6, 0.5) for instant in np.tile(motion, (4, 1, 1, 1))[::30]
        ]
        return [name for each in found for name in each]

    assert reported(bones) == []
    assert sorted(reported(exchanged)) == ["left_forearm", "right_forearm"]


def test_headings_that_are_reset_do_not_tell_left_from_right(calibrated):
    """Without a common north only tilts are worth something."""
    calibration = load_calibration(calibrated)
    away = replace(calibration, north=False)
    quats = next(iter(frames(calibration, POSES["straight"], 1))).orientation
    turned = rot.quat_multiply(rot.quat_about_z(np.radians([0.0, 90.0, 0.0, 170.0, 0.0, 0.0])), quats)
    assert fit_pose(away, turned).sits_at is None
    assert fit_pose(away, turned).good


def test_a_calm_run_keeps_few_frames(calibrated):
    calibration = load_calibration(calibrated)
    misfits = MisfitDetector(calibration)
    for frame in frames(calibration, POSES["t-pose"], 120):
        misfits.update(frame, POSES["t-pose"])
    assert isinstance(misfits._frames, deque)
    assert len(misfits._frames) < 120


def test_run_and_check_judge_a_rig_that_lacks_a_sensor(command, real, calibrated, tmp_path):
    """By the others: nothing as it is, and two sensors that are exchanged."""
    document = json.loads(calibrated.read_text())
    del document["sensors"]["head"]
    (tmp_path / "five.json").write_text(json.dumps(document | {"without": ["head"]}))
    for pairs in ([], [("left_forearm", "left_lower_leg")]):
        recording = read_recording(exchanged(real, tmp_path, pairs))
        write_npz(
            tmp_path / "five.npz",
            Recording(dict(list(recording.sensors.items())[:4] + list(recording.sensors.items())[5:]), {}),
        )
        warnings, table, code = told(command, tmp_path / "five.npz", tmp_path / "five.json")
        moved = {name for pair in pairs for name in pair}
        assert set(re.findall(r"(\w+) is where", " ".join(warnings))) == moved
        assert set(re.findall(r"^(\w+): it is where", table, re.MULTILINE)) == moved
        assert code == (3 if moved else 0), table


def test_two_sensors_on_one_limb(calibrated):
    """Both shins' sensors on the right one, strapped at another angle; half of the steps are calm."""
    made, rng = load_calibration(calibrated), np.random.default_rng(0)
    turns = rng.normal(scale=0.4, size=(120, 6, 3))
    turns[::2] = 0.0
    walking = rot.matrix_to_quat(rot.rotvec_to_matrix(turns))
    strapped = np.array([0.6, 0.0, 0.8, 0.0])
    for shared in (False, True):
        if shared:
            flesh = rot.matrix_to_quat(rot.rotvec_to_matrix(rng.normal(scale=0.03, size=(120, 3))))
            walking[:, 2] = rot.quat_multiply(rot.quat_multiply(walking[:, 3], flesh), strapped)
        detector, lines = MisfitDetector(made), []
        for k, quats in enumerate(walking):
            frame = ImuFrame(k, k / 2.0, quats, np.zeros((6, 3)), np.zeros(6, bool), k / 2.0)
            lines += detector.update(frame, POSES["straight"])
        found = [line for line in lines if "one limb" in line]
        assert [line.split(" move ")[0] for line in found] == (
            ["warning: left_lower_leg and right_lower_leg"] if shared else []
        )


def test_two_still_limbs_are_not_one_limb_while_others_are_unknown(calibrated):
    """Someone who stands and works: the pelvis, which is silent, would turn with neither leg."""
    made, rng = load_calibration(calibrated), np.random.default_rng(0)
    turns = rng.normal(scale=0.4, size=(120, 6, 3))
    turns[:, 2:4] = 0.0
    held = np.isin(PLACEMENTS, ["pelvis"])
    detector, lines = MisfitDetector(made), []
    for k, quats in enumerate(rot.matrix_to_quat(rot.rotvec_to_matrix(turns))):
        frame = ImuFrame(k, k / 2.0, quats, np.zeros((6, 3)), held, k / 2.0)
        lines += detector.update(frame, POSES["straight"])
    assert not [line for line in lines if "one limb" in line]
