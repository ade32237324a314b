"""Sensors that send no orientation, from end to end: simulated chips, calibration, poses, a live run."""

from __future__ import annotations

import contextlib
import os
import pty
import signal
import socket
import subprocess
import sys
import termios
import threading
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from click.testing import CliRunner, Result

from edgepose import rotations as rot
from edgepose.analysis.metrics import joint_angle_error
from edgepose.calibration import EXERCISE_S, ROUTINE, load_calibration
from edgepose.cli.commands.calibrate import calibrate
from edgepose.diagnostics.rules import diagnose
from edgepose.diagnostics.sensor_health import SensorHealthMonitor
from edgepose.errors import EdgeposeError
from edgepose.formats.poses.registry import read_poses
from edgepose.formats.recordings.base import iter_samples
from edgepose.formats.recordings.npz import write_npz
from edgepose.formats.recordings.registry import read_recording
from edgepose.imu import Recording
from edgepose.placements import PLACEMENTS
from edgepose.skeleton import local_from_global
from edgepose_export.mocap import read_motion, resample
from edgepose_export.mocap.zeroing import Evidence, find_zero
from edgepose_export.synthesis.heading_routine import with_exercises
from tests.support import processes
from tests.support.datagrams import free_address
from tests.support.recordings import part, write_part
from tests.support.terminals import own_terminal

SIMULATOR = Path(__file__).parents[3] / "tools" / "simulate.py"
CLIP = SIMULATOR.parent / "data" / "09_12.bvh"
STAND_S, CLIP_S = 6.0, 6.0 + len(ROUTINE) * EXERCISE_S + 3.0


class Rig(NamedTuple):
    """A recording of chips without a filter, a calibration from it, and what was said meanwhile."""

    raw: Path
    calibration: Path
    said: str


def simulate(*words: object) -> None:
    processes.run([sys.executable, str(SIMULATOR), str(CLIP), *map(str, words)], check=True, timeout=120)


def calibrated(*words: object) -> Result:
    return CliRunner().invoke(calibrate, [str(word) for word in words])


@pytest.fixture(scope="module")
def rig(tmp_path_factory) -> Rig:
    """3 s of standing, the exercises, 2 s of standing, and 5 s of the clip."""
    folder = tmp_path_factory.mktemp("raw")
    simulate("--exercises", "--mounting", 7, "--raw", 6, "--write", folder / "whole.npz")
    raw = write_part(folder / "whole.npz", STAND_S - 3.0, CLIP_S + 5.0, folder / "raw.npz")
    result = calibrated(
        *("--file", raw, "--filter", "kalman", "--from", STAND_S - 2.5, "--hold", 2.4),
        *("--heading-reset", "motion", "--motion", "6:26", "--out", folder / "calibration.json"),
    )
    assert result.exit_code == 0, result
    assert result.stderr == ""
    return Rig(raw, folder / "calibration.json", result.stdout)


def true_poses(time_s: np.ndarray) -> np.ndarray:
    """Local rotations (T, 24, 3, 3) of the simulated wearer."""
    clip = read_motion(CLIP)
    straight = find_zero(Evidence.of(clip)).applied(resample(clip, 100.0))
    motion = with_exercises(straight, STAND_S)
    return local_from_global(motion.rotations[np.round(time_s * 100).astype(int)])


# --- recordings ---------------------------------------------------------------------------------------------


def test_the_calibration_says_how_it_was_made(rig):
    calibration = load_calibration(rig.calibration)
    assert (calibration.filter, calibration.north) == ("kalman", False)
    assert calibration.body_frame == "heading:0"
    errors = calibration.metadata["heading_reset"]["error_deg"]
    assert list(errors) == list(PLACEMENTS)
    assert max(errors.values()) < 5.0
    assert "its error" in rig.said


