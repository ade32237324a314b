"""Draws error against cost for each model in each precision, to show which are worthwhile.

    python tools/draw_front.py --data recordings --out front.png birnn rnn runs/dip-rnn.pt

Error is the mean over the frames of the chosen parts of the split (recordings of `edgepose synthesize`),
streamed as `edgepose run` streams. Cost is processor time per frame on one core.
"""

from __future__ import annotations

from pathlib import Path

import click
import torch

from edgepose.benchmarks import speed
from edgepose.inference import archive
from edgepose_export.evaluation.evaluate import modes_of
from edgepose_export.evaluation.quantisation import compare

KEY = "sip_error_deg"


@click.command()
@click.argument("models", nargs=-1, required=True)
@click.option("--data", type=click.Path(path_type=Path), required=True, help="Folder written by synthesize.")
@click.option("--part", "parts", multiple=True, default=["cmu-walk-run", "cmu-02"], show_default=True)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Picture to write.")
def main(models: tuple[str, ...], data: Path, parts: tuple[str, ...], out: Path) -> None:
    """Measure, print and draw."""
    torch.set_num_threads(1)
    points: dict[str, dict[str, tuple[float, float]]] = {}
    for name in models:
        info = archive.read_info(archive.find_archive(name))
        mode = next(mode for mode in modes_of(info.metadata) if mode.name == "stream")
        measured = compare(lambda info=info: archive.load(info, trust=True), data, parts, mode)
        costs = {
            row.precision: row.us for row in speed.model_speeds(info, trust=True) if row.mode == "stream"
        }
        for precision, us in costs.items():
            rows = [measured[part][precision]["errors"][KEY] for part in parts]
            error = sum(mean * frames for mean, _, frames in rows) / sum(frames for *_, frames in rows)
            points.setdefault(info.path.stem, {})[precision] = (us, error)
            click.echo(f"| {info.path.stem} | {precision} | {us:.0f} | {error:.2f} |")
    draw(points, ", ".join(parts), out)


def draw(points: dict[str, dict[str, tuple[float, float]]], title: str, out: Path) -> None:
    """Draw the picture: a line per model, a point (us, degrees) per precision."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    for name, precisions in points.items():
        axes.plot(*zip(*precisions.values(), strict=True), "o-", label=name)
        for precision, point in precisions.items():
            axes.annotate(
                precision, point, xytext=(0, 6), textcoords="offset points", fontsize=8, rotation=45
            )
    axes.set(xlabel="microseconds per frame", ylabel=f"SIP error, deg ({title})")
    axes.margins(x=0.1, y=0.15)
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    main()
