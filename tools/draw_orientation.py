"""Draws docs/images/orientation.png: errors of our filters and of VQF over time in a trial of BROAD."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from vqf import VQF

from edgepose.benchmarks.broad import error_angles, errors, read_trial
from edgepose.orientation import OrientationFilter, smooth

ROOT = Path(__file__).parents[1]
TRIAL = ROOT / "tests" / "data" / "broad" / "28_disturbed_stationary_magnet_A_95Hz.npz"
EVERY = 5  # draw every 5th row, which is as fine as the picture


def main() -> None:
    """Draw the picture."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    trial = read_trial(TRIAL)
    measured = trial.gyr, trial.acc, trial.mag
    online = OrientationFilter().update(trial.time_s, *measured)
    lines = {
        "vqf": (VQF(1 / trial.rate).updateBatch(*measured)["quat9D"], "#d98c3f"),
        "edgepose": (online.quat, "#1f6fb4"),
        "edgepose smoother": (smooth(trial.time_s, *measured).quat, "#2a9d5c"),
    }
    figure, axes = plt.subplots(figsize=(9, 3.6), constrained_layout=True)
    for name, (quat, color) in lines.items():
        error = np.rad2deg(error_angles(quat, trial.quat)[0])
        label = f"{name}: RMSE {errors(quat, trial).total:.1f} deg"
        axes.plot(trial.time_s[::EVERY], error[::EVERY], color=color, lw=1, label=label)
    axes.fill_between(
        trial.time_s,
        0,
        1,
        where=online.disturbed,
        transform=axes.get_xaxis_transform(),
        color="0.85",
        lw=0,
        label="edgepose: field disturbed",
        zorder=0,
    )
    axes.set(
        title="BROAD trial 28, a magnet beside the path, with magnetometer",
        xlabel="time, s",
        ylabel="orientation error, deg",
        xlim=(0, trial.time_s[-1]),
        ylim=(0, 16),
    )
    axes.legend(loc="upper left", ncols=2, fontsize=8, frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(ROOT / "docs" / "images" / "orientation.png", dpi=110)


if __name__ == "__main__":
    main()
