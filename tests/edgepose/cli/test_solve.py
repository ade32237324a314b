"""`edgepose solve` from the command line."""

import os
import pickle
import re
import signal
import sys
import time

import numpy as np
import pytest

from edgepose.analysis import metrics
from edgepose.formats.poses.registry import read_poses
from edgepose.formats.recordings.base import iter_samples
from edgepose.formats.recordings.csv import write_csv
from edgepose.formats.recordings.npz import write_npz
from edgepose.formats.recordings.raw_capture import times_header, times_path, times_row
from edgepose.formats.recordings.registry import read_recording
from edgepose.imu import Recording, SensorData
from edgepose.rotations import rotvec_to_matrix
from edgepose.skeleton import default_body, forward_kinematics
from firmware_protocols import native
from firmware_protocols.native_packet import Packet
from tests.support import processes

PLAIN = ("--evaluations", 12, "--prior", "default")


def moving_part(wearer, tmp_path, **changes):
    """The wearer's three short seconds with some sensors changed; None leaves a sensor out."""
    whole = read_recording(wearer.short)
    sensors = {name: changes.get(name, data) for name, data in whole.sensors.items()}
    path = tmp_path / "part.npz"
    write_npz(path, Recording({n: d for n, d in sensors.items() if d is not None}, {}))
    return path


def test_solve_writes_poses_path_and_picture(command, wearer, tmp_path):
    files = {kind: tmp_path / f"poses.{kind}" for kind in ("csv", "npz", "bvh")}
    outputs = [word for kind, file in files.items() for word in (f"--{kind}", file)]
    result = command(
        *("solve", wearer.recording, "--calibration", wearer.calibration, *PLAIN),
        *(*outputs, "--plot", tmp_path / "fit.png"),
    )
    assert result.returncode == 0, result.stderr
    assert "cost a frame  ori " in result.stderr
    assert "left_lower_leg" in result.stderr
    assert "720 of 720 poses" in result.stderr
    assert "does not fit" not in result.stderr
    poses = read_poses(files["csv"])
    assert poses.rotations.shape == (720, 24, 3, 3)
    assert set(poses.status) == {"ok"}
    np.testing.assert_allclose(poses.translation[0], [0.0, 0.93, 0.0], atol=0.1)
    assert np.linalg.norm(poses.translation[-1] - poses.translation[0]) > 1.0
    again = read_poses(files["npz"])
    np.testing.assert_allclose(again.rotations, poses.rotations, atol=1e-5)
    np.testing.assert_allclose(again.translation, poses.translation, atol=1e-5)
    assert files["bvh"].read_text().startswith("HIERARCHY")
    assert (tmp_path / "fit.png").read_bytes().startswith(b"\x89PNG")


def test_sip_is_nearer_than_sop(command, wearer, tmp_path):
    synthesized = np.load(wearer.recording.parent / "whole" / "09_12.npz")
    errors = {}
    for method in ("sip", "sop"):
        out = tmp_path / f"{method}.csv"
        result = command(
            *("solve", wearer.short, "--calibration", wearer.calibration, "--method", method, "--csv", out),
            *("--rate", 100, "--prior", "default"),
        )
        assert result.returncode == 0, result.stderr
        poses = read_poses(out)
        rows = np.searchsorted(synthesized["t"], poses.time_s - 1e-6)
        true = rotvec_to_matrix(synthesized["poses"][rows].reshape(-1, 24, 3).astype(float))
        errors[method] = metrics.sip_error(poses.rotations, true).mean()
    assert errors["sip"] < errors["sop"]


def test_a_network_is_the_prior_unless_another_is_named(command, wearer, tmp_path):
    synthesized = np.load(wearer.recording.parent / "whole" / "09_12.npz")
    errors, frames = {}, {}
    for name, rate, words in (
        ("network", 60, ()),
        ("resampled", 50, ("--prior", "birnn")),
        ("statistics", 60, ("--prior", "default")),
    ):
        out = tmp_path / f"{name}.csv"
        result = command(
            *(
                "solve",
                wearer.short,
                "--calibration",
                wearer.calibration,
                "--csv",
                out,
                "--rate",
                rate,
                *words,
            )
        )
        assert result.returncode == 0, result.stderr
        poses = read_poses(out)
        rows = np.clip(np.searchsorted(synthesized["t"], poses.time_s), 0, len(synthesized["t"]) - 1)
        true = rotvec_to_matrix(synthesized["poses"][rows].reshape(-1, 24, 3).astype(float))
        errors[name] = metrics.sip_error(poses.rotations, true).mean()
        frames[name] = len(rows)
    assert errors["network"] < 0.9 * errors["statistics"]
    assert errors["resampled"] < 0.95 * errors["statistics"]
    assert frames == {"network": 180, "resampled": 150, "statistics": 180}
    assert "contact_left_ankle" in (tmp_path / "network.csv").read_text().splitlines()[0]


