"""Counts the instructions of a frame on an emulated 64-bit ARM computer that tools/emulate_arm64.sh made.

\b
    count_arm64.py /var/tmp/edgepose-arm64/bookworm
    count_arm64.py /var/tmp/edgepose-arm64/bookworm --tree FOLDER --runtime torch     another revision

network: one step of the streaming network, in f32.
live: a whole `edgepose run` at 60 Hz, with six sensors at 100 Hz that send in turn over one serial line and
    poses as binary datagrams. All its threads count. Its clock and the sensors' are slowed down, because
    emulation does not keep up. Memory is the largest so far of the program, without qemu's own.

Means of the last half of the frames. Needs Debian's packages qemu-user and gcc, and no root.
"""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np
from slow_clock import slow_down

TOOLS = Path(__file__).parent
CALLS = {"getppid": 173, "sendto": 206}
"""System calls that mark frames, and their numbers on 64-bit ARM."""

OWN = ("[", "/usr/bin/qemu", "/usr/lib/x86_64-linux-gnu")
"""Names of memory that is qemu's own."""

START_S = 30.0
"""Longest time until the first pose, slow seconds."""

NETWORK = """
import os, sys
import numpy as np
from edgepose.inference.model import Model
engine = Model(sys.argv[1], precision="f32", runtime=sys.argv[2]).engine()
bones, force = np.tile(np.eye(3, dtype=np.float32), (6, 1, 1)), np.zeros((6, 3), np.float32)
for i in range(int(sys.argv[3])):
    os.getppid()
    engine.push(i, bones, force)
"""


class Computer(NamedTuple):
    """An emulated computer.

    Attributes:
        root: its files.
        cpu: its processor, by qemu's name.
        plugin: qemu's plugin that counts.
        tree: sources to run instead of the installed ones.
    """

    root: Path
    cpu: str
    plugin: Path
    tree: Path | None

    def command(self, call: str, counts: Path) -> list[str]:
        """Return the command of a Python there, which writes the count at each system call of a name."""
        [packages] = self.root.glob("home/rig/edgepose/.venv/lib/python3.*/site-packages")
        sources = [] if self.tree is None else [self.tree, self.tree / "export"]
        core = str(min(os.sched_getaffinity(0)))
        variables = {
            "PYTHONPATH": ":".join(map(str, [*sources, packages])),
            "OPENBLAS_NUM_THREADS": "1",
            "OMP_NUM_THREADS": "1",
        }
        command = ["taskset", "-c", core, "qemu-aarch64", "-L", str(self.root), "-cpu", self.cpu]
        command += ["-U", "OPENBLAS_CORETYPE"]
        command += ["-plugin", f"{self.plugin},out={counts},call={CALLS[call]}"]
        command += [word for name, value in variables.items() for word in ("-E", f"{name}={value}")]
        return [*command, str(self.root / "usr/bin" / packages.parent.name)]


def network(computer: Computer, folder: Path, model: str, runtime: str, frames: int) -> float:
    """Return millions of instructions of a step of the network."""
    command = [*computer.command("getppid", folder / "counts"), "-c", NETWORK, model, runtime, str(frames)]
    subprocess.run(command, check=True)
    return per_frame(folder / "counts")


def live(
    computer: Computer, folder: Path, words: list[str], slow: float, seconds: float
) -> tuple[float, float]:
    """Return millions of instructions of a frame of `edgepose run`, and the megabytes of the program."""
    from edgepose.benchmarks.live_run import SensorLine

    with ExitStack() as stack:
        line = stack.enter_context(SensorLine())
        receiver = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        receiver.bind(("127.0.0.1", 0))
        receiver.setblocking(False)
        command = computer.command("sendto", folder / "counts")
        command += [str(TOOLS / "slow_clock.py"), str(slow), "run", "--port", line.port, *words]
        command += ["--udp", f"127.0.0.1:{receiver.getsockname()[1]},format=binary"]
        run = stack.enter_context(subprocess.Popen(command))
        stack.callback(run.kill)
        end_s = time.monotonic() + START_S
        while not line.send(0.1, receiver):
            if run.poll() is not None or time.monotonic() > end_s:
                raise click.ClickException("no poses of a live run")
        line.send(seconds, receiver)
        memory = memory_mb(run.pid)
        run.send_signal(signal.SIGTERM)
        run.wait()
    return per_frame(folder / "counts"), memory


def per_frame(counts: Path) -> float:
    """Return the mean of the last half of the steps of a file of counts, millions."""
    steps = np.diff(np.loadtxt(counts))
    return float(steps[len(steps) // 2 :].mean()) / 1e6


def memory_mb(process: int) -> float:
    """Return the memory of an emulated program without qemu's code, libraries, heap and translations."""
    total, counts = 0, False
    for line in Path(f"/proc/{process}/smaps").read_text().splitlines():
        if re.match(r"[0-9a-f]+-[0-9a-f]+ ", line):
            _, access, _, _, _, *name = line.split(maxsplit=5)
            counts = access != "rwxp" and not "".join(name).startswith(OWN)
        elif counts and line.startswith("Rss:"):
            total += int(line.split()[1])
    return total / 1024


@contextmanager
def plugin() -> Iterator[Path]:
    """Compile qemu's plugin; it is deleted at the end."""
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "count.so"
        source = TOOLS / "count_instructions.c"
        subprocess.run(["gcc", "-shared", "-fPIC", "-O2", "-o", library, source], check=True)
        yield library


@click.command(help=__doc__)
@click.argument("root", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--cpu", default="cortex-a72", show_default=True, help="Processor, by qemu's name.")
@click.option("--tree", type=click.Path(exists=True, file_okay=False, path_type=Path), help="Sources to run.")
@click.option("--model", "models", multiple=True, default=("rnn", "birnn"), show_default=True)
@click.option(
    "--runtime",
    "runtimes",
    multiple=True,
    default=("torch", "numpy"),
    show_default=True,
    help="none: no flag.",
)
@click.option("--frames", default=60, show_default=True, help="Steps of the network.")
@click.option("--seconds", default=20.0, show_default=True, help="Length of a live run.")
@click.option("--slow", default=10.0, show_default=True, help="Real seconds of a second of a live run.")
def main(
    root: Path,
    cpu: str,
    tree: Path | None,
    models: tuple[str, ...],
    runtimes: tuple[str, ...],
    frames: int,
    seconds: float,
    slow: float,
) -> None:
    """Count and print."""
    slow_down(slow)
    from edgepose.benchmarks.simulated import calibration
    from edgepose.calibration import save

    with plugin() as library, tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        computer = Computer(root.resolve(), cpu, library, tree and tree.resolve())
        save(calibration(), folder / "calib.json")
        for model in models:
            for runtime in runtimes:
                words = ["--protocol", "native", "--calibration", str(folder / "calib.json")]
                words += ["--model", model, "--precision", "f32"]
                what = f"{cpu} {model} {runtime}:"
                if runtime != "none":  # revisions before there was a choice
                    words += ["--runtime", runtime]
                    millions = network(computer, folder, model, runtime, frames)
                    print(f"{what} network {millions:.2f} M", flush=True)
                millions, megabytes = live(computer, folder, words, slow, seconds)
                print(f"{what} live {millions:.2f} M, {megabytes:.0f} MB", flush=True)


if __name__ == "__main__":
    main()
