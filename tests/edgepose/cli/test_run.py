"""`edgepose run` as its users run it: on recordings, and live on a pty with native packets."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import random
import re
import resource
import signal
import socket
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from edgepose import rotations as rot
from edgepose.calibration import apply_calibration, load_calibration
from edgepose.formats.poses.registry import read_poses
from edgepose.formats.recordings.base import iter_samples
from edgepose.formats.recordings.csv import write_csv
from edgepose.formats.recordings.registry import read_recording
from edgepose.inference import archive
from edgepose.pipeline.frame_synchronizer import FrameSynchronizer
from edgepose.placements import PLACEMENTS
from edgepose.sinks.udp import decode_binary
from edgepose.skeleton import JOINTS, global_rotations
from firmware_protocols import native_can
from firmware_protocols.native import encode
from firmware_protocols.native_packet import Packet
from tests.support import limits, processes
from tests.support.datagrams import Listener, free_address
from tests.support.ports import Port, Sender
from tests.support.processes import end, simulated, start
from tests.support.terminals import ended, own_terminal, rest_of

BONES = [18, 19, 4, 5, 15, 0]  # those with the sensors, in the order of PLACEMENTS


def whole(path: Path) -> tuple[np.ndarray, np.ndarray, list[str], np.ndarray]:
    """Frames, times, status and rotations of a CSV of poses, after the checks that every run must pass."""
    assert path.read_bytes().endswith(b"\n")
    read = read_poses(path)
    frames, time_s, status, rotations = read.frames, read.time_s, read.status, read.rotations
    assert frames.tolist() == list(range(len(frames)))
    np.testing.assert_allclose(time_s, time_s[0] + frames / 60.0, atol=1.1e-6)
    unit = np.eye(3)
    assert np.abs(rotations @ rotations.swapaxes(-1, -2) - unit).max() < 1e-5
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-5)
    return frames, time_s, status, rotations


def numbers(path: Path) -> list[list[str]]:
    return [line.split(",") for line in path.read_text().splitlines()]


def calibrated(wearer, file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Times (T,) and measured bones (T, 6, 3, 3) of a recording."""
    calibration = load_calibration(wearer.calibration)
    clock = FrameSynchronizer()
    clock.push(iter_samples(read_recording(file)), 0.0)
    frames = clock.flush()
    bones = [apply_calibration(calibration, f.orientation, f.force)[0] for f in frames]
    return np.array([f.time_s for f in frames]), np.array(bones)


def last_line(text: str) -> str:
    assert "Traceback" not in text
    return text.splitlines()[-1]


# --- recordings ---------------------------------------------------------------------------------------------


def test_a_recording_with_the_default_model(command, wearer, tmp_path):
    file = tmp_path / "poses.csv"
    with Listener() as listener:
        result = command(
            *("run", "--file", wearer.recording, "--calibration", wearer.calibration),
            *("--csv", file, "--rotations", "matrix", "--std", "--udp", listener.address),
        )
    assert result.returncode == 0, result.stderr
    frames, time_s, status, rotations = whole(file)
    assert len(frames) == 720
    past = archive.read_info(archive.find_archive("birnn")).metadata["past"]
    assert status == ["filling window"] * past + ["ok"] * (720 - past)
    assert "poses    720 in " in result.stderr
    assert f"{past} while the window was filling" in result.stderr
    assert "packets  7200 good, 0 lost, 0 bad; 0 samples too late or duplicate" in result.stderr
    # The numbers as written, before the reader makes them rotations.
    rows = numbers(file)
    written = np.array([row[3 : 3 + 216] for row in rows[1:]], float).reshape(-1, 24, 3, 3)
    assert np.abs(written @ written.swapaxes(-1, -2) - np.eye(3)).max() < 1e-5
    # Bones with sensors are measured, not guessed.
    times, bones = calibrated(wearer, wearer.recording)
    np.testing.assert_allclose(time_s, times, atol=1e-6)
    angles = rot.geodesic_angle(global_rotations(rotations)[:, BONES], bones)
    assert np.degrees(angles).max() < 0.01
    # The network is sure of what is measured or at rest and unsure of the rest.
    columns = [rows[0].index(f"{joint}_std") for joint in JOINTS]
    std = np.array([[row[i] for i in columns] for row in rows[1:]], float)
    joints = archive.read_info(archive.find_archive("birnn")).metadata["joints"]
    predicted = [JOINTS.index(name) for name in joints]
    assert (std[:, predicted] > 0).all()
    assert (np.delete(std, predicted, axis=1) == 0).all()
    # UDP says the same as the CSV.
    sent = [json.loads(datagram) for datagram in listener.datagrams]
    assert [pose["frame"] for pose in sent] == frames.tolist()
    assert [pose["status"] for pose in sent] == status
    np.testing.assert_allclose([pose["time_s"] for pose in sent], time_s, atol=1e-6)
    vectors = np.array([pose["pose"] for pose in sent]).reshape(-1, 24, 3)
    np.testing.assert_allclose(rot.rotvec_to_matrix(vectors), rotations, atol=5e-6)


