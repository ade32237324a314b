"""`edgepose solve`: the poses of a whole recording at once, without a network."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from edgepose.errors import EdgeposeError
from edgepose.skeleton import MAX_HEIGHT, MIN_HEIGHT

if TYPE_CHECKING:
    from edgepose.offline.measurements import Measurements
    from edgepose.offline.solve import OnProgress, Settings, Solution
    from edgepose.offline.terms import Weights
    from edgepose.rotations import Array
    from edgepose.sinks import Sink
    from edgepose.skeleton import Body

PLAIN_EVERY_S = 10.0


def _weights(ctx: click.Context, param: click.Parameter, value: str) -> Weights:
    from edgepose.offline.terms import Weights

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


def _words(ctx: click.Context, param: click.Parameter, value: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in value.split(",") if word.strip())


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
@click.option(
    "--body",
    "body_name",
    default="smpl",
    show_default=True,
    metavar="smpl|hinges|FILE",
    help="smpl: SMPL's joints with the average lengths for --height. hinges: a skeleton as rigged by hand "
    "(SIP-M). FILE: your own SMPL model (.npz or .pkl); a .pkl's code is not run.",
)
@click.option(
    "--height",
    type=click.FloatRange(MIN_HEIGHT, MAX_HEIGHT),
    help="Height of the wearer, metres.  [default: 1.75]",
)
@click.option("--sex", type=click.Choice(["neutral", "male", "female"]), help="[default: neutral]")
@click.option("--weight", type=float, help="Weight of the wearer, kg.  [default: the average for --height]")
@click.option(
    "--words",
    callback=_words,
    default="",
    metavar="WORD[,WORD...]",
    help="Shape of the wearer: long-, short-legged, -armed, -necked; broad-, narrow-shouldered, -hipped; "
    "muscular, slender.",
)
@click.option(
    "--scale",
    type=click.FloatRange(0.5, 2.0),
    default=1.0,
    show_default=True,
    help="All lengths of the body times this (1.1: SIP-110).",
)
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
    help="Cost evaluations of sip at most.",
)
@click.option(
    "--jobs",
    type=click.IntRange(1),
    default=1,
    show_default=True,
    help="Chunks of 15 s solved at a time, each by a process of its own.",
)
@click.option("--csv", "csv_path", metavar="FILE", help="Write poses as CSV; - is standard output.")
@click.option(
    "--rotations",
    type=click.Choice(["axis-angle", "quat", "matrix", "euler"]),
    default="axis-angle",
    show_default=True,
    help="Representation of rotations in the CSV.",
)
@click.option("--npz", "npz_path", metavar="FILE", help="Write poses as NPZ with AMASS's keys.")
@click.option("--bvh", "bvh_path", metavar="FILE", help="Write poses as BVH.")
@click.option("--plot", "plot_path", metavar="FILE", help="Draw costs and residuals over time, a picture.")
def solve(recording: Path, calibration_path: Path, **words: Any) -> None:
    """Find the poses of a whole recording at once: Sparse Inertial Poser.

    No network and no training: poses that explain what the sensors measured and that people take. Any 3 to 17
    sensors, named by bone. Translation comes along. Ctrl-C keeps the poses that are done.

    \b
    Examples:
      edgepose solve walk.npz --calibration calib.json --csv poses.csv
      edgepose solve walk.npz --calibration calib.json --height 1.68 --words long-legged --npz poses.npz
      edgepose solve walk.npz --calibration calib.json --method sop --jobs 2 --csv - | head
    """
    flags = _Flags(**words)
    flags.check(recording, calibration_path)
    from edgepose.calibration import load_calibration
    from edgepose.offline import reading, report
    from edgepose.offline.measurements import measure
    from edgepose.offline.solve import solve as solve_all
    from edgepose.offline.translation import pelvis_path

    body = flags.body()
    calibration = load_calibration(calibration_path)
    data = reading.read(recording, calibration)
    mounted = reading.mounted(recording, data, calibration, flags.hold_from)
    if flags.method == "sip" and all(sensor.acc is None for sensor in data.sensors.values()):
        raise EdgeposeError(f"{recording}: no sensor has accelerations, which sip needs; use --method sop")
    measurements = measure(data, mounted, flags.rate)
    settings = flags.settings(measurements, body)
    solutions: list[Solution] = []
    with ExitStack() as stack:
        sinks = flags.open(stack, body)  # before the work: a wrong name is told at once
        interrupted = _collect(
            solutions, solve_all(measurements, settings, flags.jobs, _progress(len(measurements.time_s)))
        )
        if sys.stderr.isatty():
            click.echo(err=True)
        if not solutions:
            raise KeyboardInterrupt
        solution = report.joined(solutions)
        _write(sinks, solution, measurements, pelvis_path(solution, settings.body.offsets, flags.rate))
        for sink in sinks:
            sink.close()
    click.echo(report.table(solution, measurements), err=True)
    for line in report.misfits(solution, measurements):
        click.echo(f"warning: {line}", err=True)
    if flags.plot_path is not None:
        report.plot(flags.plot_path, solution, measurements)
    done, frames = len(solution.rotations), len(measurements.time_s)
    click.echo(f"{done} of {frames} poses, {solution.evaluations} cost evaluations", err=True)
    if interrupted:
        raise KeyboardInterrupt
    if data.damage:
        raise EdgeposeError(data.damage)


@dataclass(frozen=True)
class _Flags:
    """The command's flags."""

    method: Any
    body_name: str
    height: float | None
    sex: str | None
    weight: float | None
    words: tuple[str, ...]
    scale: float
    weights: Weights
    prior_path: Path | None
    hold_from: float | None
    rate: float
    evaluations: int
    jobs: int
    csv_path: str | None
    rotations: str
    npz_path: str | None
    bvh_path: str | None
    plot_path: str | None

    def check(self, recording: Path, calibration: Path) -> None:
        """Raises click.UsageError unless the flags go together."""
        outputs = {"--csv": self.csv_path, "--npz": self.npz_path, "--bvh": self.bvh_path}
        if not any(outputs.values()):
            raise click.UsageError("give at least one output: --csv FILE, --npz FILE or --bvh FILE")
        for flag, name in {**outputs, "--plot": self.plot_path}.items():
            for given in (recording, calibration):
                if (
                    name not in (None, "-")
                    and given.exists()
                    and Path(str(name)).resolve() == given.resolve()
                ):
                    raise click.UsageError(f"{flag} would overwrite {given}; name another file")
        if self._is_file and (self.height or self.sex or self.weight or self.words):
            raise click.UsageError(
                "a body from a file has its own shape: leave out --height, --sex, --weight and --words"
            )

    @property
    def _is_file(self) -> bool:
        return self.body_name not in ("smpl", "hinges")

    def body(self) -> Body:
        """The wearer's body."""
        from edgepose.offline.bodies import scaled, shaped_body

        if self._is_file:
            from edgepose.smpl_file import read_smpl

            return scaled(read_smpl(self.body_name), self.scale)
        return scaled(
            shaped_body(self.height or 1.75, self.sex or "neutral", self.weight, self.words), self.scale
        )

    def settings(self, measurements: Measurements, body: Body) -> Settings:
        """How to solve."""
        from edgepose.offline.bodies import sensor_points
        from edgepose.offline.prior import load_prior
        from edgepose.offline.rigs import hinge_rig, smpl_rig
        from edgepose.offline.solve import Settings

        prior = load_prior(self.prior_path)
        rig = hinge_rig(prior) if self.body_name == "hinges" else smpl_rig(prior, measurements.bones)
        points = sensor_points(body, measurements.names)
        return Settings(self.method, rig, points, self.weights, self.evaluations)

    def open(self, stack: ExitStack, body: Body) -> list[Sink]:
        """The outputs, which the stack closes."""
        from edgepose.sinks.bvh import BvhSink
        from edgepose.sinks.csv_file import CsvSink
        from edgepose.sinks.npz import NpzSink

        sinks: list[Sink] = []
        if self.csv_path is not None:
            sinks.append(stack.enter_context(CsvSink(self.csv_path, self.rotations, translation=True)))
        if self.npz_path is not None:
            sinks.append(stack.enter_context(NpzSink(self.npz_path, self.rate, translation=True)))
        if self.bvh_path is not None:
            sinks.append(stack.enter_context(BvhSink(self.bvh_path, self.rate, body)))
        return sinks


