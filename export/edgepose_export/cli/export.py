"""`edgepose export`: a checkpoint to a TorchScript archive."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import click

from edgepose.cli.options.outputs import overwrite_option
from edgepose.cli.terminal.messages import say
from edgepose.inference.quantisation import PRECISIONS
from edgepose.skeleton import JOINTS
from edgepose.utils.durable_files import write_whole
from edgepose.utils.output_targets import check_output

if TYPE_CHECKING:
    import numpy as np
    import torch
    from numpy.typing import NDArray

    Archive = tuple[torch.jit.ScriptModule, dict[str, Any]]
    """A loaded archive and its metadata."""


@click.command(short_help="Make an archive of a trained network.")
@click.argument(
    "checkpoints", metavar="CHECKPOINT...", nargs=-1, required=True, type=click.Path(path_type=Path)
)
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
    "--precision",
    type=click.Choice(PRECISIONS),
    default="f32",
    show_default=True,
    help="How the archive's weights are kept. An archive in f32 runs anywhere and in any precision (`run "
    "--precision`); one in int8 is a quarter of the size; one in fp16 is not smaller.",
)
@click.option(
    "--rounded",
    is_flag=True,
    help="Round weights by about a hundredth: fp16 then holds the recurrent layers exactly, and the archive "
    "compresses to two fifths, in a wheel for example.",
)
@click.option(
    "--measure",
    "data",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="Folder that `edgepose synthesize` wrote: fit the standard deviations to the errors on its "
    "validation takes, measure the archive on its held-out takes and put the figures into the card.",
)
@click.option(
    "--beside",
    help="Shipped or trusted model whose figures stand beside in the card, with --measure.",
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
    """Turn a checkpoint of `edgepose train` into a TorchScript archive for `edgepose run --model FILE
    --trust`.

    Of several checkpoints that were trained on from each other (`train --init`), the archive gets the mean
    weights, which often do better on motion they have not seen than any of them; all else is the first's.

    \b
    Examples:
      edgepose export runs/birnn/checkpoint.pt --out my-birnn.pt --measure recordings/
      edgepose export runs/tuned/checkpoint.pt runs/birnn/checkpoint.pt --out my-birnn.pt
    """
    if out.suffix != ".pt":
        raise click.UsageError("--out is the name of a .pt file")
    if beside and not data:
        raise click.UsageError("--beside is for --measure")
    if rounded and precision == "int8":
        raise click.UsageError("--rounded is not for --precision int8, which rounds in its own way")
    if len({path.resolve() for path in checkpoints}) < len(checkpoints):
        raise click.UsageError("one checkpoint is named twice")
    beside_it = out.with_suffix(".md")
    if out.parent.is_dir():  # made with what it is for otherwise
        check_output(out, "the archive", (".pt",), overwrite)
        check_output(beside_it, "the card", (".md",), overwrite)
    import torch

    from edgepose.inference.archive import find_archive, load, read_info
    from edgepose.inference.quantisation import pack_weights
    from edgepose_export.archive import torchscript as archive
    from edgepose_export.archive.model_card import card
    from edgepose_export.evaluation.quantisation import round_weights
    from edgepose_export.training import trainer as training
    from edgepose_export.training.config import config_from

    others = {}
    if beside:
        info = read_info(find_archive(beside))
        others = {f"`{beside}`": (load(info), info.metadata)}
    state = training.mean_of({str(path): training.read_checkpoint(path) for path in checkpoints})
    config = config_from(json.loads(state["config"]))
    network = archive.new_network(config.network)
    network.load_state_dict(state["averaged"])
    if rounded:
        round_weights(network)
    statistics = archive.Statistics(**state["statistics"])
    metadata = archive.describe(out.stem, network, state, past, future)
    metadata["precision"] = precision
    metadata["rounded"] = rounded
    metadata["training"]["checkpoints"] = len(checkpoints)
    scale = None
    if data:
        fitted = _std_scale(archive.script(network, statistics), metadata, data)
        metadata["std_scale"] = dict(zip(JOINTS, fitted.tolist(), strict=True))
        scale = torch.tensor(fitted)

    def script() -> torch.jit.ScriptModule:
        return archive.script(network, statistics, scale)

    module = script()
    pack_weights(module, precision)
    if data:
        with TemporaryDirectory() as folder:
            measured = Path(folder) / out.name
            archive.save(module, measured, metadata)
            metadata |= _measures(measured, data, others)
        metadata["precisions"] = _precisions(script, metadata, data)
    archive.save(module, out, metadata, overwrite)
    write_whole(beside_it, card(metadata), "the card", overwrite=overwrite)
    say(f"wrote {out} ({out.stat().st_size / 1e6:.1f} MB) and {beside_it}")


def _precisions(
    script: Callable[[], torch.jit.ScriptModule], metadata: dict[str, Any], data: Path
) -> dict[str, Any]:
    """What each precision does to the poses on the held-out takes."""
    from edgepose_export.cli.progress import labelled
    from edgepose_export.evaluation.evaluate import modes_of
    from edgepose_export.evaluation.quantisation import compare
    from edgepose_export.training.splits import HELD_OUT

    (mode,) = (mode for mode in modes_of(metadata) if mode.name == "stream")
    return compare(script, data, HELD_OUT, mode, labelled("measuring precisions"))


def _std_scale(module: torch.jit.ScriptModule, metadata: dict[str, Any], data: Path) -> NDArray[np.float64]:
    """Factors (24,) of the joints' standard deviations, from the validation takes."""
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
    """Measures and reliability of the archive as a run loads it, with one thread, and measures of others."""
    from edgepose.inference.archive import load, read_info
    from edgepose_export.cli.progress import labelled
    from edgepose_export.evaluation import evaluate as evaluation
    from edgepose_export.evaluation.baselines import learn
    from edgepose_export.evaluation.uncertainty import errors_and_deviations, reliability
    from edgepose_export.training.splits import HELD_OUT

    info = read_info(path)
    module, modes = load(info, trust=True), evaluation.modes_of(info.metadata)
    learnt = learn(evaluation.takes_of(data, "train", labelled("learning baselines")))
    methods = evaluation.archive_methods(module, modes) | evaluation.baseline_methods(learnt)
    for name, (other, about) in others.items():
        streamed = [mode for mode in evaluation.modes_of(about) if mode.name == "stream"]
        for row, method in evaluation.archive_methods(other, streamed).items():
            methods[f"{name}, {row}"] = method
    columns = evaluation.columns_of_parts(methods, data, HELD_OUT, labelled("measuring"))
    (mode,) = (mode for mode in modes if mode.name == "stream")
    deviations = {}
    for part in HELD_OUT:
        takes = evaluation.takes_of(data, part, labelled("measuring deviations"))
        result = reliability(*errors_and_deviations(module, info.metadata, takes, mode))
        deviations[part] = {"within": list(result.within), "scale": result.scale, "values": result.values}
    return {
        "measures": {
            part: {
                row: {key: list(m) for key, m in measures.items()}
                for row, measures in evaluation.summarise(rows).items()
            }
            for part, rows in columns.items()
        },
        "deviations": deviations,
    }
