"""Demo from end to end: six simulated IMUs on a serial port, calibration, poses, and their errors.

A body moves as in a motion-capture clip that no shipped model was trained on. Six virtual sensors, strapped
on at random angles, send native packets over a pty in real time, or another wire format over one pty, six
ptys, or a CAN adapter on a pty. The demo runs the same commands as a real wearer.
"""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.analysis.figures import skeleton_strip
from edgepose.analysis.metrics import format_table, summary
from edgepose.formats.poses.registry import read_poses
from edgepose.skeleton import default_body
from firmware_protocols.registry import PROTOCOLS

CLIP = Path(__file__).parent / "data" / "09_12.bvh"
HOLD_S = 6.0
RATE = 100.0  # of the simulated sensors, Hz

Array = NDArray[np.float64]


class Truth(NamedTuple):
    """True local poses (T, 24, 3, 3) at times (T,), seconds since the start of the clip."""

    time_s: Array
    pose: Array

    def at(self, time_s: Array) -> Array:
        """Interpolate poses at other times, by slerp."""
        i = np.clip(np.searchsorted(self.time_s, time_s) - 1, 0, len(self.time_s) - 2)
        share = (time_s - self.time_s[i]) / (self.time_s[i + 1] - self.time_s[i])
        quats = rot.matrix_to_quat(self.pose)
        return rot.quat_to_matrix(rot.slerp(quats[i], quats[i + 1], np.repeat(share[:, None], 24, axis=1)))


def edgepose(*words: object) -> list[str]:
    """Return a command line for edgepose in this environment; print it as a user would type it."""
    text = [str(word) for word in words]
    click.echo("\n$ " + " ".join(["edgepose", *text]), err=True)
    return [sys.executable, "-m", "edgepose", *text]


@contextmanager
def simulator(
    recording: Path, protocol: str, flags: Sequence[str] = ()
) -> Iterator[tuple[subprocess.Popen[str], list[str]]]:
    """Start the simulated sensors, standing still; yield the process and the flags that name its lines."""
    words = [sys.executable, str(Path(__file__).parent / "simulate.py"), str(recording), "--stand"]
    words += ["--protocol", protocol, *flags]
    process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    kind = "can" if PROTOCOLS[protocol].transport == "can" else "port"
    try:
        yield process, [f"--{kind}", read_reply(process, kind)]
    finally:
        assert process.stdin
        assert process.stdout
        process.stdin.close()
        process.wait(10)
        process.stdout.close()


def read_reply(process: subprocess.Popen[str], word: str) -> str:
    """Wait for the simulator to print a line that starts with a word; return the next word."""
    assert process.stdout
    for line in process.stdout:
        if line.startswith(word + " "):
            return line.split()[1]
    raise SystemExit(f"the simulator ended before it printed {word!r}")


class Listener(threading.Thread):
    """Receiver of a run's datagrams, as pairs of Unix arrival time and pose."""

    def __init__(self) -> None:
        """Bind to a free local port."""
        super().__init__(daemon=True)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.port: int = self.socket.getsockname()[1]
        self.first = threading.Event()
        self.received: list[tuple[float, dict[str, object]]] = []

    def run(self) -> None:
        """Receive until the process ends."""
        while True:
            data = self.socket.recv(65536)
            self.received.append((time.time(), json.loads(data)))
            self.first.set()