def _collect(done: list[Solution], solutions: Iterable[Solution]) -> bool:
    """Fill the list with solutions; whether Ctrl-C or SIGTERM ended that early."""
    try:
        done.extend(solutions)
    except KeyboardInterrupt:
        return True
    return False


def _write(sinks: list[Sink], solution: Solution, measurements: Measurements, path: Array) -> None:
    import numpy as np

    from edgepose.pose import PoseFrame

    rotations, std = solution.rotations.astype(np.float32), np.zeros(24, np.float32)
    for i, (matrices, place) in enumerate(zip(rotations, path, strict=True)):
        held = [n for n, h in zip(measurements.names, measurements.held[i], strict=True) if h]
        status = " ".join(["held", *held]) if held else "ok"
        pose = PoseFrame(i, float(measurements.time_s[i]), status, matrices, std, place)
        for sink in sinks:
            sink.write(pose)


def _progress(frames: int) -> OnProgress:
    """A line on a terminal with chunk, cost and time left; elsewhere a line now and then."""
    terminal = sys.stderr.isatty()
    every_s = 0.2 if terminal else PLAIN_EVERY_S
    started = shown = time.monotonic()
    usual = 0.0  # evaluations of the chunks that are done

    def show(chunk: int, count: int, evaluations: int, cost: float) -> None:
        nonlocal shown, usual
        now = time.monotonic()
        usual = max(usual, evaluations)
        if now - shown < every_s:
            return
        shown = now
        share = (chunk - 1 + evaluations / (usual + 1.0)) / count
        left = (now - started) * (1.0 / share - 1.0)
        text = f"chunk {chunk} of {count}, evaluation {evaluations}, cost {cost:.4f}, {left:.0f} s left"
        bar = f"[{'#' * int(30 * share):30}] "
        click.echo(f"\r{bar}{text}  " if terminal else f"{text}, {frames} frames", nl=not terminal, err=True)

    return show
