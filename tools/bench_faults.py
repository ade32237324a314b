"""Counts how often `run` and `check` name faults of simulated rigs, and how often they report a good one.

\b
    bench_faults.py CLIP.bvh...

Each clip is worn by sensors at random angles, with a common north and without one. The wearer stands straight
for 6 s first; the calibration is made from 3 s of that.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import click
import numpy as np
from simulate import NOISE_ACC, NOISE_GYR, NOISE_QUAT, Rig, simulate_clip

from edgepose import calibration as cal
from edgepose import rotations as rot
from edgepose.calibration.misfit import MisfitDetector
from edgepose.diagnostics.rules import diagnose
from edgepose.diagnostics.sensor_health import SensorHealthMonitor
from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.base import iter_samples
from edgepose.imu import Recording, SensorData
from edgepose.pipeline.frame_synchronizer import FrameSynchronizer
from edgepose.placements import PLACEMENTS

HOLD_FROM_S, HOLD_S, LONGEST_S = 1.0, 3.0, 60.0
PAIRS = (("left_forearm", "right_forearm"), ("left_lower_leg", "right_lower_leg"), ("head", "pelvis"))


def worn(clip: Path, seed: int) -> Recording:
    """Simulate noisy sensors at random angles on the body of a clip, at most a minute of it."""
    rng = np.random.default_rng(seed)
    sensors = {}
    for name, data in simulate_clip(clip, Rig(mounting=seed)).sensors.items():
        rows = data.time_s < LONGEST_S
        count = np.count_nonzero(rows)
        shake = np.concatenate([np.ones((count, 1)), rng.normal(0.0, NOISE_QUAT / 2.0, (count, 3))], axis=1)
        quat = rot.quat_multiply(data.quat[rows], shake)
        sensors[name] = SensorData(
            data.time_s[rows],
            quat / np.linalg.norm(quat, axis=1, keepdims=True),
            data.acc[rows] + rng.normal(0.0, NOISE_ACC, (count, 3)),
            data.gyr[rows] + rng.normal(0.0, NOISE_GYR, (count, 3)),
        )
    return Recording(sensors, {})


def turned(recording: Recording, name: str, angle_deg: float, seed: int) -> Recording:
    """Turn one sensor about a level axis of the inertial frame."""
    data = recording.sensors[name]
    heading = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi)
    axis = rot.quat_rotate(rot.quat_conjugate(data.quat[0]), [np.cos(heading), np.sin(heading), 0.0])
    turn = rot.matrix_to_quat(rot.rotvec_to_matrix(np.radians(angle_deg) * axis))
    back = rot.quat_conjugate(turn)
    moved = data._replace(
        quat=rot.quat_multiply(data.quat, turn),
        acc=rot.quat_rotate(back, data.acc),
        gyr=rot.quat_rotate(back, data.gyr),
    )
    return Recording(recording.sensors | {name: moved}, {})


def warnings_of_run(recording: Recording, calibration: cal.Calibration) -> list[str]:
    """Return the warnings of a run about the calibration."""
    samples = list(iter_samples(recording))
    misfits, clock = MisfitDetector(calibration), FrameSynchronizer(60.0)
    clock.push(samples, samples[-1].time_s)
    lines = []
    for frame in clock.flush():
        bones, _ = cal.apply_calibration(calibration, frame.orientation, frame.force)
        lines += misfits.update(frame, bones)
    return lines + misfits.at_end()


def misplaced_by_check(recording: Recording, calibration: cal.Calibration) -> set[str]:
    """Return the sensors that `check` finds misplaced."""
    monitor, samples = SensorHealthMonitor(calibration), list(iter_samples(recording))
    for first in range(0, len(samples), 600):
        monitor.add(samples[first : first + 600])
    found = [(row.placement, diagnose(row).name) for row in monitor.report(samples[-1].time_s)]
    return {name for name, finding in found if finding in ("placement", "heading")}


def faults(recording: Recording, seed: int) -> Iterator[tuple[str, set[str], Recording]]:
    """Yield faulty recordings, with the name of the fault and the sensors that should be named."""
    for i, name in enumerate(PLACEMENTS):
        yield "slipped by 40 deg", {name}, turned(recording, name, 40.0, seed + i)
        yield "upside down", {name}, turned(recording, name, 180.0, seed + i)
    for pair in PAIRS:
        one, other = (recording.sensors[name] for name in pair)
        exchanged = recording.sensors | {pair[0]: other, pair[1]: one}
        yield f"{pair[0]} and {pair[1]} exchanged", set(pair), Recording(exchanged, {})


def count(clips: Sequence[Path], with_faults: bool) -> Counter[tuple[str, str]]:
    """Count by fault and by who should name it; without faults, only the rigs as they are."""
    counts: Counter[tuple[str, str]] = Counter()
    for seed, clip in enumerate(clips):
        try:
            recording = worn(clip, seed)
        except EdgeposeError as error:
            click.echo(str(error), err=True)
            continue
        hold = cal.trim(cal.hold_from_recording(recording), HOLD_FROM_S, HOLD_FROM_S + HOLD_S)
        made = cal.calibrate(cal.check_hold(hold), pose="straight", body_frame="heading:0", created="")
        for north in (True, False):
            calibration = replace(made, north=north)
            kind = "a common north" if north else "no north"
            tries = faults(recording, seed) if with_faults else ()
            for fault, names, faulty in [("none", set(), recording), *tries]:
                warnings = warnings_of_run(faulty, calibration)
                named = misplaced_by_check(faulty, calibration)
                text = " ".join(warnings)
                by_run = all(name in text for name in names) if names else bool(warnings)
                counts[f"{fault}, {kind}", "tries"] += 1
                counts[f"{fault}, {kind}", "run"] += by_run and bool(warnings)
                counts[f"{fault}, {kind}", "check"] += names <= named if names else bool(named)
    return counts


@click.command(help=__doc__)
@click.argument("clips", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--good", is_flag=True, help="Only rigs without faults.")
def main(clips: tuple[Path, ...], good: bool) -> None:
    """Run the command line."""
    counts = count(clips, not good)
    click.echo(f"{'fault':60}{'tries':>7}{'run':>7}{'check':>7}")
    for fault in dict.fromkeys(fault for fault, _ in counts):
        numbers = "".join(f"{counts[fault, by]:7d}" for by in ("tries", "run", "check"))
        click.echo(f"{fault:60}{numbers}")


if __name__ == "__main__":
    main()
