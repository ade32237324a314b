"""`edgepose train`: training and fine-tuning of a network."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import click

from edgepose.cli.terminal.messages import progress_bar, say
from edgepose.errors import EdgeposeError


def _config_path(name: str) -> Path:
    from edgepose_export.training.config import CONFIGS

    shipped = CONFIGS / f"{name}.toml"
    return shipped if shipped.is_file() else Path(name)


@click.command(short_help="Train a network.")
@click.argument("mocap", nargs=-1, type=click.Path(path_type=Path, exists=True))
@click.option(
    "--recipe",
    metavar="NAME|FILE",
    help="Make a model from raw motion: recordings, all stages of training, archive and card, in --out. The "
    "same command goes on after an interruption. Shipped: birnn, rnn, birnn-nc, rnn-nc; or a TOML file.",
)
@click.option(
    "--config",
    metavar="NAME|FILE",
    help="Train once: shipped config, such as birnn or dip-rnn (docs/research/training.md in the repository "
    "lists all), or a TOML file.",
)
@click.option(
    "--data",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="Folder written by `edgepose synthesize`.",
)
@click.option(
    "--out",
    required=True,
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder for checkpoints and the log; of a recipe, for everything.",
)
@click.option("--resume", is_flag=True, help="Continue from the checkpoint in --out.")
@click.option(
    "--init", type=click.Path(path_type=Path), help="Start from this checkpoint's weights (fine-tuning)."
)
@click.option("--steps", type=click.IntRange(1), help="Steps to train  [default: the config's]")
@click.option(
    "--cache",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder for packed takes, 1192 bytes per frame, which are memory-mapped instead of read: for more "
    "motion than fits into memory  [default: everything in memory]",
)
@click.option(
    "--threads",
    type=click.IntRange(1),
    default=2,
    show_default=True,
    help="CPU threads of each process.",
)
def train(
    mocap: tuple[Path, ...],
    recipe: str | None,
    config: str | None,
    data: Path | None,
    out: Path,
    resume: bool,
    init: Path | None,
    steps: int | None,
    cache: Path | None,
    threads: int,
) -> None:
    """Train a network: by a recipe from raw motion MOCAP, or a single run on synthetic recordings.

    Ctrl-C loses only the steps since the last checkpoint. Several processes started by torchrun train
    together with --config, each with its share of the takes.

    \b
    Examples:
      edgepose train --recipe birnn mocap/ --out runs/birnn
      edgepose train --config birnn --data takes --out runs/birnn
      edgepose train --config birnn --data takes --out runs/birnn --resume
      edgepose train --config birnn --data mine --out runs/tuned \\
        --init runs/birnn/best.pt --steps 2000
      torchrun --nproc-per-node 4 -m \\
        edgepose train --config birnn --data takes --out runs/birnn
    """
    if (recipe is None) == (config is None):
        raise click.UsageError("give --recipe to make a model from raw motion, or --config for a single run")
    if recipe is not None:
        if data or resume or init or steps or cache:
            raise click.UsageError("--recipe decides all but --out and --threads: give no other option")
        _run_recipe(recipe, mocap, out, threads)
        return
    if mocap or config is None or data is None:
        raise click.UsageError("--config needs --data, and no folders with motion")
    if resume and init:
        raise click.UsageError("--resume continues a run, --init starts a new one: give only one of them")
    from dataclasses import replace

    import torch

    from edgepose_export.training import trainer as training
    from edgepose_export.training.config import read_config
    from edgepose_export.training.distributed import joined

    settings = read_config(_config_path(config))
    if steps:
        settings = replace(settings, steps=steps)
    checkpoint = out / training.CHECKPOINT
    if not resume and checkpoint.exists():
        raise EdgeposeError(
            f"{checkpoint}: already exists; continue that run with --resume or choose another --out"
        )
    torch.set_num_threads(threads)
    with joined() as processes:
        about = {"run": Path(config).stem}
        train_on(settings, data, out, processes, about, resume=resume, init=init, cache=cache)


def _run_recipe(recipe: str, mocap: tuple[Path, ...], out: Path, threads: int) -> None:
    from edgepose_export.cli.recipe import run_recipe

    if not mocap:
        raise click.UsageError("--recipe needs folders with motion")
    if "TORCHELASTIC_RUN_ID" in os.environ:
        raise click.UsageError("--recipe runs in one process: call it without torchrun")
    run_recipe(recipe, mocap, out, threads)


class Plan(NamedTuple):
    """A stage among those of a recipe.

    Attributes:
        label: number and name of the stage.
        work: relative duration of the stage.
        later: that of all later stages together.
    """

    label: str
    work: float
    later: float


def train_on(  # type: ignore[no-untyped-def]
    settings,
    data: Path,
    out: Path,
    processes,
    about: dict[str, Any],
    *,
    resume: bool,
    init: Path | None,
    cache: Path | None,
    plan: Plan | None = None,
) -> None:
    """Train a network on the recordings below a folder.

    Args:
        settings: the config.
        data: folder of the recordings.
        out: folder for checkpoints and the log.
        processes: this process and those that train with it.
        about: what is to be known of the run, see `Trainer`.
        resume: whether to continue from the checkpoint in `out`.
        init: checkpoint of other weights to start from.
        cache: folder for packed takes; None keeps them in memory.
        plan: the stage of a recipe that this is.

    Raises:
        EdgeposeError: takes or checkpoints are missing or broken, or training fails.
    """
    from edgepose_export.training import trainer as training
    from edgepose_export.training.dataset import training_paths

    parts = [
        _tape(processes.share(paths), data, processes, cache and cache / part)
        for part, paths in zip(("train", "validation"), training_paths(data), strict=True)
    ]
    about = training.describe_tape(parts[0], processes) | about
    trainer = training.Trainer(settings, *parts, about, processes)
    report = say if processes.rank == 0 else lambda text: None
    where = f"{plan.label}: " if plan else ""
    report(f"{where}training on {about['takes']} takes, {about['hours']:.2f} h: {about['summary']}")
    out.mkdir(parents=True, exist_ok=True)
    if resume:
        trainer.load(training.read_checkpoint(out / training.CHECKPOINT))
        report(f"continuing at step {trainer.step}")
    if init:
        trainer.start_from(training.read_checkpoint(init))
    _fit(trainer, out, report, plan)


def _tape(paths: list[Path], data: Path, processes, cache: Path | None):  # type: ignore[no-untyped-def]
    """Return the takes of this process, in memory or packed into a folder of its own."""
    from edgepose_export.cli.progress import labelled
    from edgepose_export.training.dataset import read_take, tape
    from edgepose_export.training.memory_map import packed_tape

    if cache is None:
        show = labelled("reading takes") if processes.rank == 0 else iter
        return tape([read_take(path, data) for path in show(paths)])
    show = labelled("packing takes") if processes.rank == 0 else iter
    return packed_tape(paths, cache / f"{processes.rank + 1}-of-{processes.size}", show, data)


def _fit(  # type: ignore[no-untyped-def]
    trainer, out: Path, report: Callable[[str], None], plan: Plan | None
) -> None:
    from edgepose_export.training.trainer import fit

    config = trainer.config
    started, first = time.monotonic(), trainer.step

    def report_validation(line: dict[str, float]) -> None:
        step = int(line["step"])
        elapsed = time.monotonic() - started
        speed = (step - first) * config.sequences * config.window / elapsed
        per_step = elapsed / (step - first) / 60
        left = f"{(config.steps - step) * per_step:.0f} min left"
        if plan and plan.later:
            left += (
                f", {(config.steps * (1 + plan.later / plan.work) - step) * per_step:.0f} min of all stages"
            )
        report(
            f"{f'{plan.label}: ' if plan else ''}step {step} of {config.steps}: loss {line['train']:.4f}, "
            f"validation {line['validation']:.4f}, {_place(line)}{speed / 1e3:.1f} k frames/s, {left}"
        )

    with progress_bar(config.steps, "training", hidden=trainer.processes.rank > 0) as bar:
        bar.update(first)
        fit(trainer, out, lambda step, loss: bar.update(1), report_validation)


def _place(line: dict[str, float]) -> str:
    """Return the accuracy of the head for the place, for messages; "" if there is none."""
    if "contact" not in line:
        return ""
    return f"contacts {100.0 * line['contact']:.1f} %, velocity off by {line['velocity']:.2f} m/s, "
