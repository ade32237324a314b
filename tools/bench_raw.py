"""Measures the accuracy of poses from raw sensors: a clip on ideal sensors, and on chips without a filter.

Simulated sensors sit at random angles on a body that stands, does the exercises of `edgepose calibrate
--heading-reset motion`, and then moves as in a clip. Each row changes one thing. The first table has the
errors of the poses against those of the clip, the second one the heading and tilt errors of the measured
bones.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import click
import numpy as np

from edgepose import calibration
from edgepose import rotations as rot
from edgepose.analysis.metrics import format_table, summary
from edgepose.formats.recordings.base import iter_samples
from edgepose.imu import Recording, SensorData
from edgepose.inference import archive
from edgepose.placements import BONES, PLACEMENTS
from edgepose.rotations import Array
from edgepose.skeleton import default_body, global_rotations, local_from_global
from edgepose_export.mocap import Motion, read_motion, resample
from edgepose_export.mocap.zeroing import Evidence, find_zero
from edgepose_export.synthesis.heading_routine import with_exercises
from edgepose_export.synthesis.imu_errors import BMI270, ImuErrorModel, raw
from edgepose_export.synthesis.virtual_imus import random_mounting, virtual_imus

CLIP = Path(__file__).parent / "data" / "09_12.bvh"
RATE, STAND_S, HOLD = 100.0, 6.0, (1.0, 5.0)
EXERCISES_S = len(calibration.ROUTINE) * calibration.EXERCISE_S
QUIET = ImuErrorModel(0.0, 0.0, 0.0, 0.0, 0.0)


class Setup(NamedTuple):
    """Source of orientations and headings: a chip, a filter, a magnetometer, a heading reset."""

    chip: ImuErrorModel | None = None
    filter: str = "none"
    magnetometer: bool = False
    reset: str | None = None


SETUPS = {
    "ideal orientations": Setup(),
    "ideal, headings from motion": Setup(reset="motion"),
    "kalman, ideal chip, true headings": Setup(QUIET, "kalman", reset="true"),
    "kalman, BMI270, true headings": Setup(BMI270, "kalman", reset="true"),
    "kalman, BMI270, headings from motion": Setup(BMI270, "kalman", reset="motion"),
    "vqf, BMI270, headings from motion": Setup(BMI270, "vqf", reset="motion"),
    "kalman, BMI270 and magnetometer": Setup(BMI270, "kalman", magnetometer=True),
}


def ideal(motion: Motion, mounting: Array) -> Recording:
    """Return the recording of ideal sensors."""
    imus = virtual_imus(motion, default_body(), mounting)
    time_s = np.arange(len(motion.rotations)) / motion.rate
    sensors = {
        name: SensorData(time_s, imus.orientation[:, i], imus.force[:, i], imus.rate_of_turn[:, i])
        for i, name in enumerate(PLACEMENTS)
    }
    return Recording(sensors, {})


def oriented(recording: Recording, setup: Setup, seed: int) -> Recording:
    """Return the recording as it is after the chip and the filter."""
    from edgepose.formats.recordings.base import recording_from_samples
    from edgepose.orientation import OrientationEstimator

    if setup.chip is None:
        return recording
    chips = {
        name: raw(data, setup.chip, seed + i, setup.magnetometer)
        for i, (name, data) in enumerate(recording.sensors.items())
    }
    orienter = OrientationEstimator(setup.filter, setup.magnetometer)
    return recording_from_samples(orienter.orient(list(iter_samples(Recording(chips, {})))))


def calibrated(recording: Recording, setup: Setup, truth: Recording) -> calibration.Calibration:
    """Calibrate with the parts of standing and of the exercises."""
    everything = calibration.hold_from_recording(recording)
    held = calibration.check_hold(calibration.trim(everything, *HOLD))
    offset = None
    if setup.reset == "motion":
        moving = calibration.trim(everything, STAND_S, STAND_S + EXERCISES_S)
        offset = calibration.headings_from_motion(moving, held.orientation).offset
    elif setup.reset == "true":
        true = calibration.check_hold(calibration.trim(calibration.hold_from_recording(truth), *HOLD))
        offset = rot.yaw_of_quat(rot.quat_multiply(true.orientation, rot.quat_conjugate(held.orientation)))
    elif setup.magnetometer:  # headings count from Y of the inertial frame, where the field points
        offset = np.zeros(len(PLACEMENTS))
    return calibration.calibrate(
        held, pose="straight", body_frame="heading:0", created="", heading_offset=offset
    )


def run(recording: Recording, found: calibration.Calibration, model: str) -> tuple[Array, Array, Array]:
    """Return times (T,), poses (T, 24, 3, 3) and measured bones (T, 6, 3, 3)."""
    from edgepose.inference.engine import StreamEngine
    from edgepose.pipeline.frame_synchronizer import FrameSynchronizer

    info = archive.read_info(archive.find_archive(model))
    engine = StreamEngine(archive.load(info), info.metadata["past"], info.metadata["future"])
    clock = FrameSynchronizer()
    clock.push(iter_samples(recording), 0.0)
    bones, outputs, frames = [], [], clock.flush()
    for frame in frames:
        r_tb, force = calibration.apply_calibration(found, frame.orientation, frame.force)
        bones.append(r_tb)
        outputs += engine.push(frame, r_tb.astype(np.float32), force.astype(np.float32))
    outputs += engine.finish()
    times = np.array([frame.time_s for frame in frames])
    return times, np.array([output.rotations for output in outputs], float), np.array(bones)


@click.command(help=__doc__)
@click.option("--model", default="birnn", show_default=True, help="Shipped model.")
@click.option("--rigs", default=3, show_default=True, help="Number of mountings and chips to average over.")
def main(model: str, rigs: int) -> None:
    """Run the command line."""
    clip = read_motion(CLIP)
    motion = with_exercises(find_zero(Evidence.of(clip)).applied(resample(clip, RATE)), STAND_S)
    clip_s = STAND_S + EXERCISES_S + 3.0  # the clip starts here
    offsets = default_body().offsets
    summaries, bone_lines = {}, []
    for name, setup in SETUPS.items():
        poses, true, bone_errors = [], [], []
        for seed in range(rigs):
            truth = ideal(motion, random_mounting(7 + seed))
            recording = oriented(truth, setup, 100 * seed)
            times, found, bones = run(recording, calibrated(recording, setup, truth), model)
            rows = times >= clip_s
            nearest = np.round(times[rows] * RATE).astype(int).clip(max=len(motion.rotations) - 1)
            poses.append(found[rows])
            true.append(local_from_global(motion.rotations[nearest]))
            bone_errors.append(np.degrees(errors(bones[rows], global_rotations(true[-1]))))
        summaries[name] = summary(np.concatenate(poses), np.concatenate(true), offsets, 60.0)
        mean = np.concatenate(bone_errors).mean(axis=0)
        bone_lines.append(f"{name:38}" + "".join(f"{h:7.1f}/{t:4.1f}" for h, t in mean))
    click.echo(format_table(summaries))
    click.echo(f"\nmeasured bones, mean error of heading / tilt, deg: {', '.join(PLACEMENTS)}")
    click.echo("\n".join(bone_lines))


def errors(bones: Array, true: Array) -> Array:
    """Return heading and tilt errors (T, 6, 2), rad, of measured bones (T, 6, 3, 3) against all true ones."""
    between = rot.matrix_to_quat(bones @ rot.transpose(true[:, list(BONES)]))
    w, x, y, z = np.moveaxis(between, -1, 0)
    heading = 2.0 * np.arctan2(np.abs(y), np.abs(w))  # Y of T is up
    return np.stack([heading, 2.0 * np.arctan2(np.hypot(x, z), np.hypot(w, y))], axis=-1)


if __name__ == "__main__":
    main()