def follow(process: subprocess.Popen[str], source: list[str], out: Path) -> tuple[float, float, Listener]:
    """Calibrate, start a run, and let the clip play.

    Args:
        process: the simulated sensors.
        source: flags that name the sensors' lines.
        out: folder for results.

    Returns:
        Unix times of the start and end of the clip, and the receiver of the UDP datagrams.
    """
    calibration = out / "calibration.json"
    hold = ("--body-frame", "heading:0", "--hold", 3, "--countdown", 1)
    subprocess.run(edgepose("calibrate", *source, *hold, "--out", calibration, "--overwrite"), check=True)
    listener = Listener()
    listener.start()
    outputs = ("--csv", out / "poses.csv", "--overwrite", "--udp", f"127.0.0.1:{listener.port}")
    run = subprocess.Popen(edgepose("run", *source, "--calibration", calibration, *outputs))
    try:
        while not listener.first.wait(0.5):
            if run.poll() is not None:
                raise SystemExit("edgepose run ended before the first pose")
        assert process.stdin
        process.stdin.write("go\n")
        process.stdin.flush()
        begin, end = float(read_reply(process, "started")), float(read_reply(process, "ended"))
        time.sleep(0.5)  # the last frames still wait for their future frames
    finally:
        run.send_signal(signal.SIGINT)
        code = run.wait(20)
    if code:
        raise SystemExit(f"edgepose run failed with exit code {code}")
    return begin, end, listener


def report(begin: float, end: float, listener: Listener, truth: Truth, out: Path) -> None:
    """Print errors, latencies and rates over the clip, and draw it."""
    read = read_poses(out / "poses.csv")
    frames, time_s, status, poses = read.frames, read.time_s, read.status, read.rotations
    missing = np.sum(np.diff(frames) - 1)
    click.echo(
        f"\nposes.csv: {len(frames)} frames at 60 Hz, {missing} frames missing between the first and the last"
    )
    clip = (time_s >= begin + HOLD_S + 1.0) & (time_s <= end)
    seconds = time_s[clip] - begin
    true = truth.at(seconds)
    offsets = default_body().offsets
    ok = np.mean(np.array(status)[clip] == "ok")
    click.echo(f"clip: {clip.sum()} frames in {seconds[-1] - seconds[0]:.1f} s; status ok in {ok:.1%}")
    click.echo("\nError against the clip's true poses:")
    click.echo(format_table({"birnn, online": summary(poses[clip], true, offsets, 60.0)}))
    delays = np.array([arrived - float(str(pose["time_s"])) for arrived, pose in listener.received]) * 1e3
    p50, p99 = np.percentile(delays, [50, 99])
    click.echo(f"\nFrom measurement to the pose's arrival by UDP: {p50:.0f} ms median, {p99:.0f} ms p99")
    click.echo("(83 ms of that are the network's 5 future frames; --model rnn waits for none)")
    wanted = np.linspace(0, len(seconds) - 1, 10).round().astype(int)
    picture = out / "skeletons.png"
    skeleton_strip(
        picture, poses[clip][wanted], seconds[wanted] - seconds[0], offsets, true[wanted],
        title="CMU 09_12: poses from six IMUs (above) and the true ones (grey)",
    )  # fmt: skip
    click.echo(f"\nwrote {out / 'poses.csv'} and {picture}")


@click.command(help=__doc__)
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("demo-output"), help="Folder for results."
)
@click.option(
    "--protocol",
    type=click.Choice([name for name, each in PROTOCOLS.items() if each.transport != "udp"]),
    default="native",
    show_default=True,
    help="Wire format of the sensors.",
)
def main(out: Path, protocol: str) -> None:
    """Run the command line."""
    out.mkdir(parents=True, exist_ok=True)
    recording = out / CLIP.with_suffix(".npz").name
    rig = ("--hold", HOLD_S, "--rate", RATE, "--mounting", 7)
    subprocess.run(edgepose("synthesize", CLIP, "--out", out, "--overwrite", *rig), check=True)
    with np.load(recording) as data:
        truth = Truth(data["t"], rot.rotvec_to_matrix(data["poses"].reshape(-1, 24, 3)))
    with simulator(recording, protocol) as (process, source):
        click.echo(
            f"\nsix simulated IMUs are at rest and send {RATE:g} samples per second to {source[1]}", err=True
        )
        if protocol != "native":
            source += ["--protocol", protocol]
        results = follow(process, source, out)
    report(*results, truth, out)


if __name__ == "__main__":
    main()
