"""`edgepose bench`: measure accuracy and speed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from edgepose.cli.options.json_result import json_option, show_json
from edgepose.cli.terminal.messages import has_terminal, progress_bar, say, show

if TYPE_CHECKING:
    from edgepose.benchmarks.filter_comparison import Score


@click.group(invoke_without_command=True)
@click.option(
    "--model",
    "models",
    multiple=True,
    help="Shipped model or path of an archive; repeatable.  [default: all shipped models]",
)
@click.option("--trust", is_flag=True, help="Load models even if their checksums are unknown.")
@json_option
@click.option(
    "--against",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Compare with what --json printed before.",
)
@click.pass_context
def bench(
    ctx: click.Context, models: tuple[str, ...], trust: bool, as_json: bool, against: Path | None
) -> None:
    """Measure the accuracy and speed of parts of the program.

    Without a command, measure on one core of this machine the speed of every step from packets to poses, and
    of the models in all modes and precisions and in numpy, compared with a torch.nn.LSTM of the same size.
    The processor time of a live run at 60 Hz is what users pay: it is more than the sum of the steps, which
    run at full speed.

    \b
    Examples:
      edgepose bench
      edgepose bench --model my-birnn.pt --trust --json > before.json
      edgepose bench --model my-birnn.pt --trust --against before.json
      edgepose bench orientation --data broad/data_mat
    """
    if ctx.invoked_subcommand is None:
        _speed(models, trust, as_json, against)


def _speed(models: tuple[str, ...], trust: bool, as_json: bool, against: Path | None) -> None:
    from edgepose.inference import archive

    infos = [archive.read_info(archive.find_archive(name)) for name in models]
    infos = infos or [archive.read_info(path) for path in archive.bundled_archives()]
    if not infos:
        raise click.UsageError("no model is shipped; name one with --model")

    from tempfile import TemporaryDirectory

    from edgepose.cli.speed_tables import compared, ratio_table, read_report, speed_tables

    before = None if against is None else read_report(against)
    from edgepose.benchmarks import speed
    from edgepose.benchmarks.live_run import live_cost
    from edgepose.benchmarks.start_up import starts

    report: dict[str, Any] = {"machine": speed.machine(), "models": []}
    for info in infos:
        say(f"measuring {info.path.stem}")
        started = starts(info, trust)
        with TemporaryDirectory() as folder:
            engine = speed.load_engine(info, trust, "auto")
            steps = speed.step_costs(engine, Path(folder))
        full_speed = speed.whole_walk(speed.load_engine(info, trust, "auto"))
        live = live_cost(info.path)
        rows = [row._asdict() for row in speed.model_speeds(info, trust)]
        report["models"].append(
            {
                "name": info.path.stem,
                "start": started,
                "steps_us": steps,
                "full_speed": full_speed._asdict(),
                "live": None if live is None else live._asdict(),
                "ways": rows,
            }
        )
    if before is not None:
        report["against"] = compared(before, report)
    if as_json:
        show_json("bench", report)
        return
    show(speed_tables(report, speed.BUDGET_US))
    if before is not None:
        show(f"\n{ratio_table(report['against'])}")


@bench.command(short_help="Orientation filters on BROAD.")
@click.option(
    "--data",
    required=True,
    type=click.Path(path_type=Path),
    help="Folder of trials: data_mat of the BROAD download, or .npz files with the same arrays.",
)
@json_option
def orientation(data: Path, as_json: bool) -> None:
    """Compare orientation filters on BROAD: edgepose's, and vqf, imufusion and ahrs if installed.

    An error is the root mean square over the movement of a trial, then the mean over trials, in degrees. A
    time is that of one core per sample.

    \b
    Example:
      edgepose bench orientation --data broad/data_mat
    """
    from edgepose.benchmarks.broad import find_trials, read_trial
    from edgepose.benchmarks.filter_comparison import compare, cost_us

    files = find_trials(data)
    scores = [score for trial_scores in _with_progress(compare(files), len(files)) for score in trial_scores]
    cost = cost_us(read_trial(files[0]))
    if as_json:
        show_json("bench orientation", {"scores": scores, "us_a_sample_at_286_hz": cost})
        return
    show(f"{len(files)} trials; RMSE over movement in deg, mean over trials; us a sample on one core\n")
    show("with magnetometer")
    show(_table(scores, magnetometer=True))
    show("\nwithout; heading set to the truth's in the first second of motion")
    show(_table(scores, magnetometer=False))
    show(f"\nedgepose, online, at 286 Hz: {cost:.1f} us a sample of a sensor on one core")


def _with_progress(trials: Iterable[list[Score]], count: int) -> Iterator[list[Score]]:
    """Yield the scores of each trial, and show a progress bar on a terminal, a line per trial elsewhere."""
    if has_terminal():
        with progress_bar(count, "Filtering") as bar:
            for scores in trials:
                yield scores
                bar.update(1)
        return
    for number, scores in enumerate(trials, start=1):
        yield scores
        say(f"{number} of {count}  {scores[0].trial}")


def _table(scores: list[Score], magnetometer: bool) -> str:
    """Return a table with a row for each filter."""
    rows = [("filter", "", "total", "heading", "inclination", "undisturbed", "disturbed", "us")]
    for name in dict.fromkeys(score.filter for score in scores):
        selected = [score for score in scores if score.filter == name and score.magnetometer == magnetometer]
        rows.append(
            (
                name,
                "offline" if selected[0].offline else "online",
                _mean([score.total for score in selected]),
                _mean([score.heading for score in selected]),
                _mean([score.inclination for score in selected]),
                _mean([score.total for score in selected if not score.disturbed]),
                _mean([score.total for score in selected if score.disturbed]),
                f"{sum(score.us for score in selected) / len(selected):.1f}",
            )
        )
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if column < 2 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    )


def _mean(values: list[float]) -> str:
    mean = sum(values) / len(values) if values else math.nan
    return f"{mean:.2f}" if math.isfinite(mean) else "-"
