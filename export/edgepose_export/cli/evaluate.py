"""`edgepose evaluate`: accuracy of models on takes with known poses."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from edgepose.cli.options.json_result import json_option
from edgepose.cli.options.outputs import overwrite_option
from edgepose.cli.terminal.messages import say
from edgepose_export.cli.results import Results

if TYPE_CHECKING:
    import torch

    from edgepose_export.evaluation.evaluate import Columns, Mode

MODES = click.Choice(["window", "stream", "offline"])
PICTURE = click.Path(path_type=Path, dir_okay=False)

HEAT_MAP_FRAMES = [0, 1, 5, 10, 20, 50, 100, 200]
"""Past and future frames of DIP's figure 6."""


class EvaluatedModel(NamedTuple):
    """A model of the command line, and the modes to run it in."""

    name: str
    metadata: dict[str, Any]
    module: torch.jit.ScriptModule
    modes: list[Mode]


@click.command(short_help="Measure models against true poses.")
@click.option(
    "--model",
    "names",
    multiple=True,
    default=["birnn"],
    show_default=True,
    help="Name of a shipped model or path of an archive; may be repeated.",
)
@click.option(
    "--trust",
    is_flag=True,
    help="Load --model although its checksum is unknown: you vouch for the code in it.",
)
@click.option(
    "--data",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="Folder written by `edgepose synthesize`, or of DIP-IMU or TotalCapture with --part published; with "
    "--real, of the recordings  [default with --real: those in edgepose's source]",
)
@click.option(
    "--real",
    is_flag=True,
    help="Measure on recordings of two real wearers instead, beside methods that need no network.",
)
@click.option(
    "--part",
    "parts",
    multiple=True,
    metavar="NAME",
    help="Part of the split, such as cmu-02 or tennis (docs/reference/models.md lists all); sports, "
    "validation: several parts together; all: every take below --data; published: files of DIP-IMU or "
    "TotalCapture as downloaded; may be repeated  [default: the held-out parts that --data "
    "has; else validation]",
)
@click.option(
    "--online",
    "modes",
    multiple=True,
    type=MODES,
    help="How a model runs: window or stream as in `run`, offline over whole takes; may be repeated  "
    "[default: all that apply]",
)
@click.option("--past", type=click.IntRange(0, 600), help="Past frames of a window  [default: the model's]")
@click.option("--future", type=click.IntRange(0, 120), help="Future frames  [default: the model's]")
@click.option(
    "--baselines", is_flag=True, help="Add trivial baselines, trained on the training takes below --data."
)
@click.option(
    "--table",
    type=click.Choice(["2", "3", "4", "5"]),
    help="Print a table of the Deep Inertial Poser paper: 2 offline; 3 online, windows (20, 5) and (50, 5); "
    "4 networks without recurrence, online; 5 with and without accelerations, offline.",
)
@click.option("--histogram", type=PICTURE, help="Draw the distribution of errors (the paper's figure 5).")
@click.option(
    "--heat-map",
    type=PICTURE,
    help="Draw the error of one bidirectional model against past and future frames (the paper's figure 6), "
    "instead of tables.",
)
@click.option(
    "--every",
    type=click.IntRange(1),
    metavar="N",
    default=1,
    show_default=True,
    help="Measure every Nth frame for the heat map; measuring all of them takes long.",
)
@click.option(
    "--reliability",
    type=PICTURE,
    help="Draw and print actual errors against predicted standard deviations.",
)
@click.option(
    "--place",
    is_flag=True,
    help="Measure the wearer's path instead of poses: error after some seconds and over some metres, height, "
    "slide of the feet.",
)
@click.option(
    "--paths",
    type=PICTURE,
    help="Draw estimated and true paths, seen from above, with --place or --real.",
)
@overwrite_option
@json_option
def evaluate(
    names: tuple[str, ...],
    trust: bool,
    data: Path | None,
    real: bool,
    parts: tuple[str, ...],
    modes: tuple[str, ...],
    past: int | None,
    future: int | None,
    baselines: bool,
    table: str | None,
    histogram: Path | None,
    heat_map: Path | None,
    every: int,
    reliability: Path | None,
    place: bool,
    paths: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Measure models against true poses. All frames count, including the first and last ones of a take.

    \b
    Examples:
      edgepose evaluate --real --model birnn --model my-rnn.pt --trust
      edgepose evaluate --data takes --baselines
      edgepose evaluate --data takes --model birnn --model rnn --part cmu-walk-run
      edgepose evaluate --data takes --online window --past 50 --future 5
      edgepose evaluate --data takes --table 3 --histogram errors.png
      edgepose evaluate --data DIP_IMU/s_09 --part published --table 3 \\
        --model birnn --model dip-birnn.pt
      edgepose evaluate --data takes --part cmu-walk-run --heat-map past.png
      edgepose evaluate --data takes --place --part cmu-walk-run --paths paths.png
    """
    results = Results(as_json)
    if real:
        from edgepose_export.cli.evaluate_real import evaluate_real

        evaluate_real(names, trust, data, paths, overwrite, results)
        results.end()
        return
    if data is None:
        raise click.UsageError("give --data FOLDER, or --real")
    _check_combination(**click.get_current_context().params)
    _check_names(parts, (histogram, heat_map, reliability, paths), overwrite)
    models = [_model(name, trust, modes, past, future, table) for name in names]
    if len({model.name for model in models}) < len(models):  # files with the same name in several folders
        models = [model._replace(name=name) for model, name in zip(models, names, strict=True)]
    chosen = parts or default_parts(data)
    if place:
        from edgepose_export.cli.evaluate_place import evaluate_place

        evaluate_place(models, data, chosen, paths, overwrite, results)
    elif heat_map:
        _heat_map(models[0], data, chosen, every, heat_map, overwrite, results)
    else:
        _tables(models, data, chosen, baselines, table, histogram, overwrite, results)
    if reliability:
        _reliability(models, data, chosen, reliability, overwrite, results)
    results.end()


def _check_names(parts: tuple[str, ...], pictures: tuple[Path | None, ...], overwrite: bool) -> None:
    """Raise EdgeposeError if there is no such part, or a picture cannot be written."""
    from edgepose.analysis.figures import check_picture
    from edgepose_export.training.dataset import check_part

    for part in set(parts) - {"published"}:
        check_part(part)
    for picture in filter(None, pictures):
        check_picture(picture, "drawing", overwrite)


def _check_combination(
    *,
    names: tuple[str, ...],
    modes: tuple[str, ...],
    past: int | None,
    future: int | None,
    place: bool,
    **flags: Any,
) -> None:
    """Raise UsageError if flags contradict each other."""
    table, heat_map = flags["table"], flags["heat_map"]
    tables = flags["histogram"] or flags["baselines"]
    if table and (modes or past is not None or future is not None):
        raise click.UsageError("--table decides how models run: omit --online, --past and --future")
    if heat_map and (table or tables):
        raise click.UsageError("--heat-map replaces the tables: omit --table, --histogram and --baselines")
    if place and (table or tables or heat_map or modes or past is not None or flags["reliability"]):
        raise click.UsageError(
            "--place has tables and a picture of its own: omit --table, --histogram, --heat-map, "
            "--reliability, --baselines, --online and --past"
        )
    if flags["paths"] and not place:
        raise click.UsageError("--paths belongs to --place or --real")
    if heat_map and len(names) > 1:
        raise click.UsageError("--heat-map takes one --model")


def default_parts(data: Path) -> tuple[str, ...]:
    """Return the parts to measure of a folder, and say which it lacks.

    Raises:
        EdgeposeError: it has nothing to measure.
    """
    from edgepose_export.training.dataset import measured_parts

    present, lacking = measured_parts(data)
    if lacking:
        say(f"{data} has no recordings of {', '.join(lacking)}; measuring on {', '.join(present)}")
    return tuple(present)


def _model(
    name: str, trust: bool, modes: tuple[str, ...], past: int | None, future: int | None, table: str | None
) -> EvaluatedModel:
    from edgepose.inference import archive
    from edgepose_export.evaluation.evaluate import modes_of
    from edgepose_export.evaluation.paper_tables import TABLES

    path = archive.find_archive(name)
    info = archive.read_info(path)
    module = archive.load(info, trust)
    about = dict(info.metadata)
    if not archive.is_windowed(about):
        if future or past or set(modes) - {"stream", "offline"}:
            raise click.UsageError(f"{name} {_no_window(about)} and has no window; use --online stream")
    else:
        about["past"] = about["past"] if past is None else past
        about["future"] = about["future"] if future is None else future
    if table:
        chosen = TABLES[table].modes(about)
    else:
        chosen = [mode for mode in modes_of(about) if not modes or mode.name in modes]
    return EvaluatedModel(path.stem, about, module, chosen)


def _no_window(metadata: dict[str, Any]) -> str:
    """Return why a model has no window, for messages."""
    fixed = metadata["past"] or metadata["future"]
    return "sees a fixed number of frames" if fixed else "is unidirectional"


def _row_name(models: list[EvaluatedModel], model: EvaluatedModel, mode: Mode) -> str:
    return f"{model.name}, {mode}" if len(models) > 1 else str(mode)


def _tables(
    models: list[EvaluatedModel],
    data: Path,
    parts: tuple[str, ...],
    baselines: bool,
    table: str | None,
    histogram: Path | None,
    overwrite: bool,
    results: Results,
) -> None:
    from edgepose.analysis.metrics import format_table
    from edgepose_export.cli.progress import labelled
    from edgepose_export.evaluation import evaluate as evaluation
    from edgepose_export.evaluation import plots
    from edgepose_export.evaluation.baselines import learn
    from edgepose_export.evaluation.paper_tables import TABLES, format_paper_table

    methods: dict[str, evaluation.Method] = {}
    for model in models:
        runs = evaluation.archive_methods(model.module, model.modes).values()
        for mode, run in zip(model.modes, runs, strict=True):
            methods[_row_name(models, model, mode)] = run
    if baselines:
        trained = learn(evaluation.takes_of(data, "train", labelled("training baselines")))
        methods |= evaluation.baseline_methods(trained)
    columns: dict[str, Columns] = evaluation.columns_of_parts(methods, data, parts, labelled("measuring"))
    tables = {part: evaluation.summarise(rows) for part, rows in columns.items()}
    for part, summary in tables.items():
        results.add("tables", kind="poses", title=part, rows=summary)
    if table:
        results.show(format_paper_table(tables, TABLES[table].positions))
    else:
        for part, rows in tables.items():
            results.show(f"\n{part}\n{format_table(rows)}")
        _places(models, data, parts, results)
    if histogram:
        errors = {
            part: {name: row["sip_error_deg"] for name, row in rows.items()} for part, rows in columns.items()
        }
        plots.histogram(histogram, errors, overwrite)
        say(f"wrote {histogram}")


def _places(models: list[EvaluatedModel], data: Path, parts: tuple[str, ...], results: Results) -> None:
    """Show the accuracy of contacts and velocity, of models and takes that have them."""
    from edgepose_export.cli.progress import labelled
    from edgepose_export.evaluation.evaluate import takes_of
    from edgepose_export.evaluation.place import accuracy, describe

    for part in parts:
        for model in (model for model in models if "place" in model.metadata):
            takes = takes_of(data, part, labelled("measuring contacts"))
            if measures := accuracy(model.module, model.metadata, takes):
                results.show(f"\n{part}, {model.name} streamed: {describe(measures)}")
                results.add("contacts", part=part, model=model.name, **measures)


def _heat_map(
    model: EvaluatedModel,
    data: Path,
    parts: tuple[str, ...],
    every: int,
    path: Path,
    overwrite: bool,
    results: Results,
) -> None:
    from edgepose.inference.archive import is_windowed

    if not is_windowed(model.metadata):
        raise click.UsageError(
            f"{model.name} {_no_window(model.metadata)}; a heat map needs a bidirectional model"
        )
    from edgepose_export.cli.progress import labelled
    from edgepose_export.evaluation import plots
    from edgepose_export.evaluation.evaluate import takes_of, window_errors

    maps = {}
    for part in parts:
        takes = takes_of(data, part, labelled(f"measuring {part}"))
        means, frames = window_errors(model.module, takes, HEAT_MAP_FRAMES, HEAT_MAP_FRAMES, every)
        maps[part] = means
        axes = {"past": HEAT_MAP_FRAMES, "future": HEAT_MAP_FRAMES}
        results.add("heat_maps", part=part, model=model.name, frames=frames, **axes, sip_error_deg=means)
        results.show(f"\n{part}: SIP error, deg, {frames} frames; rows: future frames, columns: past frames")
        for future, row in zip(HEAT_MAP_FRAMES[::-1], means[::-1], strict=True):
            results.show(f"{future:>6}  " + "  ".join(f"{mean:6.2f}" for mean in row))
        results.show("        " + "  ".join(f"{past:>6}" for past in HEAT_MAP_FRAMES))
    plots.heat_map(path, maps, HEAT_MAP_FRAMES, HEAT_MAP_FRAMES, overwrite)
    say(f"wrote {path}")


def _reliability(
    models: list[EvaluatedModel],
    data: Path,
    parts: tuple[str, ...],
    path: Path,
    overwrite: bool,
    results: Results,
) -> None:
    from edgepose_export.cli.progress import labelled
    from edgepose_export.evaluation import plots
    from edgepose_export.evaluation import uncertainty as rel
    from edgepose_export.evaluation.evaluate import takes_of

    curves: dict[str, dict[str, rel.Reliability]] = {}
    for part in parts:
        for model in models:
            for mode in model.modes:
                name = _row_name(models, model, mode)
                takes = takes_of(data, part, labelled("measuring deviations"))
                pair = rel.errors_and_deviations(model.module, model.metadata, takes, mode)
                result = curves.setdefault(part, {})[name] = rel.reliability(*pair)
                results.add("reliability", part=part, row=name, **result._asdict())
                results.show(f"\n{part}: {name}\n{rel.describe(result)}")
    plots.reliability_plot(path, curves, overwrite)
    say(f"wrote {path}")
