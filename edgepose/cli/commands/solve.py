"""`edgepose solve`: find the poses of a whole recording at once."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from edgepose.cli.options.body import BodyFlags, body_options
from edgepose.cli.options.json_result import check_standard_output, json_option, show_json
from edgepose.cli.options.outputs import check_files, file_output_options
from edgepose.cli.options.solver import STATISTICS, SolverFlags, solver_options
from edgepose.cli.terminal.messages import end_status, has_terminal, say, status
from edgepose.config import OutputConfig
from edgepose.errors import EdgeposeError
from edgepose.sinks.registry import SINKS, described

if TYPE_CHECKING:
    from edgepose.calibration import Calibration
    from edgepose.imu import Recording
    from edgepose.sinks.group import SinkGroup
    from edgepose.sip.measurements import Measurements, SensorMount
    from edgepose.sip.network_prior import NetworkPrior
    from edgepose.sip.solve import OnProgress, Settings, Solution
    from edgepose.sip.translation import PelvisPath
    from edgepose.skeleton import Body

MODEL = "birnn"
"""Network whose poses are the prior unless --prior names another."""

PLAIN_EVERY_S = 10.0
"""Time between two lines of progress where there is no terminal, seconds."""


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
@solver_options
@file_output_options(
    click.option(
        "--plot",
        type=click.Path(path_type=Path),
        metavar="FILE",
        help="Write a picture of costs and residuals over time.",
    )
)
@json_option
def solve(
    recording: Path,
    calibration_path: Path,
    body: BodyFlags,
    solver: SolverFlags,
    outputs: OutputConfig,
    plot: Path | None,
    as_json: bool,
) -> None:
    """Find the poses of a whole recording at once: Sparse Inertial Poser.

    It finds the poses nearest to a network's that explain the measured orientations and accelerations, and
    the path of the pelvis. Without one of the six sensors, or with --prior default, it needs no network: then
    it finds poses that people are likely to take, from any 3 to 17 sensors named by segment. Ctrl-C keeps
    the poses found so far.

    \b
    Examples:
      edgepose solve walk.npz --calibration calib.json --csv poses.csv
      edgepose solve walk.npz --calibration calib.json --height 1.68 --npz out.npz
      edgepose solve walk.npz --calibration calib.json --method sop --csv - | head
    """
    _check_outputs(outputs, plot, {"IN": recording, "--calibration": calibration_path}, as_json)

    from edgepose.calibration import load_calibration
    from edgepose.sinks.group import SinkGroup
    from edgepose.sinks.open import open_outputs
    from edgepose.sip import residuals
    from edgepose.sip.measurements import measure
    from edgepose.sip.solve import solve as solve_all
    from edgepose.sip.translation import pelvis_path

    calibration = load_calibration(calibration_path)
    wearer_body = body.build(calibration.height_m)
    data, mounts = _read(recording, calibration, solver)
    measurements = measure(data, mounts, solver.rate)
    network = _network(solver, body.hinges, data, mounts, measurements)
    settings = _settings(solver, body.hinges, wearer_body, measurements, network)
    place = None if network is None else network.place
    interrupted = False
    with ExitStack() as stack:
        # Opened before the work, so that a wrong name is reported at once.
        target = (stack, outputs, solver.rate, lambda: interrupted)
        opened = open_outputs(*target, body=wearer_body, translation=True, contacts=place is not None)
        sinks = SinkGroup(opened, say)
        solutions, interrupted = _collect(solve_all(measurements, settings, solver.jobs, _progress()))
        if not solutions:
            raise KeyboardInterrupt
        solution = residuals.concatenate(solutions)
        place = None if place is None else place[: len(solution.rotations)]
        path = pelvis_path(solution, settings.body.offsets, solver.rate, place)
        _write(sinks, solution, measurements, path)
    about = {"source": recording, "calibration": calibration_path, "method": solver.method}
    problem = sinks.error or (EdgeposeError(data.damage) if data.damage else None)
    _show(solution, measurements, outputs, plot, {**about, "problem": problem} if as_json else None)
    if interrupted and sinks.error is None:
        raise KeyboardInterrupt
    if problem is not None:
        raise problem


def _check_outputs(
    outputs: OutputConfig, plot: Path | None, inputs: Mapping[str, Path | None], as_json: bool
) -> None:
    """Make sure that there is an output for the poses, and that no file is lost.

    Args:
        outputs: files for the poses.
        plot: file for the picture.
        inputs: files to read, by flag.
        as_json: the result goes to standard output.

    Raises:
        click.UsageError: no output for poses is given, or an output is also an input or another output.
        EdgeposeError: an output exists, cannot be written, or has the wrong ending.
    """
    if not outputs.any:
        flags = [f"--{name} FILE" for name, output in SINKS.items() if output.suffix]
        raise click.UsageError(f"give at least one output: {', '.join(flags[:-1])} or {flags[-1]}")
    check_files([*outputs.files, ("--plot", plot)], inputs)
    outputs.check()
    if as_json:
        check_standard_output(outputs)
    if plot is not None:
        from edgepose.analysis.figures import check_picture

        check_picture(plot, "--plot", outputs.overwrite)


def _read(
    path: Path, calibration: Calibration, solver: SolverFlags
) -> tuple[Recording, dict[str, SensorMount]]:
    """Read a recording and the mounting of its sensors.

    Raises:
        EdgeposeError: the recording cannot be read, or the method needs other sensors.
    """
    from edgepose.sip.inputs import mounted, read

    data = read(path, calibration)
    if solver.method == "sip" and all(sensor.acc is None for sensor in data.sensors.values()):
        raise EdgeposeError(f"{path}: no sensor has accelerations, which sip needs; use --method sop")
    first_s = min(float(sensor.time_s[0]) for sensor in data.sensors.values())
    hold_from_s = None if solver.hold_from is None else solver.hold_from.on_clock(first_s)
    return data, mounted(path, data, calibration, hold_from_s)


def _network(
    solver: SolverFlags,
    hinges: bool,
    data: Recording,
    mounts: dict[str, SensorMount],
    measurements: Measurements,
) -> NetworkPrior | None:
    """Return a network's poses for the prior; None where a statistical prior is wanted or has to do.

    Raises:
        EdgeposeError: --prior names a network that cannot be used with these sensors, or does not exist.
    """
    from edgepose.sip.measurements import measure
    from edgepose.sip.network_prior import missing_for_network, network_prior

    name, statistics_only = solver.prior, hinges or solver.method == "sop"
    if solver.statistics or (name is None and statistics_only):
        return None
    if statistics_only:
        flag = "--method sop" if solver.method == "sop" else "--body hinges"
        raise EdgeposeError(f"{flag} takes no network as its prior: leave out --prior {name}")
    missing = missing_for_network(measurements)
    if missing and name is not None:
        raise EdgeposeError(
            f"--prior {name} needs the accelerations of {', '.join(missing)}; use --prior default"
        )
    if missing:
        say(f"no accelerations of {', '.join(missing)}: the prior is the statistical one, not a network")
        return None

    from edgepose.inference.model import load_model

    model = load_model(name or MODEL, precision="f32")
    if has_terminal():
        status(f"running {name or MODEL} over the recording")
    same = model.rate_hz == solver.rate
    frames = measurements if same else measure(data, mounts, model.rate_hz)
    return network_prior(model, frames, measurements.time_s)


def _settings(
    solver: SolverFlags, hinges: bool, body: Body, measurements: Measurements, network: NetworkPrior | None
) -> Settings:
    """Return the settings of the solver.

    Raises:
        EdgeposeError: --prior is not a prior of poses.
    """
    from edgepose.sip.bodies import sensor_points
    from edgepose.sip.energy import WITH_NETWORK, Weights
    from edgepose.sip.parameterisation import hinge_rig, network_rig, smpl_rig
    from edgepose.sip.prior import load_prior
    from edgepose.sip.solve import Settings

    from_file = solver.statistics and solver.prior != STATISTICS
    prior = load_prior(solver.prior if from_file else None)
    if hinges:
        rig = hinge_rig(prior)
    else:
        rig = (smpl_rig if network is None else network_rig)(prior, measurements.bones)
    weights = (Weights() if network is None else WITH_NETWORK)._replace(**solver.weights)
    points = sensor_points(body, measurements.names)
    return Settings(solver.method, rig, points, weights, solver.evaluations, network)


def _show(
    solution: Solution,
    measurements: Measurements,
    outputs: OutputConfig,
    plot: Path | None,
    about: Mapping[str, Any] | None,
) -> None:
    """Report how well the poses explain the measurements, with a picture and, given its head, as JSON."""
    from edgepose.sip import residuals

    say(residuals.table(solution, measurements))
    for line in residuals.misfits(solution, measurements):
        say(f"warning: {line}")
    count = f"{len(solution.rotations)} of {len(measurements.time_s)}"
    say(f"{count} poses, {solution.evaluations} cost evaluations")
    if plot is not None:
        residuals.plot(plot, solution, measurements, outputs.overwrite)
    if about is not None:
        about = {**about, **residuals.values(solution, measurements)}
        show_json("solve", {**about, "outputs": described(outputs.targets)})


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


def _write(sinks: SinkGroup, solution: Solution, measurements: Measurements, path: PelvisPath) -> None:
    import numpy as np

    from edgepose.pose import PoseFrame

    rotations, std = solution.rotations.astype(np.float32), np.zeros(24, np.float32)
    for i, (matrices, position) in enumerate(zip(rotations, path.translation, strict=True)):
        held = frozenset(n for n, h in zip(measurements.names, measurements.held[i], strict=True) if h)
        pose = PoseFrame(i, float(measurements.time_s[i]), matrices, std, position, held)
        if path.contacts is not None:
            pose = pose._replace(contacts=path.contacts[i])
        sinks.write(pose)
    sinks.close()


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
