"""Measures the accuracy of rigs that lack some of the six sensors, or have more.

    OMP_NUM_THREADS=1 python tools/bench_rigs.py recordings/07 recordings/08 recordings/09

Held-out takes (recordings of `edgepose synthesize`) run through a model as `edgepose run` runs them. Bones of
further sensors are true: what is measured is what they do to the joints around them. The last column is the
real walker of tests/data/real.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from edgepose.analysis.metrics import joint_angle_error, sip_error
from edgepose.imu import AddedFrame
from edgepose.inference import archive
from edgepose.pipeline.added_sensors import AddedSensorStage
from edgepose.pipeline.dropout import assumed_bones, extrapolate_dropouts
from edgepose.placements import PLACEMENTS, SITES
from edgepose.pose import PoseFrame
from edgepose.skeleton import global_rotations
from edgepose_export.evaluation.evaluate import Mode, modes_of, run_archive
from edgepose_export.evaluation.real_wearers import FOLDER, WALKER, Wearer, read_walker, walker_columns
from edgepose_export.training.dataset import RATE, Take, read_take

Array = NDArray[np.float64]
Run = Callable[[list[Take]], list[Array]]
"""Returns local poses (T, 24, 3, 3) of takes."""

FEWER = {
    "six sensors": (),
    "no head": ("head",),
    "no left forearm": ("left_forearm",),
    "no forearms": ("left_forearm", "right_forearm"),
    "no left lower leg": ("left_lower_leg",),
    "no lower legs": ("left_lower_leg", "right_lower_leg"),
    "no head, no forearms": ("head", "left_forearm", "right_forearm"),
    "pelvis only": tuple(name for name in PLACEMENTS if name != "pelvis"),
}
"""Sensors that a rig lacks, by the name of its row."""

MORE = {
    "chest": ("chest",),
    "shoulders": ("left_shoulder", "right_shoulder"),
    "upper arms": ("left_upper_arm", "right_upper_arm"),
    "thighs": ("left_upper_leg", "right_upper_leg"),
    "upper arms, thighs": ("left_upper_arm", "right_upper_arm", "left_upper_leg", "right_upper_leg"),
    "upper arms, thighs, chest": (
        "chest", "left_upper_arm", "right_upper_arm", "left_upper_leg", "right_upper_leg",
    ),
}  # fmt: skip
"""Sensors that a rig has besides the six, by the name of its row."""


def lacking(take: Take, names: Sequence[str]) -> Take:
    """Return a take whose rig lacks sensors, with their bones as in a run."""
    missing = np.array([name in names for name in PLACEMENTS])
    orientation, acceleration = take.orientation.astype(float), take.acceleration.astype(float)
    before = assumed_bones(orientation[0], missing)
    for t in range(len(orientation)):
        before, acceleration[t] = extrapolate_dropouts(orientation[t], acceleration[t], missing, before)
        orientation[t] = before
    return take._replace(
        orientation=orientation.astype(np.float32), acceleration=acceleration.astype(np.float32)
    )


def with_added(local: Array, take: Take, names: Sequence[str]) -> Array:
    """Return poses (T, 24, 3, 3) of a take with the true bones of further sensors."""
    stage, joints = AddedSensorStage(names), [SITES[name] for name in names]
    true = global_rotations(take.pose)
    quats, held = np.zeros((len(names), 4)), np.zeros(len(names), bool)
    return np.stack(
        [
            stage.correct(
                PoseFrame(t, t / RATE, pose, np.zeros(24, np.float32)),
                AddedFrame(quats, held, true[t, joints]),
            ).rotations
            for t, pose in enumerate(local)
        ]
    )


def errors(local: Array, take: Take) -> Array:
    """Return SIP and 15-joint errors (T, 2), deg."""
    return np.stack([sip_error(local, take.pose), joint_angle_error(local, take.pose)], axis=1)


def measured(run: Run, takes: list[Take]) -> dict[str, Array]:
    """Return the mean SIP and 15-joint errors (2,) of takes, deg, by rig."""
    rows = {}
    for rig, lack in FEWER.items():
        rows[rig] = run([lacking(take, lack) for take in takes])
    for rig, added in MORE.items():
        poses = zip(rows["six sensors"], takes, strict=True)
        rows[f"and {rig}"] = [with_added(local, take, added) for local, take in poses]
    return {
        rig: np.concatenate([errors(*pair) for pair in zip(poses, takes, strict=True)]).mean(axis=0)
        for rig, poses in rows.items()
    }


def walker(run: Run, wearer: Wearer) -> dict[str, float]:
    """Return the mean error of the real walker's thighs, upper arms and back while walking, deg, by rig."""
    span = WALKER.parts["walking and turning"]
    # There is no true pose; its length is that of the take.
    take = wearer.take._replace(pose=np.zeros((len(wearer.take.orientation), 24, 3, 3), np.float32))
    poses = run([lacking(take, lack) for lack in FEWER.values()])
    return {
        rig: walker_columns(wearer, local, span)["mean of 5"].mean
        for rig, local in zip(FEWER, poses, strict=True)
    }


@click.command()
@click.argument("folders", nargs=-1, type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--model", "models", multiple=True, default=["birnn", "rnn"], help="Name or path; repeatable.")
@click.option("--every", default=1, metavar="N", help="Use every Nth take of each folder only.")
def main(folders: tuple[Path, ...], models: tuple[str, ...], every: int) -> None:
    """Measure the accuracy of rigs that lack some of the six sensors, or have more."""
    wearer = read_walker(FOLDER)
    for name in models:
        info = archive.read_info(archive.find_archive(name))
        module = archive.load(info, trust=True)
        mode: Mode = next(mode for mode in modes_of(info.metadata) if mode.name == "stream")
        run = partial(run_archive, module, mode=mode)
        columns = {}
        for folder in folders:
            takes = [read_take(path) for path in sorted(folder.glob("*.npz"))[::every]]
            columns[f"{folder.name}, {sum(len(take.pose) for take in takes)}"] = measured(run, takes)
        real = walker(run, wearer)
        head = " | ".join([f"{name}; SIP / 15 joints, deg; frames", *columns, "real walker, 5 bones"])
        click.echo(f"\n| {head} |\n|---|{'---|' * (len(columns) + 1)}")
        for rig in [*FEWER, *(f"and {more}" for more in MORE)]:
            cells = [f"{column[rig][0]:.1f} / {column[rig][1]:.1f}" for column in columns.values()]
            click.echo(f"| {' | '.join([rig, *cells, f'{real[rig]:.1f}' if rig in real else ''])} |")


if __name__ == "__main__":
    main()
