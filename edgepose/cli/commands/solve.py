"""`edgepose solve`: find the poses of a whole recording at once, without a network."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from edgepose.cli.options.body import BodyFlags, body_options
from edgepose.cli.options.gathered import gathered
from edgepose.cli.options.outputs import bvh_option, check_files, npz_option, overwrite_option
from edgepose.cli.terminal.messages import end_status, has_terminal, say, status
from edgepose.config import split_options
from edgepose.errors import EdgeposeError
from edgepose.utils.output_targets import check_output, is_stream, part_path

if TYPE_CHECKING:
    from edgepose.rotations import Array
    from edgepose.sinks.base import Sink
    from edgepose.sip.energy import Weights
    from edgepose.sip.measurements import Measurements
    from edgepose.sip.solve import Method, OnProgress, Solution
    from edgepose.skeleton import Body

PLAIN_EVERY_S = 10.0
"""Time between two lines of progress where there is no terminal, seconds."""


def _weights(ctx: click.Context, param: click.Parameter, value: str) -> Weights:
    from edgepose.sip.energy import Weights

    weights = Weights()
    for part in value.split(",") if value else ():
        name, _, number = part.strip().partition("=")
        try:
            weight = float(number)
        except ValueError:
            weight = -1.0
        if name not in Weights._fields or not 0.0 <= weight < 1e6:
            raise click.BadParameter(
                f"{part!r} is not NAME=NUMBER with one of {', '.join(Weights._fields)} and a number from 0 on"
            )
        weights = weights._replace(**{name: weight})
    return weights


@dataclass(frozen=True, kw_only=True)
class SolverFlags:
    """How poses are found; the fields are flags of `edgepose solve`."""

    method: Method
    weights: Weights
    prior: Path | None
    hold_from: float | None
    rate: float
    evaluations: int
    jobs: int


@dataclass(frozen=True, kw_only=True)
class SolveOutputs:
    """Files to write; the fields are flags of `edgepose solve`."""

    csv: str | None
    rotations: str
    npz: str | None
    bvh: str | None
    plot: str | None
    overwrite: bool
    joints: int = 24
    names: str = "smpl"

    def __post_init__(self) -> None:
        """Split options from the names of files; raise ConfigError for an unknown one."""
        for name, value in split_options(self.npz, self.bvh).items():
            object.__setattr__(self, name, value)

    def check(self, inputs: Mapping[str, Path | None]) -> None:
        """Make sure that there is an output for the poses, and that no file is lost.

        Args:
            inputs: files to read, by flag.

        Raises:
            click.UsageError: no output for poses is given, or an output is also an input or another output.
            EdgeposeError: an output exists, cannot be written, or has the wrong ending.
        """
        if not (self.csv or self.npz or self.bvh):
            raise click.UsageError("give at least one output: --csv FILE, --npz FILE or --bvh FILE")
        growing = None if self.npz is None or is_stream(self.npz) else part_path(self.npz)
        files = {"--csv": self.csv, "--npz": self.npz, "--bvh": self.bvh, "--plot": self.plot}
        check_files({**files, "--npz (while it grows)": growing}, inputs)
        for name, ending in ((self.csv, ".csv"), (self.npz, ".npz"), (self.bvh, ".bvh")):
            if name is not None:
                check_output(name, "poses", (ending,), self.overwrite)
        if self.plot is not None:
            from edgepose.analysis.figures import check_picture

            check_picture(Path(self.plot), "--plot", self.overwrite)

    def open(self, stack: ExitStack, body: Body, rate: float, stopped: Callable[[], bool]) -> list[Sink]:
        """Open the outputs for poses; the stack closes them."""
        from edgepose.sinks.base import SinkContext, sink_factory

        context = SinkContext(
            body=body,
            rate=rate,
            rotations=self.rotations,
            translation=True,
            overwrite=self.overwrite,
            joints=self.joints,
            names=self.names,
            stopped=stopped,
        )
        targets = {"npz": self.npz, "bvh": self.bvh, "csv": self.csv}
        sinks = [
            stack.enter_context(sink_factory(name)(target, context))
            for name, target in targets.items()
            if target is not None
        ]
        for sink in sinks:
            sink.start()
        return sinks


def _solver_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the solver's flags except --method; the command gets them as `solver: SolverFlags`."""
    flags = [
        click.option(
            "--weights",
            callback=_weights,
            default="",
            metavar="NAME=NUMBER[,...]",
            help="Weights of the energy's terms.  "
            "[default: ori=1, acc=0.05, anthro=1, mahal=0.003, limits=0.1]",
        ),
        click.option(
            "--prior",
            type=click.Path(path_type=Path),
            help="Prior over poses, a file written by `edgepose learn-prior`.  [default: the shipped one]",
        ),
        click.option(
            "--hold-from",
            type=float,
            help="Start of a hold of the calibration's pose on the clock of IN, seconds; required with "
            "sensors other than the six.  [default: as calibrated, if from this file]",
        ),
        click.option(
            "--rate",
            type=click.FloatRange(10, 240),
            default=60.0,
            show_default=True,
            help="Poses per second.",
        ),
        click.option(
            "--evaluations",
            type=click.IntRange(2, 1000),
            default=30,
            show_default=True,
            help="Maximum number of cost evaluations of sip per chunk of 15 s.",
        ),
        click.option(
            "--jobs",
            type=click.IntRange(1),
            default=1,
            show_default=True,
            help="Number of processes, each of which solves one chunk at a time.",
        ),
    ]
    return gathered(command, flags, "solver", SolverFlags)


