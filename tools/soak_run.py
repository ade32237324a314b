"""Runs `edgepose run` for minutes on six simulated 100 Hz sensors behind a pty, with 60 poses per second.

A clip repeats in native packets. The table shows the resources in use at five times. Below it are the end of
the run's own summary, with latencies from the last packet to the output, and the counts of packets, frames
and datagrams with what they should be. Needs Linux. The program has core 0 to itself (`--core`), the
simulator uses the others. Run nothing else meanwhile, or give both priority with
`chrt -r 5 python tools/soak_run.py`.

With --faults, packets are lost, delayed and damaged, clocks drift, one sensor a minute falls silent for up to
20 s, and twice a minute other programs take the core for 2 s.
"""

from __future__ import annotations

import contextlib
import os
import random
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import click
import demo
import numpy as np
from soak_viewer import RATE, cpu_s, make_recording, megabytes

from edgepose.formats.poses.registry import read_poses
from edgepose.placements import PLACEMENTS

LOOKS = (0.1, 0.25, 0.5, 0.75, 0.95)
"""Fractions of the duration at which the run is measured."""

SENSOR_RATE = 100.0
FAULTS = ("--loss", "0.01", "--corrupt", "0.005", "--jitter", "5", "--drift", "100")
SILENCE_S = (2.0, 20.0)
"""Shortest and longest silence of a sensor, one a minute."""

BUSY_PROGRAMS, BUSY_S, BUSY_EVERY_S = 30, 2.0, 30.0
"""Programs that take the core together with the run, for how long, and how often."""


@click.command()
@click.option("--minutes", type=click.FloatRange(0.2), default=10.0, show_default=True, help="Duration.")
@click.option("--model", default="rnn", show_default=True, help="Name or path.")
@click.option("--core", type=click.IntRange(0), default=0, show_default=True, help="Core for edgepose run.")
@click.option("--faults", is_flag=True, help="Bad lines, dying sensors, a busy core.")
def soak(minutes: float, model: str, core: int, faults: bool) -> None:
    """Run the soak and print its table."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        length_s = make_recording(folder, 60.0 * minutes)
        os.sched_setaffinity(0, os.sched_getaffinity(0) - {core} or {core})  # inherited by the simulator
        flags = [*FAULTS, *silences(length_s)] if faults else []
        sensors, source = stack.enter_context(demo.simulator(folder / "walk.npz", "native", flags))
        if faults:
            stack.enter_context(busy_core(core))
        receiver = Receiver()
        receiver.start()
        run = stack.enter_context(running(folder, [*source, "--udp", receiver.address], model, core))
        time.sleep(3.0)  # until the model is loaded
        sensors.stdin.write("go\n")
        sensors.stdin.flush()
        started, used_s = time.monotonic(), cpu_s(run.pid)
        click.echo(f"{'minute':>6}  {'of the core':>11}  {'memory':>9}")
        for part in LOOKS:
            time.sleep(max(0.0, started + part * length_s - time.monotonic()))
            passed_s, now_s = time.monotonic() - started, cpu_s(run.pid)
            click.echo(
                f"{passed_s / 60:6.1f}  {(now_s - used_s) / passed_s:11.1%}  {megabytes(run.pid):6.1f} MB"
            )
        time.sleep(max(0.0, started + length_s - time.monotonic()))
        run.send_signal(signal.SIGTERM)  # not SIGINT, which a shell ignores for programs in the background
        run.wait()
        messages = (folder / "messages.txt").read_text()
        if run.returncode:
            raise click.ClickException(messages)
        click.echo(messages[messages.index("poses  ") :].rstrip())
        time.sleep(1.0)  # until the last datagrams have been received
        click.echo(accounts(folder, messages, receiver.count))


def accounts(folder: Path, messages: str, datagrams: int) -> str:
    """Compare the counts of packets, frames and datagrams with what they should be."""
    poses = read_poses(folder / "poses.csv")
    span_s = float(poses.time_s[-1] - poses.time_s[0])
    (packets,) = re.findall(r"^packets  (\d+) good, (\d+) lost", messages, re.M)
    skipped = sum(map(int, re.findall(r"^skipped  (\d+)", messages, re.M)))
    held = sum(map(bool, poses.held))
    missing = int(np.sum(np.diff(poses.frames) - 1))
    return (
        f"{sum(map(int, packets))} of {span_s * SENSOR_RATE * len(PLACEMENTS):.0f} packets accounted for; "
        f"{len(poses.frames)} of {round(span_s * RATE) + 1} frames written, {missing} missing, "
        f"{held} with a silent sensor; {datagrams} datagrams came, {skipped} skipped"
    )


def silences(length_s: float) -> list[str]:
    """Return the simulator's flags for one silent sensor a minute."""
    rng = random.Random(0)
    flags = []
    for start_s in np.arange(30.0, length_s - 30.0, 60.0):
        name, silent_s = rng.choice(PLACEMENTS), rng.uniform(*SILENCE_S)
        flags += ["--kill", f"{name}@{start_s:.1f}..{start_s + silent_s:.1f}"]
    return flags


@contextlib.contextmanager
def running(folder: Path, outputs: list[str], model: str, core: int) -> Iterator[subprocess.Popen[bytes]]:
    """Start a run on a line; end it afterwards."""
    command = ["run", *outputs, "--protocol", "native", "--model", model]
    command += ["--calibration", folder / "calib.json", "--csv", folder / "poses.csv"]
    with (folder / "messages.txt").open("wb") as messages:
        run = subprocess.Popen(
            [sys.executable, "-m", "edgepose", *map(str, command)],
            stderr=messages,
            start_new_session=True,  # `cpu_s` counts a process group
            preexec_fn=lambda: os.sched_setaffinity(0, {core}),
        )
    try:
        yield run
    finally:
        run.terminate()  # has no effect after its end
        run.wait()


@contextlib.contextmanager
def busy_core(core: int) -> Iterator[None]:
    """Let programs take turns on the core from time to time."""
    ended = threading.Event()
    loop = [sys.executable, "-c", "while True: pass"]
    with contextlib.ExitStack() as stack:
        programs = []
        for _ in range(BUSY_PROGRAMS):
            program = stack.enter_context(subprocess.Popen(loop))
            stack.callback(program.kill)
            program.send_signal(signal.SIGSTOP)
            os.sched_setaffinity(program.pid, {core})
            programs.append(program)
        time.sleep(1.0)  # until none of them disturbs the simulator any more

        def take_turns() -> None:
            while not ended.wait(BUSY_EVERY_S - BUSY_S):
                for number in (signal.SIGCONT, signal.SIGSTOP):
                    for program in programs:
                        program.send_signal(number)
                    if number == signal.SIGCONT:
                        ended.wait(BUSY_S)

        thread = threading.Thread(target=take_turns)
        thread.start()
        stack.callback(thread.join)
        stack.callback(ended.set)
        yield


class Receiver(threading.Thread):
    """Counts the datagrams that come to a free port of this machine, until the program ends.

    Attributes:
        address: HOST:PORT.
        count: datagrams so far.
    """

    def __init__(self) -> None:
        """Open the port."""
        super().__init__(daemon=True)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self.address = "127.0.0.1:{1}".format(*self._socket.getsockname())
        self.count = 0

    def run(self) -> None:
        """Receive."""
        while True:
            self._socket.recv(65536)
            self.count += 1


if __name__ == "__main__":
    soak()
