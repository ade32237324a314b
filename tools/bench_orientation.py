"""Errors of our filter and smoother beside VQF's on BROAD, with and without magnetometer, by kind of trial.

With --cross-validate also leave-one-out: settings are chosen on all trials but one, and judged on that one.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from dataclasses import replace
from itertools import product
from math import radians
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edgepose.benchmarks.broad import Trial, errors, same_heading, trials
from edgepose.benchmarks.reference_filters import contenders
from edgepose.orientation import FilterSettings, OrientationFilter

ROOT = Path(__file__).parents[1]
FILTERS = ("edgepose", "vqf", "edgepose smoother", "offlineVQF")
KINDS = ("rotation", "translation", "combined", "tapping", "vibration", "magnet", "office", "mixed")
"""Words in the names of trials."""

GRID = {
    "gyr_noise": (radians(0.1), radians(0.4)),
    "sensitivity_start": (0.005, 0.02),
    "bias_walk": (radians(0.005), radians(0.02)),
}
"""Settings tried by --cross-validate: half and twice the defaults."""


def groups(names: list[str]) -> dict[str, list[int]]:
    """Return the indices of the trials of each group that there is, by the words in their names."""
    by_word = {
        word: [i for i, name in enumerate(names) if f"_{word}" in name]
        for word in ("undisturbed", "disturbed", *KINDS)
    }
    return {"all": list(range(len(names)))} | {word: rows for word, rows in by_word.items() if rows}


def total(quat: NDArray[np.float64], trial: Trial, magnetometer: bool) -> float:
    """Return the total error, deg; without a magnetometer after aligning the heading at the start."""
    return errors(quat if magnetometer else same_heading(quat, trial), trial).total


def table(of_trials: Iterable[Trial]) -> list[str]:
    """Return the lines of the table: mean total errors, deg."""
    run = {contender.name: contender.run for contender in contenders()}
    names, rows = [], []
    for trial in of_trials:
        names.append(trial.name)
        rows.append([total(run[name](trial, mag), trial, mag) for mag in (False, True) for name in FILTERS])
    heads = [f"{name}, {axes}" for axes in ("6-axis", "9-axis") for name in FILTERS]
    lines = ["| trials | n | " + " | ".join(heads) + " |", "|---" * (len(heads) + 2) + "|"]
    for group, chosen in groups(names).items():
        means = np.mean([rows[i] for i in chosen], axis=0)
        lines.append(f"| {group} | {len(chosen)} | " + " | ".join(f"{mean:.2f}" for mean in means) + " |")
    return lines


def cross_validate(of_trials: list[Trial], grid: dict[str, tuple[float, ...]]) -> list[str]:
    """Return a line per trial: settings chosen on the others, and the errors they leave on it, online."""
    choices = [dict(zip(grid, values, strict=True)) for values in product(*grid.values())]
    scores = np.array([[_online(replace(FilterSettings(), **c), t) for t in of_trials] for c in choices])
    lines, held_out = [], []
    for i, trial in enumerate(of_trials):
        best = int(np.delete(scores, i, axis=1).mean(axis=(1, 2)).argmin())
        held_out.append(scores[best, i])
        chosen = ", ".join(f"{name} {value:.3g}" for name, value in choices[best].items())
        six, nine = scores[best, i]
        lines.append(f"{trial.name}: 6-axis {six:.2f}, 9-axis {nine:.2f} ({chosen})")
    six, nine = np.mean(held_out, axis=0)
    worst = scores.mean(axis=1).max(axis=0)
    lines.append(f"left-out mean: 6-axis {six:.2f}, 9-axis {nine:.2f}")
    lines.append(f"worst settings of the grid, mean: 6-axis {worst[0]:.2f}, 9-axis {worst[1]:.2f}")
    return lines


def _online(settings: FilterSettings, trial: Trial) -> tuple[float, float]:
    measured = trial.time_s, trial.gyr, trial.acc
    without = OrientationFilter(settings).update(*measured).quat
    with_mag = OrientationFilter(settings).update(*measured, trial.mag).quat
    return total(without, trial, False), total(with_mag, trial, True)


def main() -> None:
    """Print the table, and with --cross-validate the left-out errors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--data",
        type=Path,
        default=ROOT / "tests" / "data" / "broad",
        help="folder of .npz or .mat files (default: the six trials of the tests)",
    )
    parser.add_argument("--cross-validate", action="store_true")
    args = parser.parse_args()
    print("\n".join(table(trials(args.data))), flush=True)
    if args.cross_validate:
        print("\n".join(cross_validate(list(trials(args.data)), GRID)))


if __name__ == "__main__":
    main()
