"""`edgepose train`: training and fine-tuning of a network."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import click

from edgepose.cli.terminal.messages import progress_bar, say
from edgepose.errors import EdgeposeError


def _config_path(name: str) -> Path:
    from edgepose_export.training.config import CONFIGS

    shipped = CONFIGS / f"{name}.toml"
    return shipped if shipped.is_file() else Path(name)


@click.command(short_help="Train a network.")
@click.option(
    "--config",
    required=True,
    metavar="NAME|FILE",
    help="Shipped config, such as birnn or dip-rnn (docs/research/training.md in the repository lists all), "
    "or a TOML file.",
)
@click.option(
    "--data",
    required=True,
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="Folder written by `edgepose synthesize`.",
)
@click.option(
    "--out",
    required=True,
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder for checkpoints and the log.",
)
@click.option("--resume", is_flag=True, help="Continue from the checkpoint in --out.")
@click.option(
    "--init", type=click.Path(path_type=Path), help="Start from this checkpoint's weights (fine-tuning)."
)
@click.option("--steps", type=click.IntRange(1), help="Steps to train  [default: the config's]")
@click.option(
    "--cache",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder for packed takes, 1152 bytes per frame, which are memory-mapped instead of read: for more "
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
    config: str,
    data: Path,
    out: Path,
    resume: bool,
    init: Path | None,
    steps: int | None,
    cache: Path | None,
    threads: int,
) -> None:
    """Train a network on synthetic recordings. Ctrl-C loses only the steps since the last checkpoint.

    Several processes started by torchrun train together, each with its share of the takes.

    \b
    Examples:
      edgepose train --config birnn --data recordings/ --out runs/birnn
      edgepose train --config birnn --data recordings/ --out runs/birnn --resume
      edgepose train --config birnn --data mine/ --out runs/tuned --init runs/birnn/best.pt --steps 2000
      torchrun --nproc-per-node 4 -m edgepose train --config birnn --data recordings/ --out runs/birnn
    """
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
        _train(settings, data, out, processes, resume, init, cache)


def _train(  # type: ignore[no-untyped-def]
    settings, data: Path, out: Path, processes, resume: bool, init: Path | None, cache: Path | None
) -> None:
    from edgepose_export.training import trainer as training
    from edgepose_export.training.dataset import training_paths

    parts = [
        _tape(processes.share(paths), data, processes, cache and cache / part)
        for part, paths in zip(("train", "validation"), training_paths(data), strict=True)
    ]
    about = training.describe_tape(parts[0], processes)
    trainer = training.Trainer(settings, *parts, about, processes)
    report = say if processes.rank == 0 else lambda text: None
    report(f"training on {about['takes']} takes, {about['hours']:.2f} h: {about['summary']}")
    out.mkdir(parents=True, exist_ok=True)
    if resume:
        trainer.load(training.read_checkpoint(out / training.CHECKPOINT))
        report(f"continuing at step {trainer.step}")
    if init:
        trainer.start_from(training.read_checkpoint(init))
    _fit(trainer, out, report)


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


def _fit(trainer, out: Path, report: Callable[[str], None]) -> None:  # type: ignore[no-untyped-def]
    from edgepose_export.training.trainer import fit

    config = trainer.config
    started, first = time.monotonic(), trainer.step

    def report_validation(step: int, loss: float, validation: float) -> None:
        elapsed = time.monotonic() - started
        speed = (step - first) * config.sequences * config.window / elapsed
        left = (config.steps - step) * elapsed / (step - first) / 60
        report(
            f"step {step} of {config.steps}: loss {loss:.4f}, "
            f"validation {validation:.4f}, {speed / 1e3:.1f} k frames/s, {left:.0f} min left"
        )

    with progress_bar(config.steps, "training", hidden=trainer.processes.rank > 0) as bar:
        bar.update(first)
        fit(trainer, out, lambda step, loss: bar.update(1), report_validation)
