"""Speed, memory and accuracy of `edgepose solve`.

    OMP_NUM_THREADS=1 python tools/bench_solve.py speed --plot speed.png
    OMP_NUM_THREADS=1 python tools/bench_solve.py table --data recordings/ --part cmu-walk-run
    OMP_NUM_THREADS=1 python tools/bench_solve.py table --published DIP_IMU/s_09

`speed` solves synthetic motion of 500 to 8000 frames and measures CPU seconds of one core. `table` is SIP's
table 2 on held-out motion capture (recordings of `edgepose synthesize`), with the shipped networks on the
same sensors. The wearer's body differs from the default, and the sensors have noise and bias. With
--published the table is for real sensors, from DIP-IMU or TotalCapture, and the default body.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.analysis import metrics
from edgepose.calibration import GRAVITY
from edgepose.inference.model import Model
from edgepose.placements import BONES, PLACEMENTS
from edgepose.sip.bodies import scaled, sensor_points, shaped_body
from edgepose.sip.energy import WITH_NETWORK, Weights, second_difference
from edgepose.sip.measurements import Measurements
from edgepose.sip.network_prior import network_prior
from edgepose.sip.parameterisation import PoseParameterisation, hinge_rig, network_rig, smpl_rig
from edgepose.sip.prior import Prior, load_prior
from edgepose.sip.residuals import concatenate
from edgepose.sip.solve import Settings, Solution, solve
from edgepose.skeleton import Body, default_body, forward_kinematics

Array = NDArray[np.float64]

RATE = 60.0
FRAMES = (500, 1000, 2000, 4000, 8000)
EVALUATIONS = 20

HEIGHT_M, SEX, WEIGHT_KG, WORDS = 1.82, "male", 88.0, ("long-legged", "broad-shouldered")
"""The wearer of the table, in the words of a description."""
OWN_SHAPE = 0.03
"""Relative standard deviation of each bone's length, which the description does not tell."""

ACC_NOISE, ACC_BIAS, ACC_SCALE = 0.1, 0.05, 0.01
"""Standard deviations of the accelerometers' noise per frame, bias per axis (both m/s^2), scale per axis."""
TURN_NOISE_DEG, TURN_DRIFT_DEG, TURN_BIAS_DEG = 0.3, 0.5, 1.5
"""Standard deviations of the orientations' noise per frame, of their lasting error in the inertial frame, and
of the calibration's error, deg per axis. The calibration's error does not tilt gravity: it is the bone's."""


Method = Callable[[Measurements], Array]
"""A function that returns local rotations (T, 24, 3, 3) from measurements."""


# --- sensors ------------------------------------------------------------------------------------------------


def sensors_of(local: Array, translation: Array, body: Body, rng: np.random.Generator) -> Measurements:
    """Simulate six imperfect sensors on a body in poses (T, 24, 3, 3) along a path (T, 3), metres."""
    rotations, joints = forward_kinematics(local, body.offsets, translation)
    bones = rotations[:, list(BONES)]
    points = joints[:, list(BONES)] + np.einsum("tsij,sj->tsi", bones, body.sensors)
    gravity = np.array([0.0, -GRAVITY, 0.0])
    force = np.einsum("tsji,tsj->tsi", bones, second_difference(points, RATE) - gravity)
    shape = (1, len(BONES), 3)
    force = force * (1.0 + ACC_SCALE * rng.normal(size=shape)) + ACC_BIAS * rng.normal(size=shape)
    force += ACC_NOISE * rng.normal(size=force.shape)
    measured = _turned(TURN_DRIFT_DEG, shape, rng) @ bones @ _turned(TURN_NOISE_DEG, force.shape, rng)
    acceleration = np.einsum("tsij,tsj->tsi", measured, force) + gravity
    bones = measured @ _turned(TURN_BIAS_DEG, shape, rng)
    frames = len(local)
    valid = np.ones((frames, len(BONES)), bool)
    valid[[0, -1]] = False
    times = np.arange(frames) / RATE
    return Measurements(PLACEMENTS, times, RATE, bones, acceleration, valid, np.zeros_like(valid))


