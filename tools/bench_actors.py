"""Measures which part of the errors is constant within an actor.

    OMP_NUM_THREADS=1 python tools/bench_actors.py --data recordings --model birnn --model rnn

Held-out takes of CMU (recordings of `edgepose synthesize`) run through an archive as `edgepose run` runs
them. Then one rotation per actor and joint without a sensor is fitted to the true poses and removed. The
errors that remain are those of a network that knows how trunk, thighs and upper arms of the actor's skeleton
are aligned with the bones that carry sensors. A recording of a walk does not show this; a calibration in a
straight pose does.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from edgepose.analysis.metrics import joint_angle_error, position_error, sip_error
from edgepose.inference import archive
from edgepose.skeleton import UNOBSERVED, default_body, global_rotations, local_from_global
from edgepose_export.evaluation.evaluate import Mode, modes_of, run_archive, takes_of

Array = NDArray[np.float64]

ACTOR = slice(0, 2)
"""Part of a CMU take's name that identifies the actor, as in "07_01"."""


def without_constants(poses: Sequence[Array], true: Sequence[Array]) -> list[Array]:
    """Return local poses (T, 24, 3, 3) of one actor without the constant part of their errors."""
    joints = list(UNOBSERVED)
    predicted, reference = ([global_rotations(pose) for pose in some] for some in (poses, true))
    errors = [p[:, joints].swapaxes(-1, -2) @ t[:, joints] for p, t in zip(predicted, reference, strict=True)]
    u, _, v = np.linalg.svd(np.concatenate(errors).mean(axis=0))
    u[..., -1] *= np.linalg.det(u @ v)[:, None]
    for rotations in predicted:
        rotations[:, joints] = rotations[:, joints] @ (u @ v)
    return [local_from_global(rotations) for rotations in predicted]


def errors(poses: Sequence[Array], true: Sequence[Array]) -> Array:
    """Return errors (N, 3) of all frames: 15 joints, deg; SIP error, deg; position error, cm."""
    offsets = default_body().offsets
    rows = [
        (joint_angle_error(pose, t), sip_error(pose, t), position_error(pose, t, offsets))
        for pose, t in zip(poses, true, strict=True)
    ]
    return np.concatenate([np.stack(row, axis=1) for row in rows])


@click.command()
@click.option("--data", type=click.Path(path_type=Path), required=True, help="Folder written by synthesize.")
@click.option("--model", "models", multiple=True, default=["birnn", "rnn"], help="Name or path; repeatable.")
@click.option(
    "--part",
    "parts",
    multiple=True,
    default=["cmu-walk-run", "cmu-02"],
    help="Part with CMU's takes; repeatable.",
)
def main(data: Path, models: tuple[str, ...], parts: tuple[str, ...]) -> None:
    """Measure which part of the errors is constant within an actor."""
    click.echo("| | 15 joints, deg / SIP error, deg / position, cm | without an actor's constants | frames |")
    click.echo("|---|---|---|---|")
    for model in models:
        info = archive.read_info(archive.find_archive(model))
        module = archive.load(info, trust=True)
        mode: Mode = next(mode for mode in modes_of(info.metadata) if mode.name == "stream")
        for part in parts:
            actors: dict[str, tuple[list[Array], list[Array]]] = {}
            takes = list(takes_of(data, part))
            for take, pose in zip(takes, run_archive(module, takes, mode), strict=True):
                poses, true = actors.setdefault(take.name[ACTOR], ([], []))
                poses.append(pose)
                true.append(take.pose.astype(float))
            before = np.concatenate([errors(*actor) for actor in actors.values()])
            after = np.concatenate([errors(without_constants(*actor), actor[1]) for actor in actors.values()])
            cells = [" / ".join(f"{value:.1f}" for value in rows.mean(axis=0)) for rows in (before, after)]
            click.echo(f"| `{model}`, {part} | {cells[0]} | {cells[1]} | {len(before)} |")


if __name__ == "__main__":
    main()
