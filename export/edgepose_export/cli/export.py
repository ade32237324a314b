"""`edgepose export`: TorchScript archives of trained networks."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from edgepose.cli.options.outputs import overwrite_option
from edgepose.cli.terminal.messages import say
from edgepose.inference.quantisation import PRECISIONS
from edgepose.sinks.output_files import check_output
from edgepose.skeleton import JOINTS
from edgepose.utils.durable_files import write_whole
from edgepose_export.cli.evaluate import default_parts

if TYPE_CHECKING:
    import numpy as np
    import torch
    from numpy.typing import NDArray

    from edgepose_export.archive.torchscript import Network, Statistics

    Archive = tuple[torch.jit.ScriptModule, dict[str, Any]]
    """A loaded archive and its metadata."""


class _Trained(NamedTuple):
    """A trained network, the statistics of its training set, and the metadata of its archive so far."""

    network: Network
    statistics: Statistics
    metadata: dict[str, Any]


@click.command(short_help="Export a trained network as an archive.")
@click.argument(
    "checkpoints", metavar="CHECKPOINT...", nargs=-1, required=True, type=click.Path(path_type=Path)
)
@click.option(
    "--out",
    required=True,
    type=click.Path(path_type=Path, dir_okay=False),
    help="Archive to write, a .pt file; its model card is written beside it as .md.",
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
    "--precision",
    type=click.Choice(PRECISIONS),
    default="f32",
    show_default=True,
    help="Precision of the stored weights. An f32 archive runs on any machine and in any precision (`run "
    "--precision`); an int8 archive is a quarter of the size; an fp16 archive is not smaller.",
)
@click.option(
    "--rounded",
    is_flag=True,
    help="Round weights to about one part in a hundred: fp16 then represents the recurrent layers exactly, "
    "and the archive compresses to two fifths of its size, in a wheel for example.",
)
@click.option(
    "--measure",
    "data",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="Folder written by `edgepose synthesize`: fit the standard deviations to the errors on its "
    "validation takes, measure the archive on its held-out takes, or on those for validation if it has none, "
    "and on the source tree's recordings of real wearers, and add the results to the card.",
)
@click.option(
    "--beside",
    help="With --measure: shipped or trusted model to measure for comparison in the card.",
)
@overwrite_option
def export(
    checkpoints: tuple[Path, ...],
    out: Path,
    past: int,
    future: int,
    precision: str,
    rounded: bool,
    data: Path | None,
    beside: str | None,
    overwrite: bool,
) -> None:
    """Turn a checkpoint of `edgepose train` into an archive for `edgepose run --model FILE --trust`.

    Several checkpoints, each trained further from another one (`train --init`), are averaged: mean weights
    often do better on unseen motion than any of them. Everything else is taken from the first checkpoint.

    \b
    Examples:
      edgepose export runs/birnn/checkpoint.pt --out my-birnn.pt --measure takes
      edgepose export tuned/checkpoint.pt birnn/checkpoint.pt --out my-birnn.pt
    """
    if out.suffix != ".pt":
        raise click.UsageError("--out must name a .pt file")
    if beside and not data:
        raise click.UsageError("--beside needs --measure")
    if rounded and precision == "int8":
        raise click.UsageError("--rounded does not apply to --precision int8, which rounds by itself")
    if len({path.resolve() for path in checkpoints}) < len(checkpoints):
        raise click.UsageError("a checkpoint is named twice")
    card_path = out.with_suffix(".md")
    if out.parent.is_dir():  # otherwise the folder is made when the archive is saved
        check_output(out, "the archive", (".pt",), overwrite)
        check_output(card_path, "the card", (".md",), overwrite)

    from edgepose_export.archive import torchscript as archive
    from edgepose_export.archive.model_card import card

    others = _load_other(beside) if beside else {}
    trained = _read(checkpoints, out.stem, past, future, rounded)
    trained.metadata["precision"] = precision
    trained.metadata["training"]["exported_by_recipe"] = click.get_current_context().obj is not None
    module = _measured_module(trained, data, others, out.name)
    archive.save(module, out, trained.metadata, overwrite)
    write_whole(card_path, card(trained.metadata), "the card", overwrite=overwrite)
    say(f"wrote {out} ({out.stat().st_size / 1e6:.1f} MB) and {card_path}")


def _load_other(name: str) -> dict[str, Archive]:
    """Load the model to compare with; return it by its name."""
    from edgepose.inference.archive import find_archive, load, read_info

    info = read_info(find_archive(name))
    return {name: (load(info), info.metadata)}


def _read(checkpoints: tuple[Path, ...], name: str, past: int, future: int, rounded: bool) -> _Trained:
    """Read the checkpoints, average them if there are several, and describe the result."""
    from edgepose_export.archive import torchscript as archive
    from edgepose_export.evaluation.quantisation import round_weights
    from edgepose_export.training.checkpoints import mean_of, read_checkpoint
    from edgepose_export.training.config import config_from

    state = mean_of({str(path): read_checkpoint(path) for path in checkpoints})
    network = archive.new_network(config_from(json.loads(state["config"])).network)
    network.load_state_dict(state["averaged"])
    if rounded:
        round_weights(network)
    metadata = archive.describe(name, network, state, past, future)
    metadata["rounded"] = rounded
    metadata["training"]["checkpoints"] = len(checkpoints)
    return _Trained(network, archive.Statistics(**state["statistics"]), metadata)


def _measured_module(
    trained: _Trained, data: Path | None, others: Mapping[str, Archive], file_name: str
) -> torch.jit.ScriptModule:
    """Return the archive's module.

    With a folder of takes, fit the standard deviations and add the measures to the metadata.
    """
    import torch

    from edgepose.inference.quantisation import pack_weights
    from edgepose_export.archive import torchscript as archive

    network, statistics, metadata = trained
    scale = None
    if data:
        fitted = _std_scale(archive.script(network, statistics), metadata, data)
        metadata["std_scale"] = dict(zip(JOINTS, fitted.tolist(), strict=True))
        scale = torch.tensor(fitted)

    def script() -> torch.jit.ScriptModule:
        return archive.script(network, statistics, scale)

    module = script()
    pack_weights(module, metadata["precision"])
    if data:
        with TemporaryDirectory() as folder:
            path = Path(folder) / file_name
            archive.save(module, path, metadata)
            metadata |= _measures(path, data, others)
            metadata["real"] = _on_real_wearers(path, others)
        metadata["precisions"] = _precisions(script, metadata, data)
    return module


def _precisions(
    script: Callable[[], torch.jit.ScriptModule], metadata: dict[str, Any], data: Path
) -> dict[str, Any]:
    """Return the effect of each precision on the poses of the held-out takes."""
    from edgepose_export.cli.progress import labelled
    from edgepose_export.evaluation.evaluate import modes_of
    from edgepose_export.evaluation.quantisation import compare
    from edgepose_export.training.sources import single_parts

    (mode,) = (mode for mode in modes_of(metadata) if mode.name == "stream")
    return compare(script, data, single_parts(metadata["measures"]), mode, labelled("measuring precisions"))


def _std_scale(module: torch.jit.ScriptModule, metadata: dict[str, Any], data: Path) -> NDArray[np.float64]:
    """Fit factors (24,) of the joints' standard deviations to the validation takes."""
    import numpy as np

    from edgepose_export.cli.progress import labelled
    from edgepose_export.evaluation.evaluate import modes_of, takes_of
    from edgepose_export.evaluation.uncertainty import errors_and_deviations, scales

    takes = takes_of(data, "validation", labelled("fitting deviations"))
    (mode,) = (mode for mode in modes_of(metadata) if mode.name == "stream")
    factors = np.ones(len(JOINTS))
    rows = [JOINTS.index(name) for name in metadata["joints"]]
    factors[rows] = scales(*errors_and_deviations(module, metadata, takes, mode))
    return factors