def test_poses_from_raw_samples_are_true(command, rig, tmp_path):
    """Ideal sensors give 7 degrees; see tools/bench_raw.py."""
    poses = tmp_path / "poses.csv"
    words = ("--calibration", rig.calibration, "--model", "rnn", "--csv", poses)
    result = command("run", "--file", rig.raw, *words)
    assert result.returncode == 0, result.stderr
    assert "warning" not in result.stderr
    _, time_s, found = read_poses(poses)[:3]
    moving = time_s >= CLIP_S
    assert joint_angle_error(found[moving], true_poses(time_s[moving])).mean() < 9.0


@pytest.mark.parametrize("words", [("run", "--csv", os.devnull), ("check",)], ids=" ".join)
@pytest.mark.parametrize("other", ["none", "vqf"])
def test_another_filter_is_refused(command, rig, words, other):
    flags = ("--file", rig.raw, "--calibration", rig.calibration, "--filter", other)
    result = command(*words, *flags)
    assert result.returncode == 1
    assert f"made with --filter kalman, and this run has --filter {other}: headings would" in result.stderr


def test_check_compares_raw_sensors_by_gravity(rig):
    """Without orientations, the tilt of every sensor at rest is known all the same."""
    recording = part(read_recording(rig.raw), 3.0, 6.0)
    calibration = load_calibration(rig.calibration)

    def findings(sensors: dict) -> dict[str, str]:
        monitor = SensorHealthMonitor(calibration)
        monitor.add(iter_samples(Recording(sensors, {})))
        return {row.placement: diagnose(row).name for row in monitor.report(6.0)}

    assert set(findings(recording.sensors).values()) == {"ok, raw"}
    exchanged = recording.sensors | {
        "head": recording.sensors["pelvis"],
        "pelvis": recording.sensors["head"],
    }
    found = findings(exchanged)
    assert {name for name, finding in found.items() if finding == "placement"} == {"head", "pelvis"}


def test_a_calibration_from_another_recording_is_told(command, rig, tmp_path):
    other = write_part(rig.raw, STAND_S, STAND_S + 2.0, tmp_path / "other.npz")
    words = ("--calibration", rig.calibration, "--filter", "kalman", "--model", "rnn")
    result = command("run", "--file", other, *words, "--csv", tmp_path / "x.csv")
    assert result.returncode == 0, result.stderr
    assert f"warning: the calibration was made from {rig.raw}, and headings of a filter" in result.stderr


def test_without_a_filter_the_message_names_it(command, rig, wearer, tmp_path):
    text = str(calibrated("--file", rig.raw, "--out", tmp_path / "x.json").exception)
    assert "no orientation from left_forearm, " in text
    assert text.endswith("--filter kalman")
    result = command(
        "run", "--file", rig.raw, "--calibration", wearer.calibration, "--csv", tmp_path / "x.csv"
    )
    assert result.returncode == 1
    assert result.stderr.endswith(
        "or compute it here from gyroscope and accelerometer: calibrate with --filter kalman\n"
    )


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ((), "headings are arbitrary: add --heading-reset steps, motion, live or mounting"),
        (
            ("--heading-reset", "RAW"),
            "with arbitrary headings, which another recording cannot reset",
        ),
        (
            ("--heading-reset", "motion", "--motion", "4:6"),
            "no heading from this motion: left_forearm leaned",
        ),
        (("--heading-reset", "mounting"), "needs --sensors MAP.toml with a mounting for each sensor"),
        (("--heading-reset", "mounting:z"), "axis z does not face forward: "),
    ],
)
def test_calibrations_that_would_be_wrong_are_refused(rig, tmp_path, words, says):
    words = [str(rig.raw) if word == "RAW" else word for word in words]
    out = tmp_path / "x.json"
    held = ("--file", rig.raw, "--filter", "kalman", "--from", 3.5, "--hold", 2)
    result = calibrated(*held, *words, "--out", out)
    assert isinstance(result.exception, EdgeposeError)
    assert says in str(result.exception)
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ((), "no orientation from left_forearm, right_forearm, left_lower_leg"),
        (("--filter", "kalman"), "headings are arbitrary: add --heading-reset steps, motion"),
    ],
)
def test_a_live_wearer_hears_at_once_what_is_missing(rig, tmp_path, monkeypatch, words, says):
    """Nobody has to stand still for a calibration that cannot be made."""
    monkeypatch.setattr("edgepose.cli.calibration_session.LISTEN_S", 0.2)
    result = calibrated("--file", rig.raw, "--realtime", *words, "--out", tmp_path / "c.json")
    assert says in str(result.exception)
    assert "All six sensors report." in result.output
    assert "The hold starts" not in result.output


