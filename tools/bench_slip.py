"""Counts how often a sensor that slips on its limb is found, and how often one that does not is reported.

\b
    bench_slip.py RECORDING.npz...

The recordings are of `edgepose synthesize`; those in one folder are joined to one long run, without noise.
Each sensor slips at its beginning by each angle, about four level axes. Short runs are passed over.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path

import click
import numpy as np

from edgepose import rotations as rot
from edgepose.calibration import POSES
from edgepose.calibration.slip import Slip, SlipMonitor
from edgepose.placements import BONES, PLACEMENTS
from edgepose.rotations import Array
from edgepose.skeleton import global_rotations

ANGLES_DEG = (20.0, 25.0, 30.0, 35.0, 40.0, 50.0)
AXES = 4
RATE = 10.0


def bones_of(path: Path) -> Array:
    """Return the bones (T, 6, 3, 3) of the motion in a recording, at `RATE`."""
    with np.load(path, allow_pickle=False) as arrays:
        poses, rate = arrays["poses"].astype(float), float(arrays["mocap_framerate"])
    local = rot.rotvec_to_matrix(poses[:: max(1, round(rate / RATE))].reshape(-1, 24, 3))
    return global_rotations(local)[:, list(BONES)]


def runs(paths: Sequence[Path]) -> Mapping[str, Array]:
    """Return the joined bones of each folder."""
    folders = groupby(sorted(paths), key=lambda path: path.parent)
    return {str(folder): np.concatenate([bones_of(path) for path in some]) for folder, some in folders}


def slips(bones: Array) -> list[Slip]:
    """Return the slips that are reported in a run."""
    monitor = SlipMonitor(north=True)
    return [slip for k, instant in enumerate(bones) for slip in monitor.update(k / RATE, instant)]


def slipped(bones: Array, i: int, angle_deg: float, axis: int) -> Array:
    """Turn one bone about one of the level axes in the straight pose."""
    towards = np.pi * 2.0 * axis / AXES
    level = POSES["straight"][i].T @ [np.cos(towards), 0.0, np.sin(towards)]
    turned = bones.copy()
    turned[:, i] = bones[:, i] @ rot.rotvec_to_matrix(np.radians(angle_deg) * level)
    return turned


@click.command(help=__doc__)
@click.argument("recordings", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
def main(recordings: tuple[Path, ...]) -> None:
    """Run the command line."""
    folders = runs(recordings)
    minutes = sum(map(len, folders.values())) / RATE / 60.0
    false = [f"{folder}: {slip}" for folder, bones in folders.items() for slip in slips(bones)]
    click.echo(f"{len(false)} false reports in {minutes:.0f} minutes")
    click.echo("".join(f"{line}\n" for line in false), nl=False)
    click.echo(f"{'found of 100 slips by':20}" + "".join(f"{angle:7.0f} deg" for angle in ANGLES_DEG))
    for i, name in enumerate(PLACEMENTS):
        found: dict[float, list[bool]] = defaultdict(list)
        for bones in folders.values():
            # Only runs in which the largest slip is found: others are too short, or never upright.
            if not _found(bones, i, 60.0, 0):
                continue
            for angle in ANGLES_DEG:
                found[angle] += [_found(bones, i, angle, axis) for axis in range(AXES)]
        click.echo(f"{name:20}" + "".join(f"{100 * np.mean(found[angle]):11.0f}" for angle in ANGLES_DEG))


def _found(bones: Array, i: int, angle_deg: float, axis: int) -> bool:
    return any(slip.placement == PLACEMENTS[i] for slip in slips(slipped(bones, i, angle_deg, axis)))


if __name__ == "__main__":
    main()
