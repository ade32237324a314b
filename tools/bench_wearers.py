"""Measures how many wearers one core handles: the network alone, and the whole of `edgepose run`.

\b
    bench_wearers.py                           both shipped models, 1 to 64 wearers
    bench_wearers.py --model rnn --seconds 5 8 16 32

For each wearer six sensors at 100 Hz send native packets over a pseudo terminal. `edgepose run` has one core
to itself and sends binary datagrams; the simulator and the receiver use the other cores. A pose's age on
arrival is counted from the instant that it shows, minus the model's look-ahead. A run holds if no pose is
lost and 99 of 100 arrive within two frames. Costs are processor time, ages are wall-clock time: run nothing
else meanwhile.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
import tty
from collections import defaultdict
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np
import simulate

from edgepose.calibration import Calibration, save
from edgepose.inference import archive
from edgepose.inference.engine import EngineInput, MultiWearerEngine
from edgepose.inference.quantisation import quantise_weights
from edgepose.placements import PLACEMENTS
from edgepose.sinks.udp import decode_binary
from firmware_protocols.registry import PROTOCOLS

CLIP = Path(__file__).parent / "data" / "09_12.bvh"
RATE = 60.0
PERIOD_S = 0.01
LATE_S = 2.0 / RATE
START_S = 60.0
"""Longest time until the first poses, seconds."""

SETTLE_S = 2.0
"""Time at the start that is not measured, seconds: caches fill, and all wearers begin together."""


class ProgramRun(NamedTuple):
    """Result of a run of the whole program.

    Attributes:
        core: share of the core.
        p50_ms: median age of the poses.
        p99_ms: 99th percentile of the ages.
        late: share of poses that are older than two frames.
        lost: number of missing poses.
        per_s: poses per second and wearer.
    """

    core: float
    p50_ms: float
    p99_ms: float
    late: float
    lost: int
    per_s: float

    @property
    def holds(self) -> bool:
        """Whether all poses arrive, in time and at the full rate."""
        return not self.lost and self.p99_ms <= 1e3 * LATE_S and self.per_s > 0.99 * RATE


def network_us(model: str, wearers: int) -> float:
    """Return the network's processor time per frame and wearer, microseconds, as the median over rounds."""
    import torch  # not above: the simulator, a process of its own, starts without it

    torch.set_num_threads(1)
    info = archive.read_info(archive.find_archive(model))
    module = archive.load(info)
    quantise_weights(module, info)
    engine = MultiWearerEngine(module, info.metadata["past"], info.metadata["future"], wearers)
    body = EngineInput(None, np.tile(np.eye(3, dtype=np.float32), (6, 1, 1)), np.zeros((6, 3), np.float32))
    bodies = dict.fromkeys(range(wearers), body)
    costs = []
    for _ in range(15):
        started = time.thread_time()
        for _ in range(20):
            engine.push(bodies)
        costs.append(1e6 * (time.thread_time() - started) / (20 * wearers))
    return statistics.median(costs)


# --- wearers ------------------------------------------------------------------------------------------------


def packets(seconds: float) -> list[bytes]:
    """Return the packets of a wearer's six sensors, one chunk per 10 ms; the clip repeats."""
    sensors = [simulate.rows_of(data) for data in simulate.read_input(CLIP).sensors.values()]
    encode = PROTOCOLS["native"].encode
    return [
        b"".join(
            encode(rows[k % len(rows)]._replace(sensor=i, time_us=round(1e6 * k * PERIOD_S)), k)
            for i, rows in enumerate(sensors)
        )
        for k in range(int(seconds / PERIOD_S))
    ]


def send(wearers: int, seconds: float, names: Connection) -> None:
    """Send for several wearers, each with its own phase, until the data end or this process is terminated."""
    chunks = packets(seconds)
    masters = []
    for _ in range(wearers):
        master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        masters.append((master, slave))
    names.send([os.ttyname(slave) for _, slave in masters])
    start_s = time.monotonic()
    for k, chunk in enumerate(chunks):
        for i, (master, _) in enumerate(masters):
            left_s = start_s + (k + i / wearers) * PERIOD_S - time.monotonic()
            # As on a real line, data that cannot be sent in time, or that are not read, are lost.
            if left_s > -PERIOD_S:
                time.sleep(max(0.0, left_s))
                with contextlib.suppress(BlockingIOError):
                    os.write(master, chunk)