def test_magnetometers_give_a_north_and_make_a_reset_needless(command, tmp_path):
    short, out = tmp_path / "short.npz", tmp_path / "calib.json"
    simulate("--raw", 9, "--write", tmp_path / "whole.npz")
    write_part(tmp_path / "whole.npz", 0.0, 6.0, short)
    held = ("--file", short, "--filter", "kalman", "--from", 2, "--hold", 3)
    result = calibrated(*held, "--body-frame", "heading:0", "--out", out)
    assert result.exit_code == 0, result
    calibration = load_calibration(out)
    assert calibration.north
    # Along the bones they were strapped on.
    angles = rot.geodesic_angle(rot.quat_to_matrix(calibration.bone_from_sensor), np.eye(3))
    assert np.degrees(angles).max() < 8.0
    result = calibrated(*held, "--no-mag", "--out", tmp_path / "other.json")
    assert "headings are arbitrary" in str(result.exception)
    words = ("--calibration", out, "--file", short)
    result = command("run", *words, "--no-mag", "--csv", tmp_path / "x.csv")
    assert result.returncode == 1
    assert "made with magnetometers: leave --no-mag out" in result.stderr
    six_axes = read_recording(short)
    for name, data in six_axes.sensors.items():
        six_axes.sensors[name] = data._replace(mag=None)
    write_npz(short, six_axes)
    for more in (("run", "--model", "rnn", "--csv", os.devnull), ("check",)):
        result = command(*more, *words)
        assert "made with magnetometers, and left_forearm, right_forearm, left_lower_leg" in result.stderr


# --- live ---------------------------------------------------------------------------------------------------


