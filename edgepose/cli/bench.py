"""`edgepose bench`: how well and how fast parts of the program do their work, on data with known truth."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from edgepose.orientation.comparison import Score


@click.group(short_help="Measure accuracy and speed.")
def bench() -> None:
    """Measure how well and how fast parts of the program do their work.

    \b
    Example:
      edgepose bench orientation --data broad/data_mat
    """


@bench.command(short_help="Orientation filters on BROAD.")
@click.option(
    "--data",
    required=True,
    type=click.Path(path_type=Path),
    help="Folder of trials: data_mat of the BROAD download, or .npz files with the same arrays.",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON in the place of tables.")
def orientation(data: Path, as_json: bool) -> None:
    """Compare orientation filters on BROAD: ours, and of vqf, imufusion and ahrs what is installed.

    Errors are means over trials of root mean squares over their movement, in degrees; the time is that of one
    core for each sample.

    \b
    Example:
      edgepose bench orientation --data broad/data_mat
    """
    from edgepose.broad import find_trials, read_trial
    from edgepose.orientation.comparison import compare, cost_us

    files = find_trials(data)
    scores = [score for of_trial in _with_progress(compare(files), len(files)) for score in of_trial]
    cost = cost_us(read_trial(files[0]))
    if as_json:
        rows = [score._asdict() for score in scores]
        click.echo(json.dumps({"scores": rows, "us_a_sample_at_286_hz": cost}, indent=1))
        return
    click.echo(f"{len(files)} trials; RMSE over movement in deg, mean over trials; us a sample on one core\n")
    click.echo("with magnetometer")
    click.echo(_table(scores, magnetometer=True))
    click.echo("\nwithout; heading set to the truth's in the first second of motion")
    click.echo(_table(scores, magnetometer=False))
    click.echo(f"\nedgepose, online, at 286 Hz: {cost:.1f} us a sample of a sensor on one core")


def _with_progress(trials: Iterable[list[Score]], count: int) -> Iterator[list[Score]]:
    """The scores, with a bar on a terminal and a line for each trial elsewhere."""
    if sys.stderr.isatty():
        with click.progressbar(
            trials, length=count, label="Filtering", file=sys.stderr, show_pos=True
        ) as bar:
            yield from bar
        return
    for number, scores in enumerate(trials, start=1):
        yield scores
        click.echo(f"{number} of {count}  {scores[0].trial}", err=True)


def _table(scores: list[Score], magnetometer: bool) -> str:
    """A line for each filter."""
    rows = [("filter", "", "total", "heading", "inclination", "undisturbed", "disturbed", "us")]
    for name in dict.fromkeys(score.filter for score in scores):
        own = [score for score in scores if score.filter == name and score.magnetometer == magnetometer]
        rows.append(
            (
                name,
                "offline" if own[0].offline else "online",
                _mean([score.total for score in own]),
                _mean([score.heading for score in own]),
                _mean([score.inclination for score in own]),
                _mean([score.total for score in own if not score.disturbed]),
                _mean([score.total for score in own if score.disturbed]),
                f"{sum(score.us for score in own) / len(own):.1f}",
            )
        )
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if place < 2 else cell.rjust(width)
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    )


def _mean(values: list[float]) -> str:
    return f"{sum(values) / len(values):.2f}" if values else "-"