def test_the_unidirectional_model_to_csv_and_binary_udp(command, wearer, tmp_path):
    file = tmp_path / "poses.csv"
    with Listener() as listener:
        result = command(
            *("run", "--file", wearer.short, "--calibration", wearer.calibration, "--model", "rnn"),
            *("--csv", file, "--rotations", "quat", "--udp", f"{listener.address},format=binary"),
        )
    assert result.returncode == 0, result.stderr
    frames, time_s, status, rotations = whole(file)
    assert len(frames) == 180
    assert status == ["ok"] * 180
    sent = [decode_binary(datagram) for datagram in listener.datagrams]
    assert [pose.index for pose in sent] == frames.tolist()
    assert [pose.status for pose in sent] == status
    np.testing.assert_allclose([pose.time_s for pose in sent], time_s, atol=1e-6)
    np.testing.assert_allclose([pose.rotations for pose in sent], rotations, atol=5e-6)


@pytest.mark.parametrize("model", ["birnn", "rnn"])
def test_weights_in_int8(wearer, tmp_path, model):
    words = ["--file", wearer.short, "--calibration", wearer.calibration, "--model", model]
    words += ["--precision", "int8"]
    # A process in which PyTorch is imported as late as for a user: the warning is switched off before that.
    result = subprocess.run(
        [sys.executable, "-m", "edgepose", "run", *words, "--npz", tmp_path / "poses.npz"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert "Warning" not in result.stderr
    assert len(read_poses(tmp_path / "poses.npz").rotations) == 180


def test_a_bidirectional_model_with_its_state_carried_on(command, wearer, tmp_path):
    file = tmp_path / "poses.csv"
    result = command(
        *("run", "--file", wearer.short, "--calibration", wearer.calibration, "--online", "stream"),
        *("--past", 7, "--future", 2, "--csv", file, "--rotations", "euler"),
    )
    assert result.returncode == 0, result.stderr
    assert "(birnn, stream)" in result.stderr
    frames, _, status, rotations = whole(file)
    assert len(frames) == 180
    assert status == ["filling window"] * 7 + ["ok"] * 173
    _, bones = calibrated(wearer, wearer.short)
    assert np.degrees(rot.geodesic_angle(global_rotations(rotations)[:, BONES], bones)).max() < 0.01


def test_standard_output_without_past_and_future(command, wearer, tmp_path):
    result = command(
        *("run", "--file", wearer.short, "--calibration", wearer.calibration, "--past", 0, "--future", 0),
        *("--csv", "-"),
    )
    assert result.returncode == 0, result.stderr
    file = tmp_path / "poses.csv"
    file.write_text(result.stdout)
    frames, _, status, _ = whole(file)
    assert len(frames) == 180
    assert status == ["ok"] * 180
    assert len(numbers(file)[1]) == 3 + 72 + 3 + 7  # rotations, translation, contacts


def test_a_run_with_and_without_the_place(command, wearer, tmp_path):
    """Without it there is nothing of it in any output, and no way; the poses are the same."""
    rows, told = {}, {}
    for flags in ((), ("--no-place",)):
        file = tmp_path / f"{len(flags)}.csv"
        with Listener() as listener:
            result = command(
                *("run", "--file", wearer.short, "--calibration", wearer.calibration, "--model", "rnn"),
                *("--std", "--csv", file, "--udp", listener.address, *flags),
            )
        assert result.returncode == 0, result.stderr
        rows[flags], told[flags] = numbers(file), result.stderr
        datagrams = [json.loads(datagram) for datagram in listener.datagrams]
        assert {"trans" in pose for pose in datagrams} == {not flags}
        assert {"contacts" in pose for pose in datagrams} == {not flags}
    whole, plain = rows.values()
    width = len(plain[0])
    assert plain[0][-1] == "right_hand_std"
    assert whole[0][width] == "trans_x"
    assert [row[:width] for row in whole] == plain
    assert "distance " not in told["--no-place",]
    (distance_m,) = re.findall(r"^distance (\d+\.\d) m walked$", told[()], re.MULTILINE)
    assert 1.0 < float(distance_m) < 4.0


def test_a_clock_that_began_anew_is_told(command, wearer, tmp_path):
    recording = read_recording(wearer.short)
    later = {name: data.time_s + 100.0 * (data.time_s > data.time_s[150]) for name, data in
             recording.sensors.items()}  # fmt: skip
    sensors = {name: data._replace(time_s=later[name]) for name, data in recording.sensors.items()}
    file = tmp_path / "gap.csv"
    write_csv(file, recording._replace(sensors=sensors))
    result = command(
        *("run", "--file", file, "--calibration", wearer.calibration, "--model", "rnn"),
        *("--csv", tmp_path / "poses.csv"),
    )
    assert result.returncode == 0, result.stderr
    assert "clock    restarted 1 times, after all sensors were silent for a minute or more" in result.stderr


def test_datagrams_that_nobody_receives_are_told(command, wearer):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as unheard:
        unheard.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{unheard.getsockname()[1]}"
    result = command(
        *("run", "--file", wearer.short, "--calibration", wearer.calibration, "--model", "rnn"),
        *("--udp", address),
    )
    assert result.returncode == 0, result.stderr
    told = re.search(rf"^udp +(\d+) datagrams did not arrive; .* {address}\?$", result.stderr, re.MULTILINE)
    assert told is not None, result.stderr
    assert 0 < int(told[1]) <= 180


def test_the_reader_of_standard_output_ends_early(wearer):
    process = start(
        *(
            "run",
            "--file",
            wearer.recording,
            "--calibration",
            wearer.calibration,
            "--model",
            "rnn",
            "--csv",
            "-",
        ),
        stdout=subprocess.PIPE,
    )
    header, first, second = (process.stdout.readline() for _ in range(3))
    process.stdout.close()
    errors = process.stderr.read()
    process.stderr.close()
    assert process.wait(60) == 1
    assert header.startswith("frame,time_s,status,pelvis_x,")
    assert [first.split(",")[0], second.split(",")[0]] == ["0", "1"]
    assert "poses    " in errors
    assert last_line(errors) == ("edgepose: the program that read the poses from standard output has ended")


def test_ctrl_c_at_a_terminal_in_the_middle_of_a_frame(wearer, tmp_path):
    """The bidirectional model is so slow that the signal nearly always comes while it works on a frame."""
    file = tmp_path / "poses.csv"
    terminal, other = pty.openpty()
    process = start(
        *("run", "--file", wearer.recording, "--calibration", wearer.calibration, "--csv", file),
        *("--online", "window", "--past", 60),
        stderr=other,
    )
    os.close(other)
    text = b""
    with ended(process, terminal):
        while b" poses, " not in text:
            text += os.read(terminal, 4096)
        process.send_signal(signal.SIGINT)
        text += rest_of(terminal)
        assert process.wait(60) == 0
    assert re.search(rb"\r\d+ poses, \d+ a second, 0 with a held sensor", text)
    frames, *_ = whole(file)
    assert 0 < len(frames) < 720
    assert f"poses    {len(frames)} in ".encode() in text


# --- damage -------------------------------------------------------------------------------------------------


def test_a_recording_cut_in_the_middle_of_a_row(command, wearer, tmp_path):
    recording, file = tmp_path / "cut.csv", tmp_path / "poses.csv"
    write_csv(recording, read_recording(wearer.short))
    lines = recording.read_bytes().splitlines(keepends=True)
    kept = lines[: len(lines) * 2 // 3]
    recording.write_bytes(b"".join(kept) + lines[len(kept)][:-20])
    result = command(
        *("run", "--file", recording, "--calibration", wearer.calibration, "--model", "rnn", "--csv", file)
    )
    assert result.returncode == 1
    frames, *_ = whole(file)
    assert len(frames) == 120
    assert "poses    120 in " in result.stderr
    good = len(kept) - 1  # the header is no sample
    text = last_line(result.stderr)
    assert text.startswith(f"edgepose: {recording}: row {good + 2} is cut off, {good} samples before it")
    assert "copy the file again" in text


def test_a_disk_that_fills_up(wearer, tmp_path):
    file = tmp_path / "poses.csv"
    limit = 60_000
    process = start(
        *(
            "run",
            "--file",
            wearer.short,
            "--calibration",
            wearer.calibration,
            "--model",
            "rnn",
            "--csv",
            file,
        ),
        preexec_fn=limits.limit(resource.RLIMIT_FSIZE, limit),
    )
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert f"cannot write poses to {file}: " in last_line(errors)
    assert "poses    " in errors
    frames, *_ = whole(file)
    assert 0 < len(frames) < 180
    assert file.stat().st_size <= limit


@pytest.mark.parametrize(
    ("target", "says"),
    [("/dev/full", "the disk is full"), ("nowhere/poses.csv", "its folder does not exist")],
)
def test_an_output_that_cannot_be_written(command, wearer, tmp_path, target, says):
    result = command(
        *("run", "--file", wearer.short, "--calibration", wearer.calibration, "--model", "rnn"),
        *("--csv", target),
        cwd=tmp_path,
    )
    assert result.returncode == 1
    assert result.stderr == last_line(result.stderr) + "\n"
    assert result.stderr.startswith(f"edgepose: cannot write poses to {target}: {says}")


def test_an_archive_that_torch_cannot_load(command, wearer, broken_archive, tmp_path):
    flags = ("--file", wearer.short, "--calibration", wearer.calibration, "--csv", tmp_path / "poses.csv")
    result = command("run", *flags, "--model", broken_archive, "--trust")
    assert result.returncode == 1
    assert result.stderr == last_line(result.stderr) + "\n"
    assert f"{broken_archive}: torch cannot load the archive" in result.stderr
    assert not (tmp_path / "poses.csv").exists()


@pytest.fixture
def broken_archive(tmp_path):
    """An archive with nothing in it but its description."""
    file = tmp_path / "model.pt"
    info = archive.read_info(archive.find_archive("rnn"))
    with zipfile.ZipFile(file, "w") as content:
        content.writestr(f"model/extra/{archive.METADATA_FILE}", json.dumps(info.metadata))
    return file


# --- live ---------------------------------------------------------------------------------------------------


class Rig(Sender):
    """Six devices on a line; each sends its row of a recording `rate` times a second, with its own count.

    Attributes:
        silent: sensors that are switched off.
        corrupt: so many of the next packets are damaged on the line, one in seven.
        noise: sent once, between two packets.
    """

    def __init__(
        self, recording: Path, wire: Callable[[Packet], bytes] = encode, rate: float = 100.0
    ) -> None:
        (self.line,) = ports = (Port(),)
        super().__init__(*ports, rate=rate)
        self._wire = wire
        self.port = self.line.name
        self.silent: set[int] = set()
        self.corrupt = 0
        self.noise = b""
        sensors = read_recording(recording).sensors.values()
        self._rows = [list(zip(s.quat.tolist(), s.acc.tolist(), strict=True)) for s in sensors]
        self._counts = [0] * len(PLACEMENTS)

    def send(self, k: int) -> None:
        t_us = int(self.elapsed_s * 1e6)
        for i, rows in enumerate(self._rows):
            if i in self.silent:
                continue
            count = self._counts[i]
            data = self._wire(Packet(i, count, t_us, *map(tuple, rows[count % len(rows)])))
            self._counts[i] += 1
            if self.corrupt and sum(self._counts) % 7 == 0:
                self.corrupt -= 1
                middle = len(data) // 2
                data = data[:middle] + bytes([data[middle] ^ 0x55 or 0x55]) + data[middle + 1 :]
            self._write(self.noise + data)
            self.noise = b""

    def _write(self, data: bytes) -> None:
        while data and not self.left.is_set():
            try:
                data = data[os.write(self.line.master, data) :]
            except BlockingIOError:  # nobody reads at the moment
                time.sleep(0.001)


@contextlib.contextmanager
def live(wearer, port: str, listener: Listener, file: Path):
    """A run on a port that has given its first pose."""
    process = start(
        *(
            "run",
            "--can" if port.startswith("slcan:") else "--port",
            port,
            "--calibration",
            wearer.calibration,
            "--model",
            "rnn",
        ),
        *("--csv", file, "--udp", listener.address),
    )
    try:
        while not listener.first.wait(0.2):
            assert process.poll() is None, process.stderr.read()
        yield process
    finally:
        process.kill()
        process.wait()
        process.stderr.close()


def test_live_with_damage_on_the_line_a_sensor_that_pauses_and_ctrl_c(wearer, tmp_path):
    file = tmp_path / "poses.csv"
    noise = random.Random(2)
    with Listener() as listener, Rig(wearer.recording) as rig, live(wearer, rig.port, listener, file) as run:
        rig.corrupt = 20
        while rig.corrupt:
            time.sleep(0.05)
            rig.noise = bytes(noise.randrange(1, 256) for _ in range(noise.randrange(100)))
        rig.silent = {PLACEMENTS.index("head")}
        time.sleep(1.5)
        rig.silent = set()
        time.sleep(1.0)
        run.send_signal(signal.SIGINT)
        code, errors = end(run)
    assert code == 0, errors
    frames, _, status, _ = whole(file)
    assert f"poses    {len(frames)} in " in errors
    lost = re.search(r"packets  \d+ good, (\d+) lost, (\d+) bad", errors)
    assert int(lost[1]) == 20
    assert int(lost[2]) >= 20
    held = [i for i, text in enumerate(status) if text == "held head"]
    assert len(held) >= 30  # of about 90: a stalled machine holds the others too
    assert "head: no data for 1 s; its last values are repeated" in errors
    assert re.search(r"^head: back after \d\.\d s$", errors, re.MULTILINE)
    assert re.search(r"^held     .*\bhead in \d+ frames", errors, re.MULTILINE)
    assert "ok" in status[: held[0]]
    assert "ok" in status[held[-1] :]
    assert re.search(r"^latency  .* ms median, .* from last packet to pose sent$", errors, re.MULTILINE)
    sent = [json.loads(datagram)["frame"] for datagram in listener.datagrams]
    assert sent == frames.tolist()


def test_a_machine_that_stands_still_for_two_seconds(wearer, tmp_path):
    """No sample is lost or late, and the receiver does not see the backlog."""
    file = tmp_path / "poses.csv"
    with (
        Listener() as listener,
        Rig(wearer.recording, rate=25.0) as rig,  # two seconds of it fit the buffer of a port
        live(wearer, rig.port, listener, file) as run,
    ):
        listener.wait_for("ok", 30)
        run.send_signal(signal.SIGSTOP)
        time.sleep(2.2)
        run.send_signal(signal.SIGCONT)
        listener.wait_for("ok", 30)
        run.send_signal(signal.SIGINT)
        code, errors = end(run)
    assert code == 0, errors
    assert "0 lost, 0 bad; 0 samples too late or duplicate" in errors, errors
    frames, _, status, _ = whole(file)
    sent = [json.loads(datagram)["frame"] for datagram in listener.datagrams]
    skipped = sorted(set(frames.tolist()) - set(sent))
    assert len(skipped) >= 60  # of 132: those of the last second are sent
    assert {status[i] for i in skipped} == {"ok"}
    late = r"^poses are \d\.\d s late; live outputs skip those older than 1 s$"
    assert re.search(late, errors, re.MULTILINE)
    assert f"\nskipped  {len(skipped)} poses at live outputs: they came too late\n" in errors


def test_live_from_the_simulator_until_sigterm(wearer, tmp_path):
    file = tmp_path / "poses.csv"
    with (
        simulated(wearer.short, "--stand") as (simulator, port),
        Listener() as listener,
        live(wearer, port, listener, file) as run,
    ):
        simulator.stdin.write("go\n")
        simulator.stdin.flush()
        said = [simulator.stdout.readline().split() for _ in range(2)]
        run.send_signal(signal.SIGTERM)
        code, errors = end(run)
    assert code == 0, errors
    assert [words[0] for words in said] == ["started", "ended"]
    frames, time_s, status, _ = whole(file)
    assert f"poses    {len(frames)} in " in errors
    assert "ok" in status
    # Live times are Unix times: there are frames of the time in which the recording was played.
    started, ended = (float(words[1]) for words in said)
    assert ((time_s > started) & (time_s < ended)).any()


def test_the_place_is_reset_by_key_text_and_osc(wearer, tmp_path):
    """The wearer runs on; each request puts them back above the origin."""
    file, control = tmp_path / "poses.csv", free_address(socket.SOCK_DGRAM)
    host, _, number = control.partition(":")
    outside, inside = pty.openpty()
    command = ["run", "--model", "rnn", "--csv", file, "--calibration", wearer.calibration]
    with Rig(wearer.short) as rig, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.connect((host, int(number)))
        requests = (
            lambda: os.write(outside, b"O"),
            lambda: sender.send(b"origin"),
            lambda: sender.send(b"/edgepose/origin\0\0\0\0,\0\0\0"),
            lambda: os.write(outside, b"\3"),
        )
        process = processes.Popen(
            [sys.executable, "-m", "edgepose", *map(str, command), "--port", rig.port, "--control", control],
            stdin=inside, stdout=inside, stderr=inside, preexec_fn=own_terminal,
        )  # fmt: skip
        os.close(inside)
        screen = b""
        with ended(process, outside):
            for times, ask in enumerate(requests):
                parts = [screen]
                while len(parts) <= times or b" poses, " not in parts[-1]:
                    screen += os.read(outside, 4096)
                    parts = screen.split(b"place reset: the wearer is back at the origin")
                ask()
            screen += rest_of(outside)
            assert process.wait(60) == 0
    assert b"Ctrl-C ends the run, r re-zeroes headings, o goes back to the origin" in b" ".join(
        screen.split()
    )
    assert b"datagrams without" not in screen
    path = read_poses(file).translation[:, [0, 2]]
    assert (path == 0.0).all(axis=1).sum() == 4  # the start, and after each request
    assert np.linalg.norm(path, axis=1).max() > 0.5


def slcan(packet: Packet) -> bytes:
    """A packet's CAN frames as an adapter writes them on its serial port."""
    frames = native_can.encode(packet)
    return b"".join(b"t%03X%d%s\r" % (can_id, len(data), data.hex().encode()) for can_id, data in frames)


@pytest.mark.parametrize(("prefix", "wire"), [("", encode), ("slcan:", slcan)], ids=["port", "bus"])
def test_a_line_that_is_unplugged_and_comes_back(wearer, tmp_path, monkeypatch, prefix, wire):
    """It is reached through a symbolic link, as the ports under /dev/serial/by-id are."""
    monkeypatch.setenv("CAN_CONFIG", '{"sleep_after_open": 0.01}')  # python-can's own way to set this
    file, link = tmp_path / "poses.csv", tmp_path / "hub"
    name = f"{prefix}{link}"
    with Listener() as listener, Rig(wearer.recording, wire) as first:
        link.symlink_to(first.port)
        with live(wearer, name, listener, file) as run:
            time.sleep(0.5)
            link.unlink()
            first.unplug()
            while not (line := run.stderr.readline()).startswith("running rnn"):
                assert line, "the run has ended"
            assert run.stderr.readline() == f"{name}: disconnected; the run continues and waits for it\n"
            listener.wait_for(f"held {' '.join(PLACEMENTS)}", 30)
            with Rig(wearer.recording, wire) as second:
                link.symlink_to(second.port)
                # Where it takes long, silent sensors and counts are told in between.
                told = next(line for line in iter(run.stderr.readline, "") if line.startswith(name))
                assert re.fullmatch(rf"{name}: back after \d+\.\d s\n", told)
                listener.wait_for("ok", 30)
                run.send_signal(signal.SIGINT)
                code, errors = end(run)
    assert code == 0, errors
    frames, _, status, _ = whole(file)
    sent = [json.loads(datagram)["frame"] for datagram in listener.datagrams]
    assert sent == frames.tolist()
    assert f"poses    {len(frames)} in " in errors
    held = [i for i, text in enumerate(status) if text == f"held {' '.join(PLACEMENTS)}"]
    assert "ok" in status[: held[0]]
    assert "ok" in status[held[-1] :]


def test_silence_a_wrong_speed_and_a_sensor_that_never_reports(wearer, tmp_path):
    """At a wrong speed only noise arrives. The runs wait for some seconds each, so they wait together."""
    source = random.Random(4)
    with Rig(wearer.recording) as quiet, Rig(wearer.recording) as noisy, Rig(wearer.recording) as five:
        quiet.silent = noisy.silent = set(range(6))
        five.silent = {PLACEMENTS.index("left_lower_leg")}
        runs = [
            start(
                *("run", "--port", rig.port, "--calibration", wearer.calibration, "--model", "rnn"),
                *("--csv", tmp_path / f"{i}.csv"),
            )
            for i, rig in enumerate((quiet, noisy, five))
        ]
        try:
            while any(run.poll() is None for run in runs):
                noisy.line.write(bytes(source.randrange(256) for _ in range(50)))
                time.sleep(0.01)
            codes, texts = zip(*map(end, runs), strict=True)
        finally:
            for run in runs:
                run.kill()
                run.wait()
                run.stderr.close()
    assert codes == (1, 1, 1)
    told = [last_line(text) for text in texts]
    assert re.match(rf"edgepose: {quiet.port}: no data for \d+ s; check --port", told[0])
    assert re.match(
        rf"edgepose: {noisy.port}: \d+ bytes in \d+ s but no valid packet; check --baud \(now 115200\)",
        told[1],
    )
    assert "no samples of left_lower_leg in the first" in told[2]
    assert "switch these sensors on" in told[2]


def test_an_empty_capture(command, wearer, tmp_path):
    file = tmp_path / "capture.bin"
    file.touch()
    result = command(
        *("run", "--file", file, "--calibration", wearer.calibration, "--model", "rnn"),
        *("--csv", tmp_path / "poses.csv"),
    )
    assert result.returncode == 1
    assert f"{file}: no known packet in 0 bytes" in last_line(result.stderr)


def test_a_bad_row_costs_only_itself(command, wearer, tmp_path):
    """The same answer in `check`, `calibrate` and `run`: the others are used, and the row is reported."""
    path = tmp_path / "walk.csv"
    write_csv(path, read_recording(wearer.recording))
    lines = path.read_text().splitlines(keepends=True)
    lines[3600] = ",".join(["nan" if i == 2 else cell for i, cell in enumerate(lines[3600].split(","))])
    path.write_text("".join(lines))
    says = f"{path}: 1 bad rows left out, the first: row "
    result = command(
        *("run", "--file", path, "--calibration", wearer.calibration, "--model", "rnn"),
        *("--csv", tmp_path / "poses.csv"),
    )
    assert result.returncode == 1
    assert f"edgepose: {says}" in result.stderr
    assert len(whole(tmp_path / "poses.csv")[0]) == 720
    result = command("check", "--file", path)
    assert f"warning: {says}" in result.stderr
    result = command(
        *("calibrate", "--file", path, "--body-frame", "heading:0", "--from", 1, "--hold", 3),
        *("--out", tmp_path / "calibration.json"),
    )
    assert result.returncode == 1
    assert f"warning: {says}" in result.stdout + result.stderr