def _output_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the output flags; the command gets them as `outputs: SolveOutputs`."""
    flags = [
        click.option("--csv", metavar="FILE", help="Write poses as CSV; - is standard output."),
        click.option(
            "--rotations",
            type=click.Choice(["axis-angle", "quat", "matrix", "euler"]),
            default="axis-angle",
            show_default=True,
            help="Representation of rotations in the CSV.",
        ),
        npz_option("Write poses as NPZ with the keys of AMASS."),
        bvh_option("Write poses as BVH."),
        click.option("--plot", metavar="FILE", help="Write a picture of costs and residuals over time."),
        overwrite_option,
    ]
    return gathered(command, flags, "outputs", SolveOutputs)


@click.command()
@click.argument("recording", metavar="IN", type=click.Path(path_type=Path))
@click.option(
    "--calibration",
    "calibration_path",
    required=True,
    type=click.Path(path_type=Path),
    help="Calibration file written by `edgepose calibrate`.",
)
@click.option(
    "--method",
    type=click.Choice(["sip", "sop"]),
    default="sip",
    show_default=True,
    help="sip: all frames at once, by orientation and acceleration. sop: each frame by orientation alone.",
)
@body_options
@_solver_options
@_output_options
def solve(
    recording: Path, calibration_path: Path, body: BodyFlags, solver: SolverFlags, outputs: SolveOutputs
) -> None:
    """Find the poses of a whole recording at once: Sparse Inertial Poser.

    It needs no network and no training. It finds poses that explain the measurements and that people are
    likely to take, from any 3 to 17 sensors named by segment, and the path of the pelvis. Ctrl-C keeps the
    poses found so far.

    \b
    Examples:
      edgepose solve walk.npz --calibration calib.json --csv poses.csv
      edgepose solve walk.npz --calibration calib.json --height 1.68 --npz out.npz
      edgepose solve walk.npz --calibration calib.json --method sop --csv - | head
    """
    outputs.check({"IN": recording, "--calibration": calibration_path})

    from edgepose.sip import residuals
    from edgepose.sip.bodies import sensor_points
    from edgepose.sip.parameterisation import hinge_rig, smpl_rig
    from edgepose.sip.prior import load_prior
    from edgepose.sip.solve import Settings
    from edgepose.sip.solve import solve as solve_all
    from edgepose.sip.translation import pelvis_path

    wearer_body, prior = body.build(), load_prior(solver.prior)
    measurements, damage = _measure(recording, calibration_path, solver)
    skeleton = hinge_rig(prior) if body.hinges else smpl_rig(prior, measurements.bones)
    points = sensor_points(wearer_body, measurements.names)
    settings = Settings(solver.method, skeleton, points, solver.weights, solver.evaluations)
    interrupted = False
    with ExitStack() as stack:
        # Opened before the work, so that a wrong name is reported at once.
        sinks = outputs.open(stack, wearer_body, solver.rate, lambda: interrupted)
        solutions, interrupted = _collect(solve_all(measurements, settings, solver.jobs, _progress()))
        if not solutions:
            raise KeyboardInterrupt
        solution = residuals.concatenate(solutions)
        _write(sinks, solution, measurements, pelvis_path(solution, points.offsets, solver.rate))
        for sink in sinks:
            sink.close()
    _report(solution, measurements, outputs)
    if interrupted:
        raise KeyboardInterrupt
    if damage:
        raise EdgeposeError(damage)


def _measure(path: Path, calibration_path: Path, solver: SolverFlags) -> tuple[Measurements, str | None]:
    """Read a recording, and return its measurements and its damage.

    Raises:
        EdgeposeError: the recording or the calibration cannot be read, or the method needs other sensors.
    """
    from edgepose.calibration import load_calibration
    from edgepose.sip.inputs import mounted, read
    from edgepose.sip.measurements import measure

    calibration = load_calibration(calibration_path)
    data = read(path, calibration)
    if solver.method == "sip" and all(sensor.acc is None for sensor in data.sensors.values()):
        raise EdgeposeError(f"{path}: no sensor has accelerations, which sip needs; use --method sop")
    mounts = mounted(path, data, calibration, solver.hold_from)
    return measure(data, mounts, solver.rate), data.damage


def _report(solution: Solution, measurements: Measurements, outputs: SolveOutputs) -> None:
    """Say how well the poses explain the measurements, and plot it if requested."""
    from edgepose.sip import residuals

    say(residuals.table(solution, measurements))
    for line in residuals.misfits(solution, measurements):
        say(f"warning: {line}")
    if outputs.plot is not None:
        residuals.plot(outputs.plot, solution, measurements, outputs.overwrite)
    done, frames = len(solution.rotations), len(measurements.time_s)
    say(f"{done} of {frames} poses, {solution.evaluations} cost evaluations")


def _collect(solutions: Iterable[Solution]) -> tuple[list[Solution], bool]:
    """Return the solutions, and whether Ctrl-C or SIGTERM ended them early."""
    done: list[Solution] = []
    try:
        for solution in solutions:
            done.append(solution)  # one by one, so that an interrupt keeps them
    except KeyboardInterrupt:
        return done, True
    finally:
        end_status()
    return done, False


def _write(sinks: list[Sink], solution: Solution, measurements: Measurements, path: Array) -> None:
    import numpy as np

    from edgepose.pose import PoseFrame

    rotations, std = solution.rotations.astype(np.float32), np.zeros(24, np.float32)
    for i, (matrices, position) in enumerate(zip(rotations, path, strict=True)):
        held = frozenset(n for n, h in zip(measurements.names, measurements.held[i], strict=True) if h)
        pose = PoseFrame(i, float(measurements.time_s[i]), matrices, std, position, held)
        for sink in sinks:
            sink.write(pose)


def _progress() -> OnProgress:
    """Return a callback that shows chunk, cost and time left: in one line on a terminal, else every 10 s."""
    terminal = has_terminal()
    every_s = 0.2 if terminal else PLAIN_EVERY_S
    started = shown = time.monotonic()
    most = 0  # evaluations in the longest chunk so far

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