def test_without_all_six_sensors_the_prior_is_statistical(command, wearer, tmp_path):
    part = moving_part(wearer, tmp_path, head=None)
    words = ("solve", part, "--calibration", wearer.calibration, "--csv", tmp_path / "o.csv", "--overwrite")
    result = command(*words, "--evaluations", 4)
    assert result.returncode == 0, result.stderr
    assert result.stderr.splitlines()[0] == (
        "no accelerations of head: the prior is the statistical one, not a network"
    )
    assert "--prior rnn needs the accelerations of head; use --prior default" in one_line(
        command(*words, "--prior", "rnn")
    )
    for other in (("--method", "sop"), ("--body", "hinges")):
        assert "takes no network as its prior: leave out --prior rnn" in one_line(
            command(*words, "--prior", "rnn", *other)
        )
    assert "brnn: no such model" in one_line(command(*words[:1], wearer.short, *words[2:], "--prior", "brnn"))


def test_bodies_of_every_kind(command, wearer, tmp_path):
    part = moving_part(wearer, tmp_path)
    model = tmp_path / "model.pkl"
    zero = np.tile(np.eye(3), (24, 1, 1))
    model.write_bytes(pickle.dumps({"J": forward_kinematics(zero, default_body().offsets)[1]}))
    for words in (
        ("--body", "hinges"),
        ("--body", model),
        ("--height", 1.9, "--sex", "male", "--weight", 95, "--words", "long-legged,broad-shouldered"),
        ("--scale", 1.1, "--weights", "mahal=0.001,acc=0.1"),
    ):
        out = tmp_path / "poses.csv"
        result = command(
            *("solve", part, "--calibration", wearer.calibration, "--csv", out, "--overwrite"),
            *("--evaluations", 4, "--prior", "default", *words),
        )
        assert result.returncode == 0, (words, result.stderr)
        assert len(read_poses(out).rotations) == 180


def test_four_sensors_will_do(command, wearer, tmp_path):
    part = moving_part(wearer, tmp_path, head=None, right_forearm=None)
    result = command("solve", part, "--calibration", wearer.calibration, "--csv", "-", *PLAIN)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("frame,time_s,status,pelvis_x")
    assert len(result.stdout.splitlines()) == 181


def test_a_sensor_that_falls_silent_is_held(command, wearer, tmp_path):
    head = read_recording(wearer.short).sensors["head"]
    rows = (head.time_s < 6.5) | (head.time_s > 7.5)
    part = moving_part(wearer, tmp_path, head=SensorData(*(None if c is None else c[rows] for c in head)))
    out = tmp_path / "poses.csv"
    result = command("solve", part, "--calibration", wearer.calibration, "--csv", out, *PLAIN)
    assert result.returncode == 0, result.stderr
    poses = read_poses(out)
    held = np.array([status == "held head" for status in poses.status])
    assert 58 <= held.sum() <= 62
    assert (np.abs(poses.time_s[held] - 7.0) < 0.52).all()


@pytest.mark.parametrize("number", ["nan", "inf", "1e30"])
def test_numbers_that_are_none_are_told(command, wearer, tmp_path, number):
    path = tmp_path / "part.csv"
    write_csv(path, read_recording(wearer.short))
    lines = path.read_text().splitlines()
    cells = lines[40].split(",")
    cells[6] = number
    lines[40] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n")
    out = tmp_path / "poses.csv"
    result = command("solve", path, "--calibration", wearer.calibration, "--csv", out, *PLAIN)
    assert result.returncode == 1
    assert "row 41" in result.stderr
    assert "NaN or absurd" in result.stderr
    assert len(read_poses(out).frames) == 180, "a bad row costs only itself"


