"""Measures what drifting headings cost, and how much of that a run's correction saves.

    OMP_NUM_THREADS=1 python tools/bench_drift.py --data recordings --seated seated --out drift.json

Held-out takes (recordings of `edgepose synthesize`) of people who stand, walk, sit and do sports are joined
to tracks of 20 minutes. Each gyroscope gets a bias of 0.5 to 10 deg a minute, to either side, and a scale
error of up to 0.5 %. A second table has parts and situations of rigs that do not drift, where a correction
can only do harm, and a third one the recording of a real wearer, whose headings drift by 10 deg a minute.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import click
import drift_tracks as tracks
import numpy as np
from drift_tracks import Track
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.analysis.metrics import joint_angle_error
from edgepose.calibration import POSES
from edgepose.imu import GRAVITY, ImuFrame
from edgepose.inference import archive
from edgepose.inference.model import Model
from edgepose.orientation.drift import DriftCorrector
from edgepose.placements import PLACEMENTS, ROOT
from edgepose_export.evaluation.evaluate import Mode, modes_of, run_archive, takes_of
from edgepose_export.evaluation.real_wearers import FOLDER, gait_columns, read_sitter, thigh_columns
from edgepose_export.synthesis.virtual_imus import INERTIAL_FROM_BODY
from edgepose_export.training.dataset import RATE, Take, read_take, take_paths

Array = NDArray[np.float64]

STANDING, WALKING, SPORTS = ("pushes",), ("cmu-walk-run", "walks-validation"), ("sports",)
PARTS = ("cmu-walk-run", "cmu-02", "pushes", "basketball", "tennis", "boxing", "martial-arts")
MINUTES = (1, 5, 10, 20)
EVERY = 3
"""The correction sees every third frame, which saves time: it looks at half a second at once."""
BIAS_DEG_MIN = (0.5, 10.0)
SCALE = 0.005
REAL_DRIFT = np.radians(10.0 / 60.0) * np.array([1.0, -1.0, 1.0, -1.0, -1.0, 1.0])
"""Of the real wearer's sensors, rad/s."""
VARIANTS = ("no drift", "no drift, corrected", "drift", "drift, corrected")


def corrections(take: Take) -> Array:
    """Return the angles (T, 6), rad, by which a run turns the sensors of a take back."""
    corrector = DriftCorrector(POSES["straight"], PLACEMENTS, ROOT)
    measured = take.orientation[::EVERY].astype(float)
    quats = rot.matrix_to_quat(INERTIAL_FROM_BODY @ measured)
    force, held, offset = np.tile([0.0, 0.0, GRAVITY], (len(PLACEMENTS), 1)), np.zeros(6, bool), np.zeros(6)
    angles, time_s = np.empty(quats.shape[:2]), np.arange(len(quats)) * EVERY / RATE
    for t, bones in enumerate(measured):
        corrector.correct(ImuFrame(t, time_s[t], quats[t], force, held, time_s[t]))
        angles[t] = corrector.corrections
        cos, sin = np.cos(angles[t])[:, None], np.sin(angles[t])[:, None]
        x, z = bones[:, 0], bones[:, 2]
        corrector.observe(np.stack([cos * x - sin * z, bones[:, 1], sin * x + cos * z], axis=1), offset)
    return np.repeat(angles, EVERY, axis=0)[: len(take.orientation)]


def against_pelvis(angles: Array) -> Array:
    """Return the mean size (T,), deg, of heading errors (T, 6) against that of the pelvis."""
    away = np.delete(angles - angles[:, ROOT:], ROOT, axis=1)
    return np.degrees(np.abs((away + np.pi) % (2.0 * np.pi) - np.pi)).mean(axis=1)


def variants(track: Track, errors: Array) -> dict[str, tuple[Take, Array]]:
    """Return a track with and without drift and correction, and their heading errors, deg."""
    drifting = tracks.turned(track.take, errors)
    found = corrections(track.take)
    found_drift = corrections(drifting)
    left = (np.zeros_like(errors), -found, errors, errors - found_drift)
    takes = (track.take, tracks.turned(track.take, -found), drifting, tracks.turned(drifting, -found_drift))
    return {
        name: (take, against_pelvis(angles)) for name, take, angles in zip(VARIANTS, takes, left, strict=True)
    }


