"""Draws docs/images/drift.png from the figures of `bench_drift.py`: errors over twenty minutes.

python tools/draw_drift.py drift.json
"""

from __future__ import annotations

import json
from pathlib import Path

import click
import matplotlib

OUT = Path(__file__).parents[1] / "docs" / "images" / "drift.png"
COLOURS = {
    "no drift": "0.3",
    "no drift, corrected": "#2a9d5c",
    "drift": "#d98c3f",
    "drift, corrected": "#1f6fb4",
}


@click.command()
@click.argument("figures", type=click.Path(path_type=Path, exists=True))
@click.option("--model", default="rnn", show_default=True)
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), default=OUT, show_default=True)
def main(figures: Path, model: str, out: Path) -> None:
    """Draw the picture."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    tracks = json.loads(figures.read_text(encoding="utf-8"))[model]["tracks"]
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.6), constrained_layout=True)
    for name, colour in COLOURS.items():
        line = tracks[name]
        left.plot(line["minutes"], line["headings"], "o-", color=colour, label=name)
        right.plot(line["minutes"], line["joints"], "o-", color=colour, label=name)
    left.set(title="Headings against the pelvis", ylabel="mean error, deg", ylim=(0, None))
    right.set(title=f"15 joints, {model}", ylabel="mean error, deg", ylim=(0, None))
    for axes in (left, right):
        axes.set(xlabel="minutes since the calibration", xticks=tracks["drift"]["minutes"])
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False, fontsize=9)
    figure.savefig(out, dpi=90)


if __name__ == "__main__":
    main()
