"""`edgepose train`: trains or fine-tunes a network."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import click

from edgepose.errors import EdgeposeError

CONFIGS = Path(__file__).parent.parent / "configs"


def _config_path(name: str) -> Path:
    shipped = CONFIGS / f"{name}.toml"
    return shipped if shipped.is_file() else Path(name)


@click.command(short_help="Train a network.")
@click.option(
    "--config",
    required=True,
    metavar="NAME|FILE",
    help="Shipped config (birnn, rnn, dip-birnn, dip-rnn) or a TOML file.",
)
@click.option(
    "--data",
    required=True,
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="Folder that `edgepose synthesize` wrote.",
)
@click.option(
    "--out",
    required=True,
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder for checkpoints and the log.",
)
@click.option("--resume", is_flag=True, help="Go on from the checkpoint in --out.")
@click.option(
    "--init", type=click.Path(path_type=Path), help="Start from this checkpoint's weights (fine-tuning)."
)
@click.option("--steps", type=click.IntRange(1), help="Steps to train  [default: the config's]")
@click.option("--threads", type=click.IntRange(1), default=2, show_default=True, help="Processor threads.")
def train(
    config: str, data: Path, out: Path, resume: bool, init: Path | None, steps: int | None, threads: int
) -> None:
    """Train a network on synthetic recordings. Ctrl-C loses at most the steps since the last checkpoint.

    \b
    Examples:
      edgepose train --config birnn --data recordings/ --out runs/birnn
      edgepose train --config birnn --data recordings/ --out runs/birnn --resume
      edgepose train --config birnn --data mine/ --out runs/tuned --init runs/birnn/best.pt --steps 2000
    """
    if resume and init:
        raise click.UsageError(
            "--resume goes on with a run, --init begins one from other weights: give one of them"
        )
    from dataclasses import replace

    import torch

    from edgepose_export import training
    from edgepose_export.cli.progress import labelled
    from edgepose_export.dataset import describe_takes, read_training_takes, tape

    settings = training.read_config(_config_path(config))
    if steps:
        settings = replace(settings, steps=steps)
    checkpoint = out / training.CHECKPOINT
    if not resume and checkpoint.exists():
        raise EdgeposeError(
            f"{checkpoint}: there is a run already; go on with --resume or choose another --out"
        )
    torch.set_num_threads(threads)
    out.mkdir(parents=True, exist_ok=True)
    takes, validation = read_training_takes(data, labelled("reading takes"))
    about = describe_takes(takes)
    click.echo(f"training on {about['takes']} takes, {about['hours']:.2f} h: {about['summary']}", err=True)
    trainer = training.Trainer(settings, tape(takes), tape(validation), about)
    if resume:
        trainer.load(training.read_checkpoint(checkpoint))
        click.echo(f"going on at step {trainer.step}", err=True)
    if init:
        trainer.start_from(training.read_checkpoint(init))
    _fit(trainer, out)


def _fit(trainer, out: Path) -> None:  # type: ignore[no-untyped-def]
    from edgepose_export.training import fit

    config = trainer.config
    started, first = time.monotonic(), trainer.step

    def line(step: int, loss: float, validation: float) -> None:
        spent = time.monotonic() - started
        speed = (step - first) * config.sequences * config.window / spent
        left = (config.steps - step) * spent / (step - first) / 60
        click.echo(
            f"{chr(13) if sys.stderr.isatty() else ''}step {step} of {config.steps}: loss {loss:.4f}, "
            f"validation {validation:.4f}, {speed / 1e3:.1f} k frames/s, {left:.0f} min left",
            err=True,
        )

    with click.progressbar(
        length=config.steps, label="training", file=sys.stderr, hidden=not sys.stderr.isatty()
    ) as bar:
        bar.update(first)
        fit(trainer, out, lambda step, loss: bar.update(1), line)
