"""`edgepose export`: a checkpoint to a TorchScript archive."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click


@click.command(short_help="Make an archive of a trained network.")
@click.argument("checkpoint", type=click.Path(path_type=Path))
@click.option(
    "--out",
    required=True,
    type=click.Path(path_type=Path, dir_okay=False),
    help="Archive to write, a .pt file; its card goes beside it as .md.",
)
@click.option(
    "--past",
    type=click.IntRange(0, 600),
    default=20,
    show_default=True,
    help="Past frames of a bidirectional model's window.",
)
@click.option(
    "--future",
    type=click.IntRange(0, 120),
    default=5,
    show_default=True,
    help="Future frames a bidirectional model waits for.",
)
@click.option(
    "--measure",
    "data",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="Folder that `edgepose synthesize` wrote: measure the archive on its held-out takes and put the "
    "figures into the card.",
)
def export(checkpoint: Path, out: Path, past: int, future: int, data: Path | None) -> None:
    """Turn a checkpoint of `edgepose train` into a TorchScript archive for `edgepose run --model FILE
    --trust`.

    \b
    Example:
      edgepose export runs/birnn/checkpoint.pt --out my-birnn.pt --measure recordings/
    """
    if out.suffix != ".pt":
        raise click.UsageError("--out is the name of a .pt file")
    from edgepose_export import archive, training
    from edgepose_export.card import card
    from edgepose_export.networks import PoseNetwork

    state = training.read_checkpoint(checkpoint)
    config = training.config_from(json.loads(state["config"]))
    network = PoseNetwork(config.network)
    network.load_state_dict(state["averaged"])
    module = archive.script(network, archive.Statistics(**state["statistics"]))
    if config.network.kind == "rnn":
        past, future = 0, 0
    metadata = archive.describe(out.stem, network, state, past, future)
    archive.save(module, out, metadata)
    if data:
        metadata["measures"] = _measure(out, data)
        archive.save(module, out, metadata)
    out.with_suffix(".md").write_text(card(metadata), encoding="utf-8")
    click.echo(f"wrote {out} ({out.stat().st_size / 1e6:.1f} MB) and {out.with_suffix('.md')}", err=True)


def _measure(path: Path, data: Path) -> dict[str, Any]:
    """Measures of the archive as a run loads it, with one thread."""
    from edgepose.archive import inspect, load
    from edgepose_export.cli.progress import labelled
    from edgepose_export.evaluation import held_out_tables, modes_of

    info = inspect(path)
    module = load(info, trust=True)
    tables = held_out_tables(
        module, modes_of(info.metadata), data, with_baselines=True, progress=labelled("measuring")
    )
    return {
        part: {row: {key: list(m) for key, m in columns.items()} for row, columns in table.items()}
        for part, table in tables.items()
    }
