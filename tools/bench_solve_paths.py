"""Paths of `edgepose solve`, and its accuracy on real wearers.

    OMP_NUM_THREADS=1 python tools/bench_solve_paths.py place --data recordings/ --part cmu-walk-run
    OMP_NUM_THREADS=1 python tools/bench_solve_paths.py real

`place` measures paths on the takes of `bench_solve.py table`, `real` poses and paths of the real wearers in
tests/data/real.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parent))

from bench_solve import RATE, Sample, own_body, plain_sip, takes, with_network

from edgepose.inference.model import Model
from edgepose.sip.measurements import Measurements
from edgepose.sip.translation import pelvis_path
from edgepose.skeleton import Body, default_body

Array = NDArray[np.float64]

DISTANCES_M = (3.0, 7.0)
"""Lengths of the windows of a path in which its error is measured, metres."""


def place_errors(found: Array, true: Array) -> dict[str, Array]:
    """Return errors of a path (T, 3): in % of the distance, after 10 s, and of the height since the start."""
    steps = np.linalg.norm(np.diff(true[:, [0, 2]], axis=0), axis=1)
    distance, error = np.concatenate([[0.0], np.cumsum(steps)]), found - true
    columns = {}
    for length in DISTANCES_M:
        ends = np.searchsorted(distance, distance + length)
        starts = np.flatnonzero(ends < len(distance))[::10]
        moved = (error[ends[starts]] - error[starts])[:, [0, 2]]
        columns[f"% of {length:g} m"] = 100.0 * np.linalg.norm(moved, axis=1) / length
    frames = round(10.0 * RATE)
    moved = (error[frames:] - error[:-frames])[::10, [0, 2]] if len(error) > frames else np.empty((0, 2))
    columns["10 s, cm"] = 100.0 * np.linalg.norm(moved, axis=1)
    columns["height, cm"] = 100.0 * np.abs(error[:, 1] - np.median(error[:30, 1]))
    return columns


def place_table(samples: Iterable[Sample], body: Body) -> None:
    """Print mean errors of the paths: by birnn's contacts, by those of its poses, by those of SIP alone."""
    guided = with_network("birnn", body)
    plain = plain_sip(body)
    values: dict[str, dict[str, list[Array]]] = {}
    for sample in samples:
        assert sample.path is not None, "recordings of edgepose synthesize have paths"
        solution, place = guided(sample.measurements)
        alone = plain(sample.measurements)
        runs = {
            "SIP, prior birnn": (solution, place),
            "without its contacts": (solution, None),
            "SIP": (alone, None),
        }
        for name, (poses, contacts) in runs.items():
            path = pelvis_path(poses, body.offsets, RATE, contacts).translation
            for key, column in place_errors(path, sample.path).items():
                values.setdefault(name, {}).setdefault(key, []).append(column)
    for name, columns in values.items():
        joined = {key: np.concatenate(column) for key, column in columns.items()}
        cells = [f"{key} {column.mean():.1f}" for key, column in joined.items() if len(column)]
        print(f"{name:22}", ", ".join(cells), f"(largest {joined['height, cm'].max():.0f})")


def real() -> None:
    """Print the errors of the walker's unmeasured bones, and the paths of both wearers."""
    from edgepose_export.evaluation import real_wearers as wearers

    body, methods = default_body(), ("rnn", "birnn", "SIP", "SIP, prior rnn", "SIP, prior birnn")
    walker = wearers.read_walker(wearers.FOLDER)
    measured = _real_measurements(wearers.FILES[0], wearers.WALKER)
    poses = {name: Model(name).poses(*walker.take[1:3]).astype(float) for name in methods[:2]}
    solved = {"SIP": (plain_sip(body)(measured), None)}
    solved |= {f"SIP, prior {name}": with_network(name, body)(measured) for name in methods[:2]}
    nearest = np.searchsorted(measured.time_s[:-1], walker.time_s - 0.5 / RATE)
    poses |= {name: solution.rotations[nearest] for name, (solution, _) in solved.items()}
    for part, span in wearers.WALKER.parts.items():
        rows = {name: wearers.walker_columns(walker, poses[name], span) for name in methods}
        print(wearers.format_table(f"walker, {part}: error, deg", rows))
    for name, file, about in (
        ("walker", wearers.FILES[0], wearers.WALKER),
        ("sitter", wearers.FILES[2], wearers.SITTER),
    ):
        measured = _real_measurements(file, about)
        solution, place = with_network("birnn", body)(measured)
        path = pelvis_path(solution, body.offsets, RATE, place).translation
        parts = {**about.parts, **({"walk": wearers.STRAIGHT_WALK} if name == "sitter" else {})}
        for part, (start, end) in parts.items():
            inside = path[(measured.time_s >= start) & (measured.time_s < end)]
            moved_m = np.linalg.norm((inside[-1] - inside[0])[[0, 2]])
            heights = (
                f"{inside[:, 1].mean():.3f} m high, from {inside[:, 1].min():.3f} to {inside[:, 1].max():.3f}"
            )
            print(f"{name}, {part}: pelvis {heights}; {moved_m:.2f} m away from the start of this part")


def _real_measurements(file: str, about: Any) -> Measurements:
    """Return what `edgepose solve` makes of a real wearer's recording."""
    from edgepose.formats.recordings.registry import read_recording
    from edgepose.sip.measurements import measure, mounts
    from edgepose_export.evaluation import real_wearers as wearers

    path = wearers.FOLDER / file
    calibration, _ = wearers.calibrated(path, about, RATE)
    return measure(read_recording(path), mounts(calibration), RATE)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="paths of edgepose solve, and its accuracy on real wearers")
    commands = parser.add_subparsers(dest="command", required=True)
    paths = commands.add_parser("place", help="paths on held-out motion capture")
    paths.add_argument("--data", type=Path, required=True, help="folder written by edgepose synthesize")
    paths.add_argument("--part", default="cmu-walk-run", help="part of the split")
    paths.add_argument("--every", type=int, default=1, metavar="N", help="use every Nth take only")
    paths.add_argument("--frames", type=int, metavar="N", help="use the middle N frames of each take only")
    commands.add_parser("real", help="poses and paths of real wearers")
    flags = parser.parse_args()
    if flags.command == "real":
        real()
    else:
        body = own_body(np.random.default_rng(0))
        place_table(takes(flags.data, flags.part, flags.every, body, flags.frames), body)


if __name__ == "__main__":
    main()
