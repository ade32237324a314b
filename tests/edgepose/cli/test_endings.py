"""How commands end when their reader or terminal goes: in bounded time, with one line and whole files."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path

import pytest

from edgepose.cli.terminal.stop_signal import REPEAT_S, StopSignal
from edgepose.formats.poses.registry import read_poses
from tests.support import limits, processes, terminals

RUN = [sys.executable, "-m", "edgepose", "run", "--model", "rnn"]
LIMIT_S = 60.0
"""Nobody waits so long; a machine under load may."""


@pytest.fixture(autouse=True)
def hangup():
    """Tests that were started with nohup have SIGHUP ignored, and what they start would inherit that."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


def started(wearer, *words: object, short: bool = False, **options) -> subprocess.Popen:
    """A run on 12 s, or 3 s, of a recording."""
    file = wearer.short if short else wearer.recording
    command = [*RUN, "--file", file, "--calibration", wearer.calibration, *words]
    return processes.Popen(list(map(str, command)), **options)


def ended(process: subprocess.Popen) -> tuple[int, str]:
    """Exit code and messages."""
    try:
        _, errors = process.communicate(timeout=LIMIT_S)
    finally:
        process.kill()
    return process.returncode, errors


def until(condition, what: str) -> None:
    end_s = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < end_s, what
        time.sleep(0.02)


def full(pipe) -> bool:
    """Whether there is something in a pipe, and no more of it after a while."""
    before, after = 0, -1
    while before != after:
        before = after
        time.sleep(0.5)
        after = struct.unpack("i", fcntl.ioctl(pipe.fileno(), termios.FIONREAD, bytes(4)))[0]
    return after > 10_000


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_one_signal_ends_a_run_whose_output_nobody_reads(wearer, tmp_path, number):
    process = started(
        *(wearer, "--csv", "-", "--npz", tmp_path / "p.npz"),
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    until(lambda: full(process.stdout), "a full pipe")
    process.send_signal(number)
    try:
        assert process.wait(LIMIT_S) == 1
        errors = process.stderr.read()
    finally:
        process.kill()
        process.stdout.close()
        process.stderr.close()
        process.wait()
    assert "poses    " in errors
    assert re.search(
        r"edgepose: 1 of 2 outputs failed: the program that reads the poses from standard output has stopped "
        r"reading: \d+ bytes",
        errors,
    )
    count = int(re.search(r"poses    (\d+) in", errors)[1])
    assert len(read_poses(tmp_path / "p.npz").frames) == count > 20
    assert [path.name for path in tmp_path.iterdir()] == ["p.npz"]


@pytest.mark.parametrize("how", ["goes away", "closed at the start"])
def test_standard_error_that_nobody_reads(wearer, tmp_path, how):
    """Messages are not what a run is for."""
    options = {"stderr": subprocess.PIPE} if how == "goes away" else {"preexec_fn": limits.close(2)}
    process = started(wearer, "--realtime", "--csv", tmp_path / "p.csv", short=True, **options)
    if how == "goes away":
        process.stderr.readline()
        process.stderr.close()
    assert process.wait(LIMIT_S) == 0
    assert len(read_poses(tmp_path / "p.csv").frames) == 180


def test_every_command_works_without_standard_error():
    done = processes.run(
        [sys.executable, "-m", "edgepose", "models"], stdout=subprocess.PIPE, preexec_fn=limits.close(2)
    )
    assert done.returncode == 0
    assert b"birnn" in done.stdout


@pytest.mark.parametrize("words", [["models", "--json"], ["--help"]])
def test_standard_output_on_a_full_disk(words):
    with Path("/dev/full").open("w") as full:
        result = processes.run(
            [sys.executable, "-m", "edgepose", *words], stdout=full, stderr=subprocess.PIPE
        )
    assert result.returncode == 1
    assert result.stderr == b"edgepose: cannot write the result: the disk is full\n"


def test_standard_output_that_is_closed(wearer):
    process = started(wearer, "--csv", "-", text=True, stderr=subprocess.PIPE, preexec_fn=limits.close(1))
    code, errors = ended(process)
    assert code == 1
    assert errors.endswith("edgepose: cannot write poses: standard output is closed\n")


def test_a_terminal_that_is_closed_ends_a_run_with_whole_files(wearer, tmp_path):
    """The window is closed, or the line of ssh breaks: SIGHUP, and a standard error that is an error."""
    master, slave = pty.openpty()
    process = started(
        *(wearer, "--realtime", "--npz", tmp_path / "p.npz"),
        stdin=slave,
        stdout=slave,
        stderr=slave,
        start_new_session=True,
        preexec_fn=terminals.take_terminal,
    )
    os.close(slave)
    seen = b""
    while b" poses, " not in seen:
        seen += os.read(master, 4096)
    os.close(master)
    assert process.wait(LIMIT_S) == 0
    assert 30 < len(read_poses(tmp_path / "p.npz").frames) < 720
    assert [path.name for path in tmp_path.iterdir()] == ["p.npz"]


def test_nohup_goes_on(wearer, tmp_path):
    process = started(
        *(wearer, "--realtime", "--csv", tmp_path / "p.csv"),
        short=True,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=limits.ignore_hangup,
    )
    process.stderr.readline()
    until(lambda: (tmp_path / "p.csv").stat().st_size > 20_000, "poses")
    process.send_signal(signal.SIGHUP)
    code, _ = ended(process)
    assert code == 0
    assert len(read_poses(tmp_path / "p.csv").frames) == 180


def test_a_recording_to_a_pipe_that_nobody_reads(wearer):
    process = processes.Popen(
        [sys.executable, "-m", "edgepose", "record", "-", "--file", str(wearer.recording)],
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    until(lambda: full(process.stdout), "a full pipe")
    process.send_signal(signal.SIGTERM)
    try:
        assert process.wait(LIMIT_S) == 1
    finally:
        process.kill()
        errors = process.stderr.read()
        process.stdout.close()
        process.stderr.close()
    assert "the program that reads the samples from standard output has stopped reading" in errors


def test_a_pipe_is_waited_for_until_the_run_is_to_end(wearer, tmp_path):
    os.mkfifo(tmp_path / "p.csv")
    process = started(wearer, "--csv", tmp_path / "p.csv", text=True, stderr=subprocess.PIPE)
    assert process.stderr.readline() == f"{tmp_path / 'p.csv'}: waiting for a program that reads it\n"
    process.send_signal(signal.SIGTERM)
    code, errors = ended(process)
    assert code == 1
    assert errors == f"edgepose: no program reads the poses from {tmp_path / 'p.csv'}\n"


def test_a_user_without_a_home(tmp_path):
    """As in a container that runs under any number."""
    environment = {k: v for k, v in os.environ.items() if k not in ("HOME", "XDG_CONFIG_HOME")}
    done = processes.run(
        [sys.executable, "-m", "edgepose", "models"],
        text=True,
        capture_output=True,
        check=False,
        env=environment | {"XDG_CONFIG_HOME": "~nobody-of-that-name/x"},
    )
    assert done.returncode == 0, done.stderr
    assert "birnn" in done.stdout


def test_a_signal_that_comes_twice_and_one_that_is_meant():
    before = signal.getsignal(signal.SIGINT)
    with StopSignal() as stop:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGTERM)
        assert stop.asked
        time.sleep(REPEAT_S + 0.05)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) == before
