"""Measures `edgepose convert` on many files, one of them broken: recordings to NPZ, poses to BVH and NPZ.

Sensors at rest and slowly rotating joints are written to one CSV file each. The other files are links to it,
so that the disk is not measured. The broken file has a row of nonsense in the middle and ends soon after it.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import click
import numpy as np

from edgepose.formats.recordings.csv import write_csv
from edgepose.imu import Recording, SensorData
from edgepose.placements import PLACEMENTS
from edgepose.pose import PoseFrame
from edgepose.rotations import rotvec_to_matrix
from edgepose.sinks.csv import CsvSink

RATE, POSE_RATE = 100, 60


@click.command()
@click.option(
    "--files", type=click.IntRange(2), default=500, show_default=True, help="Number of files of each kind."
)
@click.option(
    "--seconds", type=click.FloatRange(1.0), default=30.0, show_default=True, help="Length of each file."
)
@click.option(
    "--jobs", type=click.IntRange(1), default=2, show_default=True, help="Passed on to edgepose convert."
)
def bench(files: int, seconds: float, jobs: int) -> None:
    """Make the files, convert them, and print how long that took."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_recording(folder / "recording.csv", seconds)
        write_poses(folder / "poses.csv", seconds)
        for kind, to in (("recording", "npz"), ("poses", "bvh"), ("poses", "npz")):
            inputs = folder / f"{kind}-{to}"
            fill(folder / f"{kind}.csv", inputs, files)
            megabytes = sum(path.stat().st_size for path in inputs.iterdir()) / 1e6
            taken_s, results = convert(inputs, to, folder / f"out-{kind}-{to}", jobs)
            whole = sum(line.endswith("  ok") for line in results)
            click.echo(
                f"{files} files of {kind}, {megabytes:.0f} MB, to {to} with --jobs {jobs}: {taken_s:.0f} s, "
                f"{whole} whole, {files - whole} damaged"
            )


def write_recording(path: Path, seconds: float) -> None:
    """Write a recording of six sensors at rest."""
    count = round(seconds * RATE)
    noise = np.random.default_rng(0).normal(scale=0.05, size=(2, count, 3))
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    data = SensorData(np.arange(count) / RATE, quat, noise[0] + [0.0, 0.0, 9.81], noise[1])
    write_csv(path, Recording(dict.fromkeys(PLACEMENTS, data), {"rate": str(RATE)}))


def write_poses(path: Path, seconds: float) -> None:
    """Write poses in which all joints rotate slowly."""
    with CsvSink(path) as sink:
        for i in range(round(seconds * POSE_RATE)):
            vectors = 0.3 * np.sin(np.arange(72).reshape(24, 3) + i / POSE_RATE)
            sink.write(PoseFrame(i, i / POSE_RATE, rotvec_to_matrix(vectors), np.zeros(24)))


def fill(path: Path, folder: Path, count: int) -> None:
    """Make links to a file, and one broken file."""
    folder.mkdir()
    for i in range(count - 1):
        os.link(path, folder / f"{i:03d}.csv")
    lines = path.read_text().splitlines(keepends=True)
    half = len(lines) // 2
    (folder / "broken.csv").write_text("".join([*lines[:half], "nonsense\n", *lines[half : half + 9]]))


def convert(inputs: Path, to: str, out: Path, jobs: int) -> tuple[float, list[str]]:
    """Return the seconds that the command took, and the rows of its table."""
    command = [
        sys.executable,
        "-m",
        "edgepose",
        "convert",
        inputs,
        "--to",
        to,
        "--out",
        out,
        "--overwrite",
        "--jobs",
        jobs,
    ]
    started = time.monotonic()
    result = subprocess.run([*map(str, command)], text=True, capture_output=True, check=False)
    if result.returncode != 1:  # because of the broken file
        raise click.ClickException(result.stderr)
    return time.monotonic() - started, result.stdout.splitlines()[1:]


if __name__ == "__main__":
    bench()