def write_rigs(folder: Path, ports: list[str], address: str) -> list[str]:
    """Write rig files; return the command-line arguments that name them."""
    none, zero = np.tile([1.0, 0.0, 0.0, 0.0], (len(PLACEMENTS), 1)), np.zeros(len(PLACEMENTS))
    up = np.array([0.5, -0.5, -0.5, -0.5])
    save(Calibration(up, zero, none, zero, "t-pose", "heading:0", "", {}), folder / "calib.json")
    words = []
    for i, port in enumerate(ports):
        file = folder / f"wearer{i}.toml"
        file.write_text(
            f'port = "{port}"\nprotocol = "native"\ncalibration = "calib.json"\n'
            f'udp = "{address},format=binary"\n'
        )
        words += ["--rig", str(file)]
    return words


# --- the whole program --------------------------------------------------------------------------------------


def processor_s(process: int) -> float:
    """Return the processor time of a process so far, seconds."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Datagram(NamedTuple):
    """A received pose: the sender's port, which identifies the wearer, the bytes, the Unix time (s)."""

    port: int
    data: bytes
    at_s: float


def listen(receiver: socket.socket, seconds: float) -> list[Datagram]:
    """Return the datagrams received within some seconds."""
    received = []
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        data, (_, port) = receiver.recvfrom(2048)
        received.append(Datagram(port, data, time.time()))
    return received


def wait_for_all(receiver: socket.socket, wearers: int) -> None:
    """Wait until poses of all wearers have arrived.

    Raises:
        TimeoutError: some wearers' poses do not arrive.
    """
    end_s = time.monotonic() + START_S
    ports: set[int] = set()
    while len(ports) < wearers:
        ports.add(receiver.recvfrom(2048)[1][1])
        if time.monotonic() > end_s:
            raise TimeoutError


def measure_program(model: str, wearers: int, seconds: float, core: int) -> ProgramRun:
    """Run the program on simulated wearers.

    Raises:
        TimeoutError: some wearers' poses do not arrive.
        click.ClickException: the program has ended.
    """
    context = multiprocessing.get_context("spawn")
    names, at_sender = context.Pipe(duplex=False)
    sender = context.Process(
        target=send, args=(wearers, START_S + SETTLE_S + seconds, at_sender), daemon=True
    )
    sender.start()
    with (
        tempfile.TemporaryDirectory() as folder,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
    ):
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(START_S)
        rigs = write_rigs(Path(folder), names.recv(), f"127.0.0.1:{receiver.getsockname()[1]}")
        process = subprocess.Popen(
            [sys.executable, "-m", "edgepose", "run", "--model", model, *rigs],
            preexec_fn=lambda: os.sched_setaffinity(0, {core}),
            stderr=subprocess.DEVNULL,
        )
        try:
            wait_for_all(receiver, wearers)
            listen(receiver, SETTLE_S)
            started_s, before_s = time.monotonic(), processor_s(process.pid)
            received = listen(receiver, seconds)
            passed_s, spent_s = time.monotonic() - started_s, processor_s(process.pid) - before_s
        except TimeoutError:
            if process.poll() is not None:
                raise click.ClickException(f"{wearers} wearers: edgepose run ended") from None
            process.kill()
            raise
        finally:
            process.send_signal(signal.SIGINT)
            process.wait()
            sender.terminate()
            sender.join()
    poses = [decode_binary(datagram.data) for datagram in received]
    ahead_s = archive.read_info(archive.find_archive(model)).metadata["future"] / RATE
    ages = np.array(
        [datagram.at_s - pose.time_s - ahead_s for datagram, pose in zip(received, poses, strict=True)]
    )
    numbers: defaultdict[int, list[int]] = defaultdict(list)
    for datagram, pose in zip(received, poses, strict=True):
        numbers[datagram.port].append(pose.index)
    expected = sum(indices[-1] - indices[0] + 1 for indices in numbers.values())
    p50, p99 = np.percentile(1e3 * ages, [50, 99])
    return ProgramRun(
        spent_s / passed_s,
        p50,
        p99,
        float((ages > LATE_S).mean()),
        expected - len(ages),
        len(ages) / passed_s / wearers,
    )