def draw_drift(take: Take, rng: np.random.Generator) -> Array:
    """Draw gyroscopes; return their heading errors (T, 6), rad."""
    bias = np.radians(rng.uniform(*BIAS_DEG_MIN, ROOT + 1) / 60.0) * rng.choice([-1.0, 1.0], ROOT + 1)
    return tracks.drift(take, bias, rng.uniform(-SCALE, SCALE, ROOT + 1))


def pose_errors(model: str, takes: list[Take]) -> list[Array]:
    """Return the mean error of 15 joints (T,), deg, of each take, run as a stream."""
    info = archive.read_info(archive.find_archive(model))
    mode: Mode = next(mode for mode in modes_of(info.metadata) if mode.name == "stream")
    poses = run_archive(archive.load(info, trust=True), takes, mode)
    return [joint_angle_error(pose, take.pose) for pose, take in zip(poses, takes, strict=True)]


def long_tracks(
    data: Path, seated: list[Take], count: int, minutes: float
) -> list[dict[str, tuple[Take, Array]]]:
    """Return tracks in all variants; the counting frames of a track are those that are not NaN."""
    kinds = [[t for part in parts for t in takes_of(data, part)] for parts in (STANDING, WALKING)]
    kinds += [seated, [take for take in takes_of(data, SPORTS[0])]]
    result = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        track = tracks.random_track(kinds, 60.0 * minutes, rng)
        made = variants(track, draw_drift(track.take, rng))
        result.append(
            {name: (take, np.where(track.counts, left, np.nan)) for name, (take, left) in made.items()}
        )
    return result


def situations(data: Path, seated: list[Take], minutes: float) -> dict[str, Track]:
    """Return tracks of parts and of situations in which headings of bones mislead."""
    rng = np.random.default_rng(0)
    takes = {part: list(takes_of(data, part)) for part in PARTS} | {"sitting": seated}
    standing, walking = takes["pushes"], takes["cmu-walk-run"]
    made = {name: tracks.random_track([kind], 60.0 * minutes, rng) for name, kind in takes.items()}
    for name, change, kind in (
        ("turning on the spot", tracks.turning, [standing]),
        ("lying", tracks.lying, [standing]),
        ("sitting askew", tracks.sitting_askew, [seated]),
        ("one-armed work", tracks.one_armed, [standing, walking]),
    ):
        track = tracks.random_track(kind, 60.0 * minutes, rng)
        made[name] = Track(change(track.take), track.counts)
    return made


def cut(take: Take, rows: slice) -> Take:
    """Return some frames of a take."""
    return Take(take.name, take.orientation[rows], take.acceleration[rows], take.pose[rows], take.license)


def minute(end: int) -> slice:
    """Return the frames of the minute that ends at another one."""
    return slice(round((end - 1) * 60.0 * RATE), round(end * 60.0 * RATE))


def measure_tracks(
    model: str, made: list[dict[str, tuple[Take, Array]]], minutes: float
) -> dict[str, object]:
    """Print errors in some minutes; return them, by variant."""
    ends = [end for end in MINUTES if end <= minutes]
    keys = [(k, name, end) for name in VARIANTS for end in ends for k in range(len(made))]
    takes = [cut(made[k][name][0], minute(end)) for k, name, end in keys]
    errors = dict(zip(keys, pose_errors(model, takes), strict=True))
    table: dict[str, object] = {}
    click.echo(f"\n{model}: error of 15 joints (of headings), deg, in the minute that ends at\n")
    click.echo(
        "| rig | " + " | ".join(f"{end} min" for end in ends) + " |\n" + "|---" * (len(ends) + 1) + "|"
    )
    for name in VARIANTS:
        left = [[each[name][1][minute(end)] for each in made] for end in ends]
        headings = [float(np.nanmean(rows)) for rows in left]
        joints = [
            float(np.mean([np.mean(errors[k, name, end][~np.isnan(row)]) for k, row in enumerate(rows)]))
            for end, rows in zip(ends, left, strict=True)
        ]
        table[name] = {"minutes": ends, "joints": joints, "headings": headings}
        cells = [f"{joint:.1f} ({heading:.1f})" for joint, heading in zip(joints, headings, strict=True)]
        click.echo(f"| {name} | {' | '.join(cells)} |")
    return table


