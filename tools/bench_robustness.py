"""Measures how much accuracy a lost sensor, slipped sensors or wrong headings cost.

    OMP_NUM_THREADS=1 python tools/bench_robustness.py --data recordings --model birnn --model rnn

Held-out takes (recordings of `edgepose synthesize`) run through an archive as `edgepose run` runs them, once
unchanged and once with each fault. The rows of a lost sensor count only the frames in which it is lost. The
errors of the same frames without the fault stand beside them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.analysis.metrics import joint_angle_error, sip_error
from edgepose.inference import archive
from edgepose.pipeline.dropout import extrapolate_dropouts
from edgepose.placements import PLACEMENTS, ROOT
from edgepose_export.evaluation.evaluate import Mode, groups, modes_of, run_archive, takes_of
from edgepose_export.training.dataset import RATE, Take
from edgepose_export.training.sources import HELD_OUT

Array = NDArray[np.float64]

LOST_S, BACK_S = 5.0, 5.0
"""Alternating times for which a sensor is lost and present; a take begins with all sensors."""

ERROR_DEG = 10.0
"""Misalignment of each sensor with its bone, or error of each heading relative to the pelvis."""


class Fault(NamedTuple):
    """A fault of the sensors.

    Attributes:
        apply: returns a take with the fault.
        counts: returns a mask (T,) of the frames with the fault, for a take of T frames.
    """

    apply: Callable[[Take], Take]
    counts: Callable[[int], NDArray[np.bool_]]


def lost_frames(frames: int) -> NDArray[np.bool_]:
    """Return a mask (frames,) of the times at which a sensor is lost: the second half of a short take."""
    time_s = np.arange(frames) / RATE
    if time_s[-1] < BACK_S:
        return time_s > 0.5 * time_s[-1]
    return time_s % (BACK_S + LOST_S) >= BACK_S


def sensor_lost(sensor: int) -> Fault:
    """Return the fault of a sensor that is lost now and then; its bone is extrapolated as in a run."""

    def apply(take: Take) -> Take:
        missing = lost_frames(len(take.pose))
        last = np.maximum.accumulate(np.where(missing, 0, np.arange(len(missing))))
        orientation, acceleration = take.orientation.copy(), take.acceleration.copy()
        orientation[:, sensor], acceleration[:, sensor] = (
            orientation[last, sensor],
            acceleration[last, sensor],
        )
        column, before = np.arange(len(PLACEMENTS)) == sensor, None
        for t, held in enumerate(missing[:, None] & column):
            before, acceleration[t] = extrapolate_dropouts(orientation[t], acceleration[t], held, before)
            orientation[t] = before
        return take._replace(orientation=orientation, acceleration=acceleration)

    return Fault(apply, lost_frames)


def all_frames(frames: int) -> NDArray[np.bool_]:
    """Return a mask (frames,) of all frames."""
    return np.ones(frames, bool)


def _random(take: Take) -> np.random.Generator:
    return np.random.default_rng([*take.name.encode()])


def with_slipped_sensors(take: Take) -> Take:
    """Return the take with each sensor rotated on its bone about a random axis, drawn for each take."""
    axes = _random(take).normal(size=(len(PLACEMENTS), 3))
    axes *= np.radians(ERROR_DEG) / np.linalg.norm(axes, axis=-1, keepdims=True)
    rotated = take.orientation @ rot.rotvec_to_matrix(axes)
    return take._replace(orientation=rotated.astype(np.float32))


def with_wrong_headings(take: Take) -> Take:
    """Return the take with all headings except the pelvis' wrong, to random sides drawn for each take."""
    vectors = np.zeros((len(PLACEMENTS), 3))
    vectors[:ROOT, 1] = np.radians(ERROR_DEG) * _random(take).choice([-1.0, 1.0], ROOT)
    rotations = rot.rotvec_to_matrix(vectors)
    return take._replace(
        orientation=(rotations @ take.orientation).astype(np.float32),
        acceleration=np.einsum("sij,tsj->tsi", rotations, take.acceleration).astype(np.float32),
    )


FAULTS = {
    **{f"{name} lost": sensor_lost(i) for i, name in enumerate(PLACEMENTS)},
    f"each sensor slipped by {ERROR_DEG:g} deg": Fault(with_slipped_sensors, all_frames),
    f"each heading wrong by {ERROR_DEG:g} deg": Fault(with_wrong_headings, all_frames),
}


def errors(poses: Sequence[Array], takes: Sequence[Take], fault: Fault) -> list[Array]:
    """Return, for each take, 15-joint and SIP errors (N, 2), deg, of the frames with the fault."""
    return [
        np.stack([joint_angle_error(pose, take.pose), sip_error(pose, take.pose)], 1)[
            fault.counts(len(take.pose))
        ]
        for pose, take in zip(poses, takes, strict=True)
    ]


@click.command()
@click.option("--data", type=click.Path(path_type=Path), required=True, help="Folder written by synthesize.")
@click.option("--model", "models", multiple=True, default=["birnn", "rnn"], help="Name or path; repeatable.")
@click.option("--part", "parts", multiple=True, default=list(HELD_OUT), help="Part of the split; repeatable.")
@click.option("--every", default=1, metavar="N", help="Use every Nth take only.")
def main(data: Path, models: tuple[str, ...], parts: tuple[str, ...], every: int) -> None:
    """Measure how much accuracy a lost sensor, slipped sensors or wrong headings cost."""
    for model in models:
        info = archive.read_info(archive.find_archive(model))
        module = archive.load(info, trust=True)
        mode: Mode = next(mode for mode in modes_of(info.metadata) if mode.name == "stream")
        for part in parts:
            pairs: dict[str, list[tuple[Array, Array]]] = {}
            for group in groups(list(takes_of(data, part))[::every]):
                healthy = run_archive(module, group, mode)
                for name, fault in FAULTS.items():
                    faulty = run_archive(module, [fault.apply(take) for take in group], mode)
                    pairs.setdefault(name, []).extend(
                        zip(errors(healthy, group, fault), errors(faulty, group, fault), strict=True)
                    )
            table(f"{model}, {mode}, {part}", pairs)


def table(title: str, pairs: dict[str, list[tuple[Array, Array]]]) -> None:
    """Print means without and with each fault."""
    click.echo(f"\n{title}\n")
    click.echo("| fault | 15 joints, deg | without it | costs | SIP, deg | without it | costs | frames |")
    click.echo("|---|---|---|---|---|---|---|---|")
    lost_costs = []
    for name, rows in pairs.items():
        before, after = (np.concatenate(side).mean(axis=0) for side in zip(*rows, strict=True))
        cells = [f"{after[i]:.1f} | {before[i]:.1f} | {after[i] - before[i]:+.1f}" for i in range(2)]
        click.echo(f"| {name} | {cells[0]} | {cells[1]} | {sum(len(row) for row, _ in rows)} |")
        if name.endswith(" lost"):
            lost_costs.append(after - before)
    mean = np.mean(lost_costs, axis=0)
    click.echo(f"| mean of the lost sensors | | | {mean[0]:+.1f} | | | {mean[1]:+.1f} | |")


if __name__ == "__main__":
    main()