# --- the page -----------------------------------------------------------------------------------------------


def draw(file: Path, rows: dict[str, dict[int, tuple[float, ProgramRun]]]) -> None:
    """Draw the share of the core and the ages against the number of wearers."""
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
    for model, results in rows.items():
        counts = list(results)
        line = left.plot(
            counts, [100 * run.core for _, run in results.values()], "o-", label=f"{model}, whole"
        )
        color = line[0].get_color()
        share = [us * RATE * count / 1e4 for count, (us, _) in results.items()]
        left.plot(counts, share, ":", color=color, label=f"{model}, network")
        right.plot(
            counts, [run.p99_ms for _, run in results.values()], "o-", color=color, label=f"{model}, p99"
        )
        right.plot(
            counts, [run.p50_ms for _, run in results.values()], ":", color=color, label=f"{model}, p50"
        )
    right.axhline(1e3 * LATE_S, color="grey", linewidth=0.8, label="two frames")
    right.set_yscale("log")
    left.set_ylabel("% of a core")
    right.set_ylabel("age of a pose when it arrives, ms")
    for axes in (left, right):
        axes.set_xscale("log", base=2)
        axes.set_xticks(counts, [str(count) for count in counts])
        axes.set_xlabel("wearers, 60 poses a second each")
        axes.legend()
        axes.grid(alpha=0.3)
    figure.savefig(file, dpi=110)


@click.command(help=__doc__)
@click.argument("counts", nargs=-1, type=click.IntRange(1), metavar="[WEARERS]...")
@click.option("--model", "models", multiple=True, help="[default: rnn and birnn]")
@click.option(
    "--seconds", type=click.FloatRange(1), default=10.0, show_default=True, help="Measured time of each run."
)
@click.option("--core", type=click.IntRange(0), default=0, show_default=True, help="Core for edgepose run.")
@click.option("--draw", "picture", type=click.Path(path_type=Path), metavar="FILE", help="Picture to draw.")
def main(
    counts: tuple[int, ...], models: tuple[str, ...], seconds: float, core: int, picture: Path | None
) -> None:
    """Run the command line."""
    others = os.sched_getaffinity(0) - {core}
    if not others:
        raise click.ClickException("this machine has only one core; the simulator needs another one")
    os.sched_setaffinity(0, others)
    rows: dict[str, dict[int, tuple[float, ProgramRun]]] = {}
    heads = ["model", "wearers", "network us", "all us", "core", "p50 ms", "p99 ms", "late", "lost", "holds"]
    click.echo("| " + " | ".join(heads) + " |\n" + "|---" * len(heads) + "|")
    for model in models or ("rnn", "birnn"):
        results = rows[model] = {}
        for count in counts or (1, 2, 4, 8, 16, 32, 48, 64):
            us = network_us(model, count)
            try:
                run = measure_program(model, count, seconds, core)
            except TimeoutError:  # so far behind that poses of some wearers never come
                if not results:
                    raise click.ClickException(f"{count} wearers: no poses of some of them") from None
                cells = [model, str(count), f"{us:.0f}", *["-"] * 6, "no"]
                click.echo("| " + " | ".join(cells) + " |")
                break
            results[count] = us, run
            all_us = 1e6 * run.core / (count * run.per_s)
            cells = [model, count, f"{us:.0f}", f"{all_us:.0f}", f"{run.core:.0%}"]
            cells += [f"{run.p50_ms:.1f}", f"{run.p99_ms:.1f}", f"{run.late:.1%}", run.lost]
            cells.append("yes" if run.holds else "no")
            click.echo("| " + " | ".join(map(str, cells)) + " |")
    for model, results in rows.items():
        most = max((count for count, (_, run) in results.items() if run.holds), default=0)
        click.echo(f"{model}: holds for up to {most} wearers")
    if picture is not None:
        draw(picture, rows)


if __name__ == "__main__":
    main()