def measure_situations(model: str, made: Mapping[str, Track], found: Mapping[str, Array]) -> dict[str, float]:
    """Print what the correction costs where nothing drifts; return it by situation, deg."""
    takes = [track.take for track in made.values()]
    takes += [tracks.turned(track.take, -found[name]) for name, track in made.items()]
    errors = pose_errors(model, takes)
    costs = {}
    click.echo(f"\n{model}: rigs that do not drift, error of 15 joints, deg\n")
    click.echo("| part or situation | as it is | corrected | cost | headings |\n|---|---|---|---|---|")
    for i, (name, track) in enumerate(made.items()):
        before, after = (errors[k][track.counts].mean() for k in (i, i + len(made)))
        costs[name] = float(after - before)
        wrong = against_pelvis(-found[name])[track.counts].mean()
        click.echo(f"| {name} | {before:.1f} | {after:.1f} | {after - before:+.2f} | {wrong:.1f} |")
    return costs


def measure_real(model: str) -> None:
    """Print figures of the real wearer, whose sensors drift from the beginning or not."""
    wearer, network = read_sitter(FOLDER), Model(model)
    errors = REAL_DRIFT * (wearer.time_s - wearer.time_s[0])[:, None]
    drifting = tracks.turned(wearer.take, errors)
    found, found_drift = corrections(wearer.take), corrections(drifting)
    takes = (
        wearer.take, tracks.turned(wearer.take, -found), drifting, tracks.turned(drifting, -found_drift)
    )  # fmt: skip
    straight = network.poses(wearer.take.orientation, wearer.take.acceleration)
    click.echo(f"\n{model}: a real wearer\n")
    for name, take in zip(VARIANTS, takes, strict=True):
        poses = network.poses(take.orientation, take.acceleration)
        away = joint_angle_error(poses, straight)
        cells = {}
        for side, joint in (("left", 1), ("right", 2)):
            cells |= {f"{side} thigh, {k}": v.mean for k, v in thigh_columns(wearer, poses, joint).items()}
        cells |= {k: v.mean for k, v in gait_columns(wearer, poses).items() if "Hz" in k}
        for part, span in {"sitting": (73.0, 79.0), "walking": (97.0, 113.0)}.items():
            cells[f"{part}: 15 joints from no drift"] = float(away[wearer.during(span)].mean())
        click.echo(f"{name}: " + ", ".join(f"{key} {value:.1f}" for key, value in cells.items()))


@click.command()
@click.option("--data", type=click.Path(path_type=Path), required=True, help="Folder written by synthesize.")
@click.option("--seated", type=click.Path(path_type=Path), required=True, help="The same with --seated.")
@click.option("--model", "models", multiple=True, default=["birnn", "rnn"], help="Name or path; repeatable.")
@click.option("--tracks", "count", default=4, show_default=True, help="Number of long tracks.")
@click.option("--minutes", default=20.0, show_default=True, help="Length of a track.")
@click.option("--short", default=5.0, show_default=True, help="Length of the parts and situations, minutes.")
@click.option("--out", type=click.Path(path_type=Path), help="JSON file of the figures, for draw_drift.py.")
def main(
    data: Path,
    seated: Path,
    models: tuple[str, ...],
    count: int,
    minutes: float,
    short: float,
    out: Path | None,
) -> None:
    """Measure what drifting headings cost, and how much of that a run's correction saves."""
    sitting = [read_take(path, seated) for path in take_paths(seated, "all")]
    long = long_tracks(data, sitting, count, minutes)
    made = situations(data, sitting, short)
    found = {name: corrections(track.take) for name, track in made.items()}
    figures = {}
    for model in models:
        figures[model] = {
            "tracks": measure_tracks(model, long, minutes) if long else {},
            "costs": measure_situations(model, made, found),
        }
        measure_real(model)
    if out is not None:
        out.write_text(json.dumps(figures, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