def _turned(deviation_deg: float, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Return random rotations (..., 3, 3) whose vectors have this shape and deviation per axis."""
    return rot.rotvec_to_matrix(np.deg2rad(deviation_deg) * rng.normal(size=shape))


def own_body(rng: np.random.Generator) -> Body:
    """Return the wearer's body: as described, but with every bone a little longer or shorter."""
    body = shaped_body(HEIGHT_M, SEX, WEIGHT_KG, WORDS)
    share = 1.0 + OWN_SHAPE * rng.normal(size=(24, 1))
    for right in (2, 5, 8, 11, 14, 17, 19, 21, 23):
        share[right] = share[right - 1]  # both sides are alike
    return body._replace(offsets=share * body.offsets)


# --- speed --------------------------------------------------------------------------------------------------


def made_up_motion(frames: int) -> tuple[Array, Array]:
    """Return poses (T, 24, 3, 3) and path (T, 3) of a wearer who swings arms and legs."""
    t = np.arange(frames) / RATE
    angles = np.zeros((frames, 24, 3))
    for phase, leg, knee, arm in ((0.0, 1, 4, 17), (np.pi, 2, 5, 16)):
        swing = np.sin(2.0 * np.pi * 0.9 * t + phase)
        angles[:, leg, 0] = -0.4 * swing
        angles[:, knee, 0] = 0.5 + 0.4 * swing
        angles[:, arm, 2] = (1.2 + 0.2 * swing) * (1.0 if arm == 17 else -1.0)
    path = np.stack([0.0 * t, 0.02 * np.sin(4.0 * np.pi * 0.9 * t), 1.2 * t], axis=1)
    return rot.rotvec_to_matrix(angles), path


def speed(plot: Path | None) -> None:
    """Print CPU seconds and memory by number of frames; every chunk uses all its evaluations."""
    import edgepose.sip.levenberg_marquardt as minimise

    minimise.ENOUGH = -1.0  # never stop early
    prior, rows = load_prior(), []
    print(f"frames  seconds  evaluations a frame  memory MB   ({EVALUATIONS} evaluations of SIP after SOP)")
    for frames in FRAMES:
        measurements = sensors_of(*made_up_motion(frames), default_body(), np.random.default_rng(1))
        points = sensor_points(default_body(), PLACEMENTS)
        settings = Settings("sip", smpl_rig(prior, BONES), points, Weights(), EVALUATIONS)
        started = time.process_time()
        done = [len(part.rotations) * part.evaluations for part in solve(measurements, settings)]
        seconds = time.process_time() - started
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        print(f"{frames:6d}{seconds:9.2f}{sum(done) / frames:21.1f}{memory:11.0f}", flush=True)
        rows.append((frames, seconds))
    if plot is not None:
        _draw(plot, np.array(rows))


def _draw(path: Path, rows: Array) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0, 3.6), dpi=130, layout="constrained")
    axes = figure.subplots()
    axes.plot(*rows.T, "o-", color="#2A6F9E", label="measured")
    axes.plot(rows[:, 0], rows[-1, 1] * rows[:, 0] / rows[-1, 0], ":", color="#969696", label="in proportion")
    axes.set_xlabel("frames")
    axes.set_ylabel(f"seconds, {EVALUATIONS} cost evaluations, one core")
    axes.legend(frameon=False)
    figure.savefig(path)


# --- accuracy -----------------------------------------------------------------------------------------------


class Sample(NamedTuple):
    """A take: measurements, the true local rotations (T, 24, 3, 3), and the pelvis' path (T, 3) if known."""

    measurements: Measurements
    pose: Array
    path: Array | None = None