def _measures(path: Path, data: Path, others: Mapping[str, Archive]) -> dict[str, Any]:
    """Return measures and reliability of the archive, and measures of the baselines and of other models.

    The archive is loaded as `edgepose run` loads it, with one thread.
    """
    from edgepose.inference.archive import load, read_info
    from edgepose_export.cli.progress import labelled
    from edgepose_export.evaluation import evaluate as evaluation
    from edgepose_export.evaluation.baselines import learn
    from edgepose_export.evaluation.place import accuracy
    from edgepose_export.evaluation.uncertainty import errors_and_deviations, reliability
    from edgepose_export.training.sources import single_parts

    parts = default_parts(data)
    info = read_info(path)
    module, modes = load(info, trust=True), evaluation.modes_of(info.metadata)
    trained = learn(evaluation.takes_of(data, "train", labelled("training baselines")))
    methods = evaluation.archive_methods(module, modes) | evaluation.baseline_methods(trained)
    for name, (other, about) in others.items():
        streamed = [mode for mode in evaluation.modes_of(about) if mode.name == "stream"]
        for row, method in evaluation.archive_methods(other, streamed).items():
            methods[f"`{name}`, {row}"] = method
    columns = evaluation.columns_of_parts(methods, data, parts, labelled("measuring"))
    (mode,) = (mode for mode in modes if mode.name == "stream")
    deviations, places = {}, {}
    for part in single_parts(parts):
        takes = evaluation.takes_of(data, part, labelled("measuring deviations"))
        result = reliability(*errors_and_deviations(module, info.metadata, takes, mode))
        deviations[part] = {"within": list(result.within), "scale": result.scale, "values": result.values}
        takes = evaluation.takes_of(data, part, labelled("measuring contacts"))
        if found := accuracy(module, info.metadata, takes):
            places[part] = found
    return {
        "measures": {
            part: {
                row: {key: list(m) for key, m in measures.items()}
                for row, measures in evaluation.summarise(rows).items()
            }
            for part, rows in columns.items()
        },
        "deviations": deviations,
        **({"place_accuracy": places} if places else {}),
    }


def _on_real_wearers(path: Path, others: Iterable[str]) -> dict[str, Any]:
    """Return measures of the archive and of other models on real wearers; empty without their recordings."""
    from edgepose.inference.model import Model
    from edgepose_export.cli.progress import labelled
    from edgepose_export.evaluation import real_wearers

    if not real_wearers.has_recordings():
        return {}
    models = {path.stem: Model(path, trust=True)} | {f"`{name}`": Model(name) for name in others}
    tables = real_wearers.measure_models(models, progress=labelled("measuring on real wearers"))
    return {
        title: {
            row: {column: list(metric) for column, metric in columns.items()}
            for row, columns in table.items()
        }
        for title, table in tables.items()
    }
