"""`edgepose run`: the main job."""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import click

from edgepose.cli.options import Orientations, SourceFlags, filter_options, source_options
from edgepose.cli.outputs import OutputFlags, check_files, output_options
from edgepose.cli.stop import Stop
from edgepose.cli.wishes import Wishes
from edgepose.errors import EdgeposeError
from edgepose.placements import PLACEMENTS
from edgepose.precision import CHOICES, pack

if TYPE_CHECKING:
    from edgepose.calibration import Calibration
    from edgepose.pipeline import RunSummary
    from edgepose.sources import Source
    from edgepose.sync import FrameClock


def _address(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[str, int] | None:
    from edgepose.sinks.udp import parse_destination

    try:
        if value is None:
            return None
        if "," in value:
            raise EdgeposeError(f"{value!r} is more than HOST:PORT")
        return parse_destination(value)[:2]
    except EdgeposeError as error:
        raise click.BadParameter(str(error)) from None


@click.command(short_help="Turn sensor data into poses.")
@source_options
@filter_options
@click.option(
    "--calibration",
    "calibration_path",
    required=True,
    type=click.Path(path_type=Path),
    help="Calibration that `edgepose calibrate` wrote.",
)
@click.option(
    "--model",
    default="birnn",
    show_default=True,
    help="Shipped model (see `edgepose models`) or an archive's path.",
)
@click.option(
    "--trust", is_flag=True, help="Load --model although its sum is not known: you vouch for the code in it."
)
@click.option(
    "--online",
    type=click.Choice(["stream", "window"]),
    default="stream",
    show_default=True,
    help="How a bidirectional model runs: with its forward state carried on, or anew over a window for each "
    "frame, as in the paper (dearer). A unidirectional one always carries its state.",
)
@click.option(
    "--past",
    type=click.IntRange(0, 600),
    help="Frames before the present one that a window holds  [default: the model's]",
)
@click.option(
    "--future",
    type=click.IntRange(0, 120),
    help="Frames after the present one that a bidirectional model waits for; each adds 1/60 s of latency  "
    "[default: the model's]",
)
@click.option(
    "--precision",
    type=click.Choice(CHOICES),
    default="auto",
    show_default=True,
    help="Numbers that the model's weights are kept in: fewer bytes run faster. auto is fp16 where this "
    "machine has products for it, else f32; int8 is the fastest, about 0.2 deg from f32.",
)
@output_options
@click.option(
    "--control",
    callback=_address,
    metavar="HOST:PORT",
    help="Listen here for datagrams `rezero` and OSC messages /edgepose/rezero; live only.",
)
def run(
    source: SourceFlags,
    filter: str,
    no_mag: bool,
    calibration_path: Path,
    model: str,
    trust: bool,
    online: str,
    past: int | None,
    future: int | None,
    precision: str,
    outputs: OutputFlags,
    control: tuple[str, int] | None,
) -> None:
    """Turn packets or a recording into poses until the source ends or Ctrl-C.

    On a live source, r or Enter on the terminal (or a message to --control) re-zeroes the headings: stand in
    the calibration pose once more.

    \b
    Examples:
      edgepose run --port /dev/ttyUSB0 --calibration calib.json --csv poses.csv --udp 127.0.0.1:9000
      edgepose run --port COM3 --calibration calib.json --model rnn --udp 10.0.0.5:9000,format=binary
      edgepose run --can socketcan:can0 --protocol hipnuc-canopen --calibration calib.json --csv poses.csv
      edgepose run --sensors rig.toml --calibration calib.json --udp 127.0.0.1:9000
      edgepose run --port /dev/ttyUSB0 --filter kalman --calibration calib.json --csv poses.csv
      edgepose run --file walk.csv --calibration calib.json --csv - | head
    """
    if not outputs.any:
        raise click.UsageError("give at least one output, such as --csv FILE, --udp HOST:PORT or --view")
    check_files(outputs.files, {"--file": source.file, "--calibration": calibration_path})
    if control is not None and not source.live:
        raise click.UsageError("--control needs sensors that send, or --realtime")

    from edgepose import archive
    from edgepose.calibration import load_calibration

    calibration = load_calibration(calibration_path)
    _check_filter(calibration, filter, no_mag, source)
    info = archive.inspect(archive.find(model))
    kind, rate = info.metadata["kind"], float(info.metadata["rate_hz"])
    past = info.metadata["past"] if past is None else past
    future = info.metadata["future"] if future is None else future
    if kind == "rnn" and future:
        raise click.UsageError(f"{model} is unidirectional: --future must be 0")
    with ExitStack() as stack:
        # The source is opened before the model is loaded: a wrong port is told at once.
        opened = stack.enter_context(source.open())
        wishes = Wishes(stack, control, keys=source.live)
        module = archive.load(info, trust)
        precision = pack(module, info, precision, _say)
        from edgepose.engine import Engine, StreamEngine, WindowEngine
        from edgepose.pipeline import run as run_pipeline
        from edgepose.rezero import Headings
        from edgepose.sync import FrameClock

        engine: Engine
        if kind != "rnn" and online == "window":
            engine = WindowEngine(module, past, future)
        else:
            # Of a recording nobody waits for single poses. int8 goes one by one all the same: what its
            # weights are multiplied with is scaled with all that is computed at once.
            recorded = not source.live and source.file is not None and source.file.is_file()
            many = recorded and precision != "int8" and hasattr(module, "stream_many")
            engine = StreamEngine(module, past, future, TOGETHER if many else 1)
        stop = stack.enter_context(Stop())
        sinks = outputs.open(stack, rate)
        clock = FrameClock(rate)
        way = "stream" if isinstance(engine, StreamEngine) else "window"
        _say(f"running {model} ({kind}, {way}) in {precision}; Ctrl-C ends the run{wishes.hint}")
        orient = Orientations(filter, magnetometer=calibration.north)
        headings = Headings(
            calibration,
            hold_first=source.live and _begins_anew(calibration),
            requests=wishes.poll,
            tell=_say,
        )
        # What is alive now stays: going through all of it once in a while would hold up a frame by 0.1 s.
        gc.collect()
        gc.freeze()
        summary = run_pipeline(
            *(opened, clock, headings, engine, sinks),
            orient=orient,
            tell=_say if source.live else lambda text: None,
            on_pose=_progress(),
            stopped=lambda: stop.asked,
            behind_s=lambda: opened.behind_s,
        )
        for sink in sinks:
            try:
                sink.close()
            except EdgeposeError as error:
                summary.error = summary.error or error
    _report(summary, opened, clock, rate, future, live=source.live)
    for line in (*orient.remarks(), *outputs.remarks(sinks), *wishes.remarks()):
        _say(line)
    if summary.error:
        raise summary.error
    if opened.damage:
        raise EdgeposeError(opened.damage)


def _begins_anew(calibration: Calibration) -> bool:
    """Whether a filter without a north has begun anew since the calibration."""
    return calibration.filter != "none" and not calibration.north


def _check_filter(calibration: Calibration, filter: str, no_mag: bool, source: SourceFlags) -> None:
    """Raises EdgeposeError unless orientations are made as they were for the calibration.

    Not a warning: another filter has other headings, and all poses would be wrong without looking so.
    """
    if filter != calibration.filter:
        raise EdgeposeError(
            f"the calibration was made with --filter {calibration.filter}, and this run has --filter "
            f"{filter}: headings would differ; use the same one, or calibrate again"
        )
    if no_mag and filter != "none" and calibration.north:
        raise EdgeposeError(
            "the calibration was made with magnetometers: leave --no-mag out, or calibrate again with it"
        )
    made_from = calibration.metadata.get("source")
    if not source.live and _begins_anew(calibration) and made_from != source.name:
        _say(
            f"warning: the calibration was made from {made_from}, and headings of a filter without "
            "magnetometers begin anew in each recording: calibrate from this one"
        )


TOGETHER = 64
"""Frames of a recording that are computed at once."""

BEHIND_S = 1.0
"""A run that is further behind its sensors says so, seconds."""


def _say(text: str) -> None:
    click.echo(text, err=True)


def _progress() -> Callable[[RunSummary], None]:
    """A callback that keeps one line on a terminal up to date; elsewhere it writes a line now and then."""
    terminal = sys.stderr.isatty()
    every_s = 1.0 if terminal else 10.0
    shown_s, poses, told = time.monotonic(), 0, False

    def show(summary: RunSummary) -> None:
        nonlocal shown_s, poses, told
        now_s = time.monotonic()
        if summary.behind_s > BEHIND_S and not told:
            told = True
            _say(
                f"{'' if not terminal else chr(13)}this machine does not keep up: poses are "
                f"{summary.behind_s:.1f} s late; use --model rnn, --online stream, or end other programs"
            )
        if now_s - shown_s >= every_s:
            rate = (summary.poses - poses) / (now_s - shown_s)
            shown_s, poses = now_s, summary.poses
            text = f"{poses} poses, {rate:.0f} a second, {summary.held} with a held sensor"
            click.echo(f"\r{text}  " if terminal else text, nl=not terminal, err=True)

    return show


def _report(
    summary: RunSummary, source: Source, clock: FrameClock, rate: float, future: int, live: bool
) -> None:
    """Prints the counts of a finished run."""
    import numpy as np

    if sys.stderr.isatty():
        _say("")
    speed = summary.poses / summary.seconds if summary.seconds else 0.0
    _say(
        f"poses    {summary.poses} in {summary.seconds:.1f} s, {speed:.1f} a second; "
        f"{summary.filling} while the window was filling"
    )
    counts = source.counters
    _say(
        f"packets  {counts.packets} good, {counts.lost} lost, {counts.bad} bad; "
        f"{clock.dropped} samples too late or twice"
    )
    if clock.restarts:
        _say(
            f"clock    began anew {clock.restarts} times, after all sensors were silent for a minute or more"
        )
    if summary.held:
        worst = sorted(zip(summary.held_by_sensor, PLACEMENTS, strict=True), reverse=True)
        _say("held     " + ", ".join(f"{name} in {count} frames" for count, name in worst if count))
    if summary.latencies_s and live:
        p50, p99, most = np.percentile(np.array(summary.latencies_s) * 1e3, [50, 99, 100])
        ahead = f" plus {future} frames of look-ahead, {future / rate * 1e3:.0f} ms" if future else ""
        _say(
            f"latency  {p50:.1f} ms median, {p99:.1f} ms p99, {most:.1f} ms max "
            f"from last packet to pose sent{ahead}"
        )
