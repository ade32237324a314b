"""Runs `edgepose run` for minutes on six simulated 100 Hz sensors behind a pty, with 60 poses per second.

A clip repeats in native packets. The table shows the resources in use at five times. Below it are the last
line of the run's own summary, with latencies from the last packet to the output, and the number of lost
frames. Needs Linux. The program has core 0 to itself (`--core`), the simulator uses the others. Run nothing
else meanwhile, or give both priority with `chrt -r 5 python tools/soak_run.py`.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import click
import demo
import numpy as np
from soak_viewer import RATE, cpu_s, make_recording, megabytes

from edgepose.formats.poses.registry import read_poses

LOOKS = (0.1, 0.25, 0.5, 0.75, 0.95)
"""Fractions of the duration at which the run is measured."""


@click.command()
@click.option("--minutes", type=click.FloatRange(0.2), default=10.0, show_default=True, help="Duration.")
@click.option("--model", default="rnn", show_default=True, help="Name or path.")
@click.option("--core", type=click.IntRange(0), default=0, show_default=True, help="Core for edgepose run.")
def soak(minutes: float, model: str, core: int) -> None:
    """Run the soak and print its table."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        length_s = make_recording(folder, 60.0 * minutes)
        os.sched_setaffinity(0, os.sched_getaffinity(0) - {core} or {core})  # inherited by the simulator
        sensors, source = stack.enter_context(demo.simulator(folder / "walk.npz", "native"))
        run = stack.enter_context(running(folder, source, model, core))
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
        run.send_signal(2)
        messages = run.communicate()[1]
        if run.returncode:
            raise click.ClickException(messages)
        click.echo(messages.splitlines()[-1])
        poses = read_poses(folder / "poses.csv")
        held = sum(map(bool, poses.held))
        lost = int(np.sum(np.diff(poses.frames) - 1))
        wanted = round(float(poses.time_s[-1] - poses.time_s[0]) * RATE) + 1
        click.echo(
            f"{len(poses.frames)} of {wanted} frames written, {lost} lost, {held} with a silent sensor"
        )


@contextlib.contextmanager
def running(folder: Path, source: list[str], model: str, core: int) -> Iterator[subprocess.Popen[str]]:
    """Start a run on a line; end it afterwards."""
    command = ["run", *source, "--protocol", "native", "--model", model]
    command += ["--calibration", folder / "calib.json", "--csv", folder / "poses.csv"]
    run = subprocess.Popen(
        [sys.executable, "-m", "edgepose", *map(str, command)],
        text=True,
        stderr=subprocess.PIPE,
        start_new_session=True,  # `cpu_s` counts a process group
        preexec_fn=lambda: os.sched_setaffinity(0, {core}),
    )
    try:
        yield run
    finally:
        run.terminate()  # has no effect after its end
        run.wait()
        run.stderr.close()


if __name__ == "__main__":
    soak()
