"""Runs `edgepose run --view` for minutes with a real browser that is open, suspended, killed and reopened.

A clip repeats in real time. For each stretch the table shows the state of the browser, and the memory of the
run and its viewer at the end. The last line shows how many frames the run wrote. Needs Linux and Debian's
chromium-headless-shell.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np

from edgepose.formats.poses.registry import read_poses
from edgepose.formats.recordings.npz import write_npz
from edgepose.formats.recordings.registry import read_recording
from edgepose.imu import Recording, SensorData

CLIP = Path(__file__).parent / "data" / "09_12.bvh"
HOLD_S = 6
RATE = 60.0
PAGE = "http://127.0.0.1:8080"

STRETCHES = {
    0.1: "open", 0.3: "open", 0.5: "open", 0.7: "asleep", 0.8: "awake again", 0.9: "killed", 1.0: "a new one"
}  # fmt: skip
"""State of the browser, by the fraction of the duration at which it ends."""

SIGNALS = {"asleep": signal.SIGSTOP, "awake again": signal.SIGCONT, "killed": signal.SIGKILL}


@click.command()
@click.option("--minutes", type=click.FloatRange(0.2), default=10.0, show_default=True, help="Duration.")
def soak(minutes: float) -> None:
    """Run the soak and print its table."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        length_s = make_recording(folder, 60.0 * minutes)
        run = stack.enter_context(run_with_viewer(folder))
        viewer = child_of(run.pid)
        click.echo(f"{'minute':>6}  {'browser':12}  {'its CPU':>8}  {'viewer':>9}  {'run':>9}")
        browser, previous, started = None, "", time.monotonic()
        for part, state in STRETCHES.items():
            if state in SIGNALS:
                os.killpg(browser.pid, SIGNALS[state])
            elif state != previous:
                browser = stack.enter_context(new_browser(folder / state))
            previous = state
            at, used_s = time.monotonic(), cpu_s(browser.pid)
            # The last measurement is taken before the run and its viewer end.
            time.sleep(max(0.0, started + part * length_s - (2.0 if part == 1.0 else 0.0) - at))
            share = (cpu_s(browser.pid) - used_s) / (time.monotonic() - at)
            click.echo(
                f"{(time.monotonic() - started) / 60:6.1f}  {state:12}  {max(share, 0.0):8.0%}  "
                f"{megabytes(viewer):6.1f} MB  {megabytes(run.pid):6.1f} MB"
            )
        if run.wait():
            raise click.ClickException((folder / "errors.txt").read_text())
        poses = read_poses(folder / "poses.csv")
        held = sum(map(bool, poses.held))
        wanted = round(length_s * RATE)
        click.echo(f"{len(poses.frames)} of {wanted} frames written, {held} with a repeated value")


def make_recording(folder: Path, seconds: float) -> float:
    """Write a recording and its calibration; return the actual length of the recording, seconds."""
    edgepose("synthesize", CLIP, "--out", folder, "--hold", HOLD_S, "--rate", 100)
    clip = read_recording(folder / "09_12.npz")
    calibration = ("--body-frame", "heading:0", "--from", 1, "--hold", 3)
    edgepose("calibrate", "--file", folder / "09_12.npz", *calibration, "--out", folder / "calib.json")
    walk = {name: after(data, HOLD_S) for name, data in clip.sensors.items()}
    once_s = len(next(iter(walk.values())).time_s) / 100
    times = max(1, round(seconds / once_s))
    write_npz(
        folder / "walk.npz", Recording({name: repeated(data, times) for name, data in walk.items()}, {})
    )
    return times * once_s


def after(data: SensorData, seconds: float) -> SensorData:
    """Return what a sensor measured from a time on."""
    rows = data.time_s >= seconds
    return SensorData(*(None if values is None else values[rows] for values in data))


def repeated(data: SensorData, times: int) -> SensorData:
    """Return the data repeated, at 100 samples per second."""
    values = [None if column is None else np.tile(column, (times, 1)) for column in data[1:]]
    return SensorData(np.arange(times * len(data.time_s)) / 100, *values)


def edgepose(*words: object) -> None:
    """Run a command of edgepose and wait for its end."""
    subprocess.run([sys.executable, "-m", "edgepose", *map(str, words)], check=True, capture_output=True)


@contextlib.contextmanager
def run_with_viewer(folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Start a run and wait until its viewer serves the page; end the run afterwards."""
    command = ["run", "--file", folder / "walk.npz", "--realtime", "--model", "rnn", "--view"]
    command += ["--calibration", folder / "calib.json", "--csv", folder / "poses.csv"]
    # A file, because a full pipe would block the run.
    messages = folder / "errors.txt"
    with messages.open("w") as errors:
        run = subprocess.Popen([sys.executable, "-m", "edgepose", *map(str, command)], stderr=errors)
    try:
        while "in a browser" not in messages.read_text():
            if run.poll() is not None:
                raise click.ClickException(f"the run ended before it served the page: {messages.read_text()}")
            time.sleep(0.1)
        yield run
    finally:
        run.terminate()  # has no effect after its end
        run.wait()


@contextlib.contextmanager
def new_browser(folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Start a browser with the page open, drawing in software; kill it afterwards."""
    program = shutil.which("chromium-headless-shell")
    if program is None:
        raise click.ClickException("no browser: install Debian's chromium-headless-shell")
    # The debugging port keeps the browser open. Its processes form a group, so that they end together.
    command = [program, "--no-sandbox", "--enable-unsafe-swiftshader", "--disable-gpu"]
    command += ["--remote-debugging-port=0", f"--user-data-dir={folder}", PAGE]
    browser = subprocess.Popen(command, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        yield browser
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(browser.pid, signal.SIGKILL)
        browser.wait()


def stat_of(pid: int) -> list[str]:
    """Return the fields of /proc/PID/stat after the name: state, parent, group, ..."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()


def processes() -> Iterator[tuple[int, list[str]]]:
    """Yield the id and the stat fields of every process."""
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            yield int(entry.name), stat_of(int(entry.name))


def child_of(pid: int) -> int:
    """Return the child process of a process."""
    return next(child for child, fields in processes() if int(fields[1]) == pid)


def cpu_s(group: int) -> float:
    """Return the CPU seconds that a process group has used."""
    ticks = [int(fields[11]) + int(fields[12]) for _, fields in processes() if int(fields[2]) == group]
    return sum(ticks) / os.sysconf("SC_CLK_TCK")


def megabytes(pid: int) -> float:
    """Return the resident memory of a process, MB."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:")) / 1024


if __name__ == "__main__":
    soak()