def takes(data: Path, part: str, every: int, body: Body, frames: int | None = None) -> Iterator[Sample]:
    """Yield every `every`-th take of a part, or the middle `frames` frames of it, on the wearer's body."""
    from edgepose_export.training.dataset import take_paths

    for number, path in enumerate(take_paths(data, part)[::every]):
        with np.load(path, allow_pickle=False) as file:
            pose = rot.rotvec_to_matrix(file["poses"].reshape(-1, 24, 3).astype(float))
            # The recordings are of the default body; longer legs take longer steps.
            translation = file["trans"].astype(float) * (body.leg_length_m / default_body().leg_length_m)
        if frames is not None:
            start = max(0, (len(pose) - frames) // 2)
            pose, translation = pose[start : start + frames], translation[start : start + frames]
        yield Sample(sensors_of(pose, translation, body, np.random.default_rng(number)), pose, translation)


def published(folder: Path) -> Iterator[Sample]:
    """Yield the takes of DIP-IMU or TotalCapture below a folder."""
    from edgepose_export.datasets import read_published

    for take in read_published(folder):
        frames = len(take.pose)
        valid = np.ones((frames, len(BONES)), bool)
        valid[[0, -1]] = False
        times = np.arange(frames) / RATE
        orientation, acceleration = take.orientation.astype(float), take.acceleration.astype(float)
        yield Sample(
            Measurements(PLACEMENTS, times, RATE, orientation, acceleration, valid, ~valid),
            take.pose.astype(float),
        )


def solver(method: str, rig: PoseParameterisation, body: Body, weights: Weights) -> Method:
    """Return SIP or SOP as a method."""
    settings = Settings(method, rig, sensor_points(body, PLACEMENTS), weights)
    return lambda measurements: np.concatenate([p.rotations for p in solve(measurements, settings)])


@cache
def _model(name: str) -> Model:
    return Model(name, precision="f32")


def with_network(name: str, body: Body) -> Callable[[Measurements], tuple[Solution, Array | None]]:
    """Return SIP with a network's poses as the prior, as a function that also returns the network's place."""
    rig, points = network_rig(load_prior(), BONES), sensor_points(body, PLACEMENTS)

    def run(measurements: Measurements) -> tuple[Solution, Array | None]:
        expected = network_prior(_model(name), measurements, measurements.time_s)
        settings = Settings("sip", rig, points, WITH_NETWORK, network=expected)
        return concatenate(list(solve(measurements, settings))), expected.place

    return run


def plain_sip(body: Body) -> Callable[[Measurements], Solution]:
    """Return SIP with the statistical prior."""
    settings = Settings("sip", smpl_rig(load_prior(), BONES), sensor_points(body, PLACEMENTS), Weights())
    return lambda measurements: concatenate(list(solve(measurements, settings)))


def network(name: str, mode: str) -> Method:
    """Return a shipped model as a method, run as `edgepose run` runs it."""
    from edgepose.inference import archive
    from edgepose_export.evaluation.evaluate import modes_of, run_archive
    from edgepose_export.training.dataset import Take

    info = archive.read_info(archive.find_archive(name))
    module = archive.load(info)
    chosen = next(m for m in modes_of(info.metadata) if m.name == mode)

    def run(measurements: Measurements) -> Array:
        # In a run a frame holds the mean since the previous frame.
        mean = measurements.acceleration.copy()
        mean[1:] = 0.5 * (mean[1:] + mean[:-1])
        pose = np.zeros((len(mean), 24, 3, 3), np.float32)
        take = Take("", measurements.orientation.astype(np.float32), mean.astype(np.float32), pose, "")
        return run_archive(module, [take], chosen)[0]

    return run


def methods(prior: Prior, body: Body, described: Body, weights: Weights) -> dict[str, Method]:
    """Return the rows of the table, for a wearer's body and the described body."""
    smpl = smpl_rig(prior, BONES)
    guided = {
        (name, label): with_network(name, wearer)
        for name in ("birnn", "rnn")
        for label, wearer in (("SIP", body), ("SIP-BW", described), ("SIP-110", scaled(body, 1.1)))
    }
    return {
        "SOP": solver("sop", smpl, body, weights),
        "SIP-M": solver("sip", hinge_rig(prior), body, weights),
        "SIP": solver("sip", smpl, body, weights),
        "SIP-BW": solver("sip", smpl, described, weights),
        "SIP-110": solver("sip", smpl, scaled(body, 1.1), weights),
        "SIP-120": solver("sip", smpl, scaled(body, 1.2), weights),
        **{
            f"{label}, prior {name}": lambda measurements, run=run: run(measurements)[0].rotations
            for (name, label), run in guided.items()
        },
        "rnn, online": network("rnn", "stream"),
        "birnn, online, 5 future frames": network("birnn", "stream"),
        "birnn, whole take": network("birnn", "offline"),
    }


def table(samples: Iterable[Sample], body: Body, rows: dict[str, Method]) -> None:
    """Print mean and deviation of the errors of every method; positions are those of the body."""
    values: dict[str, dict[str, list[Array]]] = {name: {} for name in rows}
    count = 0
    for sample in samples:
        count += 1
        for name, method in rows.items():
            poses = method(sample.measurements)
            for key, column in metrics.per_frame(poses, sample.pose, body.offsets, RATE).items():
                values[name].setdefault(key, []).append(column)
    if not count:
        raise SystemExit("no takes found; make them with edgepose synthesize")
    print(f"{count} takes")
    print(
        metrics.format_table(
            {
                name: {key: metrics.measure(np.concatenate(column)) for key, column in columns.items()}
                for name, columns in values.items()
            }
        )
    )


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="speed, memory and accuracy of edgepose solve")
    commands = parser.add_subparsers(dest="command", required=True)
    fast = commands.add_parser("speed", help="seconds and memory from 500 to 8000 frames")
    fast.add_argument("--plot", type=Path, help="picture to draw")
    good = commands.add_parser("table", help="SIP's table 2 on held-out motion capture")
    source = good.add_mutually_exclusive_group(required=True)
    source.add_argument("--data", type=Path, help="folder written by edgepose synthesize")
    source.add_argument("--published", type=Path, help="folder of DIP-IMU or TotalCapture")
    good.add_argument("--part", default="cmu-walk-run", help="part of the split")
    good.add_argument("--every", type=int, default=1, metavar="N", help="use every Nth take only")
    good.add_argument("--frames", type=int, metavar="N", help="use the middle N frames of each take only")
    good.add_argument(
        "--rows", type=lambda text: text.split(";"), help="names of rows, separated by semicolons"
    )
    good.add_argument(
        "--prior", type=Path, help="file written by edgepose learn-prior, instead of the shipped prior"
    )
    good.add_argument("--mahal", type=float, default=Weights().mahal, help="weight of the prior")
    flags = parser.parse_args()
    if flags.command == "speed":
        speed(flags.plot)
    else:
        weights, prior = Weights(mahal=flags.mahal), load_prior(flags.prior)
        print(f"prior of {prior.about}; {weights}")
        if flags.published:
            body = default_body()
            table(published(flags.published), body, methods(prior, body, body, weights))
        else:
            body = own_body(np.random.default_rng(0))
            described = shaped_body(HEIGHT_M, SEX, WEIGHT_KG, WORDS)
            samples = takes(flags.data, flags.part, flags.every, body, flags.frames)
            rows = methods(prior, body, described, weights)
            chosen = {name: row for name, row in rows.items() if not flags.rows or name in flags.rows}
            table(samples, body, chosen)


if __name__ == "__main__":
    main()
