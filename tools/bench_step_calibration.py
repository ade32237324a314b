"""Measures the headings that `edgepose calibrate --heading-reset steps` finds.

\b
    bench_step_calibration.py [MOTION.npz|MOTION.bvh]...

The wearers are those of motion capture who walk straight ahead from one stand to the next (recordings of
`edgepose synthesize` or clips; other motion is passed over), with sensors at random angles, and the real
walker of tests/data/real. Errors are degrees: of the sensors' headings against each other, and of forward.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np

from edgepose import calibration as cal
from edgepose import rotations as rot
from edgepose.calibration import Hold
from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.base import iter_samples, recording_from_samples
from edgepose.formats.recordings.registry import read_recording
from edgepose.imu import Recording, SensorData
from edgepose.orientation import OrientationEstimator
from edgepose.placements import PLACEMENTS
from edgepose.rotations import Array
from edgepose.skeleton import default_body, forward_kinematics, global_rotations, local_from_global
from edgepose_export.mocap import Motion, read_motion, resample
from edgepose_export.synthesis.imu_errors import BMI270, raw
from edgepose_export.synthesis.virtual_imus import random_mounting, virtual_imus, with_hold

REAL = Path(__file__).parents[1] / "tests" / "data" / "real" / "mtw-walk.npz"
REAL_HOLD, REAL_STEPS = (1.0, 5.0), (3.0, 9.5)

RATE, HOLD_S = 100.0, 4.0
STILL_M_S, STAND_S, EDGE_S = 0.25, 0.3, 0.5
"""Speed and length of a stand in motion capture, and the part of it that belongs to a walk, seconds."""

SHORTEST_M, LONGEST_S, MOST_TURN_DEG, MOST_ASIDE_DEG = 0.5, 8.0, 15.0, 15.0
FILTERS = ("none", "kalman", "vqf")


class Result(NamedTuple):
    """Errors of one wearer's headings, degrees: (6,) against each other, of forward, (6,) as estimated."""

    apart_deg: Array
    forward_deg: float
    estimated_deg: Array


def read(path: Path) -> Motion:
    """Read motion capture, or the motion in a recording of `edgepose synthesize`."""
    if path.suffix != ".npz":
        return resample(read_motion(path))
    with np.load(path, allow_pickle=False) as arrays:
        poses, place = arrays["poses"].astype(float), arrays["trans"].astype(float)
        rate = float(arrays["mocap_framerate"])
    local = rot.rotvec_to_matrix(poses.reshape(-1, 24, 3))
    return Motion(global_rotations(local), place, rate, "bvh")


