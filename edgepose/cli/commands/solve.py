"""`edgepose solve`: the poses of a whole recording at once, without a network."""

from __future__ import annotations

import time
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import click

from edgepose.cli.options.body import BodyFlags, body_options
from edgepose.cli.options.outputs import check_files, overwrite_option
from edgepose.cli.terminal.messages import end_status, has_terminal, say, status
from edgepose.errors import EdgeposeError
from edgepose.utils.output_targets import check_output, is_stream, part_path

if TYPE_CHECKING:
    from edgepose.rotations import Array
    from edgepose.sinks.base import Sink
    from edgepose.sip.energy import Weights
    from edgepose.sip.measurements import Measurements
    from edgepose.sip.solve import Method, OnProgress, Solution

PLAIN_EVERY_S = 10.0


def _weights(ctx: click.Context, param: click.Parameter, value: str) -> Weights:
    from edgepose.sip.energy import Weights

    weights = Weights()
    for part in value.split(",") if value else ():
        name, _, number = part.strip().partition("=")
        try:
            size = float(number)
        except ValueError:
            size = -1.0
        if name not in Weights._fields or not 0.0 <= size < 1e6:
            raise click.BadParameter(
                f"{part!r} is not NAME=NUMBER with one of {', '.join(Weights._fields)} and a number from 0"
            )
        weights = weights._replace(**{name: size})
    return weights


@click.command(short_help="Find the poses of a whole recording at once, without a network.")
@click.argument("recording", metavar="IN", type=click.Path(path_type=Path))
@click.option(
    "--calibration",
    "calibration_path",
    required=True,
    type=click.Path(path_type=Path),
    help="Calibration that `edgepose calibrate` wrote.",
)
@click.option(
    "--method",
    type=click.Choice(["sip", "sop"]),
    default="sip",
    show_default=True,
    help="sip: all frames at once, by orientation and acceleration. sop: each frame by orientation alone.",
)
@body_options
@click.option(
    "--weights",
    callback=_weights,
    default="",
    metavar="NAME=NUMBER[,...]",
    help="Weights of the energy's terms.  [default: ori=1,acc=0.05,anthro=1,mahal=0.003,limits=0.1]",
)
@click.option(
    "--prior",
    "prior_path",
    type=click.Path(path_type=Path),
    help="What poses people take, a file of `edgepose learn-prior`.  [default: the shipped one]",
)
@click.option(
    "--hold-from",
    type=float,
    help="When the wearer holds the calibration's pose in IN, on its clock, seconds; needed for sensors "
    "other than the six.  [default: as calibrated, if from this file]",
)
@click.option(
    "--rate", type=click.FloatRange(10, 240), default=60.0, show_default=True, help="Poses a second."
)
@click.option(
    "--evaluations",
    type=click.IntRange(2, 1000),
    default=30,
    show_default=True,
    help="Cost evaluations of sip at most, for each chunk of 15 s.",
)
@click.option(
    "--jobs",
    type=click.IntRange(1),
    default=1,
    show_default=True,
    help="Chunks solved at a time, each by a process of its own.",
)
@click.option("--csv", metavar="FILE", help="Write poses as CSV; - is standard output.")
@click.option(
    "--rotations",
    type=click.Choice(["axis-angle", "quat", "matrix", "euler"]),
    default="axis-angle",
    show_default=True,
    help="Representation of rotations in the CSV.",
)
@click.option("--npz", metavar="FILE", help="Write poses as NPZ with AMASS's keys.")
@click.option("--bvh", metavar="FILE", help="Write poses as BVH.")
@click.option("--plot", metavar="FILE", help="Draw costs and residuals over time, a picture.")
@overwrite_option
def solve(
    recording: Path,
    calibration_path: Path,
    method: Method,
    body: BodyFlags,
    weights: Weights,
    prior_path: Path | None,
    hold_from: float | None,
    rate: float,
    evaluations: int,
    jobs: int,
    csv: str | None,
    rotations: str,
    npz: str | None,
    bvh: str | None,
    plot: str | None,
    overwrite: bool,
) -> None:
    """Find the poses of a whole recording at once: Sparse Inertial Poser.

    No network and no training: poses that explain what the sensors measured and that people take. Any 3 to 17
    sensors, named by bone. Translation comes along. Ctrl-C keeps the poses that are done.

    \b
    Examples:
      edgepose solve walk.npz --calibration calib.json --csv poses.csv
      edgepose solve walk.npz --calibration calib.json --height 1.68 --words long-legged --npz poses.npz
      edgepose solve walk.npz --calibration calib.json --method sop --jobs 2 --csv - | head
    """
    if not (csv or npz or bvh):
        raise click.UsageError("give at least one output: --csv FILE, --npz FILE or --bvh FILE")
    check_files(
        {
            **{"--csv": csv, "--npz": npz, "--bvh": bvh, "--plot": plot},
            "--npz (while it grows)": None if npz is None or is_stream(npz) else part_path(npz),
        },
        {"IN": recording, "--calibration": calibration_path},
    )
    for name, ending in ((csv, ".csv"), (npz, ".npz"), (bvh, ".bvh")):
        if name is not None:
            check_output(name, "poses", (ending,), overwrite)
    if plot is not None:
        from edgepose.analysis.figures import check_picture

        check_picture(Path(plot), "--plot", overwrite)

    from edgepose.calibration import load_calibration
    from edgepose.sinks.base import SinkContext, sink_factory
    from edgepose.sip import inputs as reading
    from edgepose.sip import residuals as report
    from edgepose.sip.bodies import sensor_points
    from edgepose.sip.measurements import measure
    from edgepose.sip.parameterisation import hinge_rig, smpl_rig
    from edgepose.sip.prior import load_prior
    from edgepose.sip.solve import Settings
    from edgepose.sip.solve import solve as solve_all
    from edgepose.sip.translation import pelvis_path

    wearer, prior = body.build(), load_prior(prior_path)
    calibration = load_calibration(calibration_path)
    data = reading.read(recording, calibration)
    if method == "sip" and all(sensor.acc is None for sensor in data.sensors.values()):
        raise EdgeposeError(f"{recording}: no sensor has accelerations, which sip needs; use --method sop")
    measurements = measure(data, reading.mounted(recording, data, calibration, hold_from), rate)
    rig = hinge_rig(prior) if body.hinges else smpl_rig(prior, measurements.bones)
    points = sensor_points(wearer, measurements.names)
    settings = Settings(method, rig, points, weights, evaluations)
    with ExitStack() as stack:
        # Opened before the work: a wrong name is told at once.
        sinks: list[Sink] = []

        interrupted = False
        context = SinkContext(
            body=wearer, rate=rate, rotations=rotations, translation=True, overwrite=overwrite,
            stopped=lambda: interrupted,
        )  # fmt: skip
        for name, target in {"npz": npz, "bvh": bvh, "csv": csv}.items():
            if target is not None:
                sinks.append(stack.enter_context(sink_factory(name)(target, context)))
        for sink in sinks:
            sink.start()
        solutions, interrupted = _collect(solve_all(measurements, settings, jobs, _progress()))
        if not solutions:
            raise KeyboardInterrupt
        solution = report.concatenate(solutions)
        _write(sinks, solution, measurements, pelvis_path(solution, points.offsets, rate))
        for sink in sinks:
            sink.close()
    say(report.table(solution, measurements))
    for line in report.misfits(solution, measurements):
        say(f"warning: {line}")
    if plot is not None:
        report.plot(plot, solution, measurements, overwrite)
    done, frames = len(solution.rotations), len(measurements.time_s)
    say(f"{done} of {frames} poses, {solution.evaluations} cost evaluations")
    if interrupted:
        raise KeyboardInterrupt
    if data.damage:
        raise EdgeposeError(data.damage)


