"""Draws poses of a CSV file as a strip of stick figures, with reference poses if there are any."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from edgepose.analysis.figures import skeleton_strip
from edgepose.errors import EdgeposeError
from edgepose.formats.poses.registry import read_poses
from edgepose.skeleton import default_body

HEIGHT_M = 1.75


def nearest(times: NDArray[np.float64], wanted: NDArray[np.float64], name: str) -> NDArray[np.intp]:
    """Return the index of the time nearest to each wanted one.

    Raises:
        EdgeposeError: a wanted time lies outside `times`; both are seconds since the first pose.
    """
    for t in wanted:
        if not times.min() - 0.5 <= t <= times.max() + 0.5:
            raise EdgeposeError(
                f"{name} has no pose at {t:.2f} s, only from {times.min():.2f} to {times.max():.2f} s"
            )
    return np.abs(times[None, :] - wanted[:, None]).argmin(axis=1)


def draw(poses: str, out: Path, wanted: list[float] | None, count: int, reference: str | None) -> None:
    """Read the poses, choose the instants (seconds since the first pose) and draw."""
    _, times, rotations = read_poses(poses)[:3]
    start = times[0]
    times = times - start
    if wanted:
        chosen = nearest(times, np.array(wanted), poses)
    else:
        chosen = np.unique(np.linspace(0, len(times) - 1, count).round().astype(int))
    beside = None
    if reference:
        _, reference_times, reference_rotations = read_poses(reference)[:3]
        beside = reference_rotations[nearest(reference_times - start, times[chosen], reference)]
    offsets = default_body(HEIGHT_M).offsets
    skeleton_strip(out, rotations[chosen], times[chosen], offsets, beside)


def _times(context: click.Context, option: click.Parameter, text: str | None) -> list[float] | None:
    try:
        return [float(t) for t in text.split(",")] if text else None
    except ValueError as error:
        raise click.BadParameter("give numbers separated by commas, for example 0,1.5,3") from error


@click.command()
@click.argument("poses")
@click.option("--reference", metavar="CSV", help="Poses to draw in grey below, on the same clock.")
@click.option(
    "--times", callback=_times, metavar="A,B,C", help="Instants to draw, seconds since the first pose."
)
@click.option(
    "--count",
    type=click.IntRange(1, 50),
    default=8,
    show_default=True,
    help="Number of evenly spaced instants, without --times.",
)
@click.option(
    "--out", type=click.Path(path_type=Path), required=True, help="Picture to write: .png, .svg or .pdf."
)
def main(poses: str, reference: str | None, times: list[float] | None, count: int, out: Path) -> None:
    """Draw the poses of the CSV file POSES, as edgepose run --csv writes it, as a strip of stick figures."""
    try:
        draw(poses, out, times, count, reference)
    except EdgeposeError as error:
        raise click.ClickException(str(error)) from error


if __name__ == "__main__":
    main()
