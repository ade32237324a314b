"""`edgepose evaluate`: measures of a model on takes with known poses."""

from __future__ import annotations

from pathlib import Path

import click

MODES = click.Choice(["window", "stream", "offline"])


@click.command(short_help="Measure a model against true poses.")
@click.option(
    "--model", "name", default="birnn", show_default=True, help="Shipped model or an archive's path."
)
@click.option(
    "--trust", is_flag=True, help="Load --model although its sum is not known: you vouch for the code in it."
)
@click.option(
    "--data",
    required=True,
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="Folder that `edgepose synthesize` wrote.",
)
@click.option(
    "--part",
    "parts",
    multiple=True,
    type=click.Choice(["cmu-walk-run", "cmu-02", "bandai-styles", "all"]),
    help="Held-out part of the split, or all takes below --data; may be repeated  "
    "[default: the three held-out parts]",
)
@click.option(
    "--online",
    "modes",
    multiple=True,
    type=MODES,
    help="How the model runs: as `run` runs it, or over whole takes; may be repeated  "
    "[default: all that apply]",
)
@click.option("--past", type=click.IntRange(0, 600), help="Past frames of a window  [default: the model's]")
@click.option("--future", type=click.IntRange(0, 120), help="Future frames  [default: the model's]")
@click.option(
    "--baselines", is_flag=True, help="Add trivial baselines, learnt from the training takes below --data."
)
def evaluate(
    name: str,
    trust: bool,
    data: Path,
    parts: tuple[str, ...],
    modes: tuple[str, ...],
    past: int | None,
    future: int | None,
    baselines: bool,
) -> None:
    """Measure a model against true poses. Every frame counts, those at the start and end of a take too.

    \b
    Examples:
      edgepose evaluate --data recordings/ --baselines
      edgepose evaluate --data recordings/ --model rnn --part cmu-walk-run
      edgepose evaluate --data recordings/ --online window --past 50 --future 5
    """
    from edgepose import archive
    from edgepose.metrics import format_table
    from edgepose_export import evaluation
    from edgepose_export.cli.progress import labelled

    info = archive.inspect(archive.find(name))
    module = archive.load(info, trust)
    about = dict(info.metadata)
    if about["kind"] == "rnn":
        if future or past or set(modes) - {"stream", "offline"}:
            raise click.UsageError(f"{name} is unidirectional: it has no window; use --online stream")
    else:
        about["past"] = about["past"] if past is None else past
        about["future"] = about["future"] if future is None else future
    chosen = [mode for mode in evaluation.modes_of(about) if not modes or mode.name in modes]
    tables = evaluation.held_out_tables(
        module, chosen, data, baselines, parts or evaluation.HELD_OUT, labelled("measuring")
    )
    for part, table in tables.items():
        click.echo(f"\n{part}\n{format_table(table)}")