class Terminal(threading.Thread):
    """A terminal; all that is written to it."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.master, self.inside = pty.openpty()
        self.screen = b""

    def run(self) -> None:
        with contextlib.suppress(OSError):  # Linux says so when the other side has closed
            while piece := os.read(self.master, 4096):
                self.screen += piece

    def wait_for(self, text: bytes, process: subprocess.Popen) -> None:
        until = time.monotonic() + 60
        while text not in self.screen:
            assert process.poll() is None, self.screen.decode()
            assert time.monotonic() < until, self.screen.decode()
            time.sleep(0.02)

    def modes(self) -> list:
        return termios.tcgetattr(self.inside)[:4]


def said(process: subprocess.Popen, word: str) -> str:
    return next(line.split()[1] for line in process.stdout if line.startswith(f"{word} "))


def test_a_live_run_begins_with_the_pose_and_re_zeroes_on_request(rig, tmp_path):
    """Standing, then four seconds of the clip; the filter begins anew, with any headings."""
    clip = write_part(rig.raw, CLIP_S - 1.5, CLIP_S + 4.0, tmp_path / "clip.npz")
    poses, terminal = tmp_path / "poses.csv", Terminal()
    address = free_address(socket.SOCK_DGRAM)
    control = ("127.0.0.1", int(address.rpartition(":")[2]))
    simulator = processes.Popen(
        [sys.executable, str(SIMULATOR), str(clip), "--stand"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    before = terminal.modes()
    run = processes.Popen(
        [sys.executable, "-m", "edgepose", "run", "--port", said(simulator, "port"), "--filter", "kalman",
         "--calibration", str(rig.calibration), "--model", "rnn", "--csv", str(poses),
         "--control", address],
        stdin=terminal.inside, stdout=terminal.inside, stderr=terminal.inside, preexec_fn=own_terminal,
    )  # fmt: skip
    terminal.start()
    try:
        terminal.wait_for(b"headings found; tilt off by left_forearm ", run)
        assert terminal.modes() != before
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(b"nonsense", control)
            while b"re-zeroed: headings turned by left_forearm " not in terminal.screen:
                sender.sendto(b"rezero", control)  # a busy machine may lose too much for one hold
                terminal.wait_for(b"re-zero now: stand straight", run)
                time.sleep(2.0)
        simulator.stdin.write("go\n")
        simulator.stdin.flush()
        begin, end = float(said(simulator, "started")), float(said(simulator, "ended"))
        os.write(terminal.master, b"xr")
        terminal.wait_for(b"re-zero in 3 s", run)
        while time.time() < end + 0.3:
            time.sleep(0.05)
        run.send_signal(signal.SIGINT)
        run.wait(60)
        assert run.returncode == 0, terminal.screen.decode()
        assert terminal.modes() == before
        assert b"control  1 datagrams without a known request" in terminal.screen
    finally:
        run.kill()
        run.wait()
        simulator.kill()
        simulator.communicate()
        os.close(terminal.inside)
        terminal.join(5)
        os.close(terminal.master)
    frames, time_s, found = read_poses(poses)[:3]
    assert frames.tolist() == list(range(frames[0], frames[0] + len(frames)))
    assert frames[0] >= 120  # those before the pose are not written
    moving = (time_s >= begin + 1.6) & (time_s <= end)
    true = true_poses(time_s[moving] - begin + CLIP_S - 1.5)
    assert moving.sum() > 200
    assert joint_angle_error(found[moving], true).mean() < 9.0


@pytest.mark.parametrize("ending", ["pass", "raise RuntimeError('a crash')", "os.kill(os.getpid(), 2)"])
def test_keys_come_at_once_and_the_terminal_is_as_before(ending):
    code = (
        "import os, time\n"
        "from edgepose.cli.terminal.keys import Keys\n"
        "with Keys() as keys:\n"
        "    print('ready', keys.listening, flush=True)\n"
        "    found = ''\n"
        "    while 'q' not in found:\n"
        "        found += keys.pressed()\n"
        "        time.sleep(0.01)\n"
        "    print('found', found, flush=True)\n"
        f"    {ending}\n"
    )
    terminal = Terminal()
    before = terminal.modes()
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=terminal.inside, stdout=terminal.inside, stderr=terminal.inside, preexec_fn=own_terminal,
    )  # fmt: skip
    terminal.start()
    try:
        terminal.wait_for(b"ready True", process)
        assert terminal.modes() != before
        os.write(terminal.master, b"r\nq")
        process.wait(30)
        assert terminal.modes() == before
    finally:
        process.kill()
        process.wait()
        os.close(terminal.inside)
        terminal.join(5)
        os.close(terminal.master)
    assert b"found r" in terminal.screen


def test_keys_without_a_terminal():
    code = (
        "from edgepose.cli.terminal.keys import Keys\n"
        "with Keys() as keys: print(keys.listening, [keys.pressed()])"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60
    )
    assert result.stdout == "False ['']\n"


def test_the_control_address_is_checked(command, wearer, tmp_path):
    words = ("run", "--calibration", wearer.calibration, "--csv", tmp_path / "x.csv")
    for flags, says in (
        (("--file", wearer.short, "--control", "127.0.0.1:9000"), "--control needs live sensors"),
        (("--port", "x", "--control", "127.0.0.1"), "no port"),
        (("--port", "x", "--control", "127.0.0.1:9000,format=json"), "is more than HOST:PORT"),
    ):
        result = command(*words, *flags)
        assert result.returncode == 2, result
        assert says in result.stderr
    result = command(*words, "--file", wearer.short, "--realtime", "--control", "192.0.2.1:9000")
    assert result.returncode == 1
    assert "cannot listen on 192.0.2.1 port 9000" in result.stderr