def walks(motion: Motion) -> Iterator[Motion]:
    """Yield the walks straight ahead from stand to stand."""
    _, joints = forward_kinematics(
        local_from_global(motion.rotations), default_body().offsets, motion.translation
    )
    speed = np.linalg.norm(np.gradient(joints, 1.0 / motion.rate, axis=0), axis=-1).max(axis=1)
    edges = np.flatnonzero(np.diff((speed < STILL_M_S).astype(int), prepend=0, append=0)).reshape(-1, 2)
    stands = [(a, b) for a, b in edges if b - a > STAND_S * motion.rate]
    edge = round(EDGE_S * motion.rate)
    for (a, b), (c, d) in pairwise(stands):
        first, last = max((a + b) // 2, b - edge), min((c + d) // 2, c + edge)
        displacement = motion.translation[c] - motion.translation[b]
        facing = [np.arctan2(*motion.rotations[k, 0, [0, 2], 2]) for k in (first, last)]
        ahead = np.arctan2(displacement[0], displacement[2])
        angles = np.array([facing[1] - facing[0], ahead - facing[0], ahead - facing[1]])
        turn, *aside = np.degrees(np.abs(np.angle(np.exp(1j * angles))))
        if (
            np.hypot(displacement[0], displacement[2]) > SHORTEST_M
            and c - b < LONGEST_S * motion.rate
            and turn < MOST_TURN_DEG
            and max(aside) < MOST_ASIDE_DEG
        ):
            part = slice(first, last)
            yield motion._replace(rotations=motion.rotations[part], translation=motion.translation[part])


def stood(motion: Motion) -> Motion:
    """Put the straight pose before and after a walk."""

    def back(forth: Motion) -> Motion:
        return forth._replace(rotations=forth.rotations[::-1], translation=forth.translation[::-1])

    before = with_hold(motion, HOLD_S)
    x, _, z = before.rotations[-1, 0, :, 2]
    both = back(with_hold(back(before), HOLD_S))  # turned so that its end faces Z
    turn = rot.rotation_about_axis("y", np.arctan2(x, z))
    return both._replace(rotations=turn @ both.rotations, translation=both.translation @ turn.T)


def worn(motion: Motion, seed: int, filter: str) -> tuple[Hold, Hold]:
    """Return the samples of sensors at random angles on a body, and of ideal ones with a common north."""
    imus = virtual_imus(resample(motion, RATE), default_body(), random_mounting(seed))
    time_s = np.arange(len(imus.orientation)) / RATE
    ideal = {
        name: SensorData(time_s, imus.orientation[:, i], imus.force[:, i], imus.rate_of_turn[:, i])
        for i, name in enumerate(PLACEMENTS)
    }
    chips = {
        name: raw(data, BMI270, 100 * seed + i, magnetometer=False)
        for i, (name, data) in enumerate(ideal.items())
    }
    if filter == "none":  # exact orientations, with other norths
        norths = rot.quat_about_z(np.random.default_rng(seed).uniform(-np.pi, np.pi, len(PLACEMENTS)))
        chips = {
            name: chips[name]._replace(quat=rot.quat_multiply(north, ideal[name].quat))
            for name, north in zip(PLACEMENTS, norths, strict=True)
        }
        measured = Recording(chips, {})
    else:
        orienter = OrientationEstimator(filter, magnetometer=False)
        measured = recording_from_samples(orienter.orient(list(iter_samples(Recording(chips, {})))))
    return cal.hold_from_recording(measured), cal.hold_from_recording(Recording(ideal, {}))


def result(reset: cal.HeadingReset, true_offset: Array) -> Result:
    """Compare a heading reset with the true offsets (6,), rad, to a frame in which the wearer faces X."""
    error = np.exp(1j * (reset.offset - true_offset))
    forward = error.mean()
    apart_deg, forward_deg = np.degrees(np.angle(error / forward)), float(np.degrees(np.angle(forward)))
    return Result(apart_deg, forward_deg, reset.error_deg)


def simulated(motion: Motion, seed: int, filter: str) -> Result:
    """Calibrate a simulated wearer by steps.

    Raises:
        EdgeposeError: the steps were refused.
    """
    moving, ideal = worn(stood(motion), seed, filter)
    straight, true = (
        cal.check_hold(cal.trim(samples, 0.5, HOLD_S - 0.5)).orientation for samples in (moving, ideal)
    )
    reset = cal.headings_from_steps(cal.trim(moving, 1.0, np.inf), straight)
    return result(reset, rot.yaw_of_quat(rot.quat_multiply(true, rot.quat_conjugate(straight))))


def real() -> Result:
    """Calibrate the real walker, who walks on, by the first steps; forward is unknown."""
    everything = cal.hold_from_recording(read_recording(REAL))
    straight = cal.check_hold(cal.trim(everything, *REAL_HOLD)).orientation
    reset = cal.headings_from_steps(cal.trim(everything, *REAL_STEPS), straight, must_stop=False)
    return result(reset, np.full(len(PLACEMENTS), np.angle(np.exp(1j * reset.offset).mean())))


def row(name: str, wearers: int, refused: int, results: list[Result], known: bool = True) -> str:
    """Return a row of the table; `known` says whether forward is."""
    apart = np.abs([r.apart_deg for r in results])
    cells = [f"{of_sensor.mean():.1f}, {of_sensor.max():.1f}" for of_sensor in apart.T]
    forward = np.abs([r.forward_deg for r in results])
    ahead = f"{forward.mean():.1f}, {forward.max():.1f}" if known else "-"
    estimated = np.mean([r.estimated_deg for r in results])
    return (
        f"| {name} | {wearers} | {refused} | {' | '.join(cells)} | {apart.mean():.1f} | {ahead} | "
        f"{estimated:.1f} |"
    )


@click.command(help=__doc__)
@click.argument("motions", nargs=-1, type=click.Path(exists=True, path_type=Path))
@click.option("--filter", "filters", type=click.Choice(FILTERS), multiple=True, default=FILTERS)
def main(motions: tuple[Path, ...], filters: tuple[str, ...]) -> None:
    """Run the command line."""
    found = [walk for path in motions for walk in walks(read(path))]
    short = " | ".join(name.replace("lower_", "").replace("_", " ") for name in PLACEMENTS)
    click.echo(f"| mean, largest, deg | wearers | refused | {short} | mean of all | forward | estimated |")
    click.echo("|---" * (len(PLACEMENTS) + 6) + "|")
    for filter in filters if found else ():
        results, refused = [], 0
        for seed, walk in enumerate(found):
            try:
                results.append(simulated(walk, seed, filter))
            except EdgeposeError as error:
                refused += 1
                click.echo(f"wearer {seed}, {filter}: {error}", err=True)
        name = "true orientations" if filter == "none" else f"`{filter}`"
        click.echo(row(name, len(found), refused, results))
    click.echo(row("real walker", 1, 0, [real()], known=False))


if __name__ == "__main__":
    main()