def _collect(solutions: Iterable[Solution]) -> tuple[list[Solution], bool]:
    """The solutions, and whether Ctrl-C or SIGTERM ended them early."""
    done: list[Solution] = []
    try:
        for solution in solutions:
            done.append(solution)  # one by one: what is done stays
    except KeyboardInterrupt:
        return done, True
    finally:
        end_status()
    return done, False


def _write(sinks: list[Sink], solution: Solution, measurements: Measurements, path: Array) -> None:
    import numpy as np

    from edgepose.pose import PoseFrame

    rotations, std = solution.rotations.astype(np.float32), np.zeros(24, np.float32)
    for i, (matrices, place) in enumerate(zip(rotations, path, strict=True)):
        held = frozenset(n for n, h in zip(measurements.names, measurements.held[i], strict=True) if h)
        pose = PoseFrame(i, float(measurements.time_s[i]), matrices, std, place, held)
        for sink in sinks:
            sink.write(pose)


def _progress() -> OnProgress:
    """A line on a terminal with chunk, cost and time left; elsewhere a line now and then."""
    terminal = has_terminal()
    every_s = 0.2 if terminal else PLAIN_EVERY_S
    started = shown = time.monotonic()
    most = 0  # evaluations of any chunk so far

    def show(chunk: int, count: int, evaluations: int, cost: float) -> None:
        nonlocal shown, most
        now = time.monotonic()
        most = max(most, evaluations)
        if now - shown < every_s:
            return
        shown = now
        share = (chunk - 1 + evaluations / (most + 1)) / count
        left = (now - started) * (1.0 / share - 1.0)
        text = f"chunk {chunk} of {count}, evaluation {evaluations}, cost {cost:.4f}, {left:.0f} s left"
        bar = f"[{'#' * int(20 * share):20}] "
        status(bar + text if terminal else text)

    return show