def test_a_raw_capture_is_solved_like_a_recording(command, wearer, tmp_path):
    """The bytes of a port, with their arrival times."""
    samples = list(iter_samples(read_recording(wearer.short)))
    data = [
        native.encode(Packet(s.sensor, k // 6, int(s.time_s * 1e6), s.quat, s.acc))
        for k, s in enumerate(samples)
    ]
    ends = np.cumsum([len(packet) for packet in data])
    capture = tmp_path / "walk.bin"
    capture.write_bytes(b"".join(data))
    rows = [times_row(1.7e9 + s.time_s, int(end)) for s, end in zip(samples, ends, strict=True)]
    times_path(capture).write_text(times_header({}) + "".join(rows))
    result = command(
        "solve", capture, "--calibration", wearer.calibration, "--csv", tmp_path / "a.csv", *PLAIN
    )
    assert result.returncode == 0, result.stderr
    result = command(
        "solve", wearer.short, "--calibration", wearer.calibration, "--csv", tmp_path / "b.csv", *PLAIN
    )
    assert result.returncode == 0, result.stderr
    found, wanted = (read_poses(tmp_path / name) for name in ("a.csv", "b.csv"))
    np.testing.assert_allclose(found.time_s - 1.7e9, wanted.time_s, atol=1e-3)
    np.testing.assert_allclose(found.rotations, wanted.rotations, atol=0.02)


def one_line(result):
    assert result.returncode == 1
    line = result.stderr.strip()
    assert "\n" not in line
    return line


def test_what_cannot_be_solved_is_told_in_one_line(command, wearer, tmp_path):
    def solve(part, *words):
        return one_line(
            command("solve", part, "--calibration", wearer.calibration, "--csv", tmp_path / "o.csv", *words)
        )

    few = moving_part(wearer, tmp_path, **dict.fromkeys(("head", "pelvis", "left_forearm", "right_forearm")))
    assert "2 sensors (left_lower_leg, right_lower_leg) are too few" in solve(few)
    whole = read_recording(wearer.short).sensors
    still = {name: data._replace(acc=None) for name, data in whole.items()}
    assert "no sensor has accelerations, which sip needs; use --method sop" in solve(
        moving_part(wearer, tmp_path, **still)
    )
    empty = tmp_path / "empty.csv"
    write_csv(empty, Recording({}, {}))
    assert "the recording has no samples" in solve(empty)
    assert "cannot read it" in solve(tmp_path / "none.npz")
    part = moving_part(wearer, tmp_path)
    assert "unknown word 'tall' for a shape: use some of long-legged" in solve(part, "--words", "tall")
    assert "give the wearer's weight in kilograms" in solve(part, "--weight", 500)
    broken = tmp_path / "prior.npz"
    broken.write_bytes(b"PK")
    assert "not a prior of poses" in solve(part, "--prior", broken)


def test_one_frame_is_solved(command, wearer, tmp_path):
    one = {
        name: SensorData(*(None if c is None else c[150:151] for c in data))
        for name, data in read_recording(wearer.short).sensors.items()
    }
    part = moving_part(wearer, tmp_path, **one)
    out = tmp_path / "poses.csv"
    result = command("solve", part, "--calibration", wearer.calibration, "--csv", out, *PLAIN)
    assert result.returncode == 0, result.stderr
    assert len(read_poses(out).rotations) == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "at least one output"),
        (("--csv", "IN"), "--csv would overwrite"),
        (("--csv", "-", "--weights", "speed=1"), "is not NAME=NUMBER"),
        (("--csv", "-", "--weights", "acc=-1"), "is not NAME=NUMBER"),
        (("--csv", "-", "--body", "me.pkl", "--height", "1.8"), "a body from a file has its own shape"),
        (("--csv", "-", "--body", "me.pkl", "--leg-length", "0.9"), "a body from a file has its own shape"),
    ],
)
def test_wrong_use(command, wearer, tmp_path, words, message):
    part = moving_part(wearer, tmp_path)
    words = [str(part) if word == "IN" else word for word in words]
    result = command("solve", part, "--calibration", wearer.calibration, *words)
    assert result.returncode == 2
    assert message in " ".join(result.stderr.split())


@pytest.mark.parametrize(("jobs", "prior"), [(1, "birnn"), (2, "default")])
def test_ctrl_c_keeps_what_is_done(wearer, tmp_path, jobs, prior):
    long = read_recording(wearer.recording).sensors
    # Twelve seconds again and again: many chunks.
    repeated = {
        name: SensorData(
            *(
                None if c is None else np.concatenate([c + 12.0 * k if c.ndim == 1 else c for k in range(15)])
                for c in data
            )
        )
        for name, data in long.items()
    }
    path, out = tmp_path / "long.npz", tmp_path / "poses.csv"
    write_npz(path, Recording(repeated, {}))
    words = [sys.executable, "-m", "edgepose", "solve", path, "--calibration", wearer.calibration]
    words += ["--csv", out, "--jobs", jobs, "--evaluations", 6, "--prior", prior]
    master, slave = os.openpty()  # a terminal, on which progress shows
    process = processes.Popen([str(word) for word in words], stderr=slave, start_new_session=True)
    os.close(slave)
    seen = b""
    until = time.monotonic() + 100.0
    while not re.search(rb"chunk ([2-9]|1\d) of", seen) and time.monotonic() < until:
        seen += os.read(master, 4096)
    assert b"cost 0." in seen
    assert b"s left" in seen
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    rest = b""
    try:
        while chunk := os.read(master, 4096):
            rest += chunk
    except OSError:  # how a terminal says that the other end is closed
        pass
    os.close(master)
    assert process.wait(60) == 130
    assert b"Traceback" not in rest
    poses = read_poses(out)
    assert 700 <= len(poses.rotations) < 10_000  # a chunk at least
    assert re.search(rf"{len(poses.rotations)} of \d+ poses", (seen + rest).decode())
