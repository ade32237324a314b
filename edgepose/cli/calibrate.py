"""`edgepose calibrate`: from a hold of a known pose, live or in a recording, to a calibration file."""

from __future__ import annotations

import math
import sys
import threading
from collections.abc import Callable, Iterator
from datetime import datetime, timezone
from itertools import chain
from pathlib import Path
from typing import Any

import click
import numpy as np

from edgepose import __version__, calibration
from edgepose.calibration import Calibration, HeadingReset, Hold, HoldSummary, MovedError
from edgepose.cli.options import SourceFlags, source_options
from edgepose.errors import EdgeposeError
from edgepose.imu import ImuSample
from edgepose.placements import PLACEMENTS
from edgepose.recording import read_recording
from edgepose.rotations import Array
from edgepose.sources import Batch
from edgepose.sources.files import is_recording
from edgepose.sources.sensor_map import read_map

REPEATS = 3
"""How often a live hold with movement in it is tried again."""

ALL_REPORT_S = 10.0
"""How long all six sensors may take to report on a live source."""

_DO = {
    "straight": "Stand straight: feet parallel, arms hanging, palms to the thighs, looking ahead.",
    "t-pose": "Stand in a T-pose: feet parallel, arms out to the sides, palms down, looking ahead.",
    "lying": "Lay all six sensors side by side, same face up, same edge forward, and let go of them.",
}


def _body_frame(ctx: click.Context, param: click.Parameter, value: str) -> str:
    try:
        return calibration.check_body_frame(value)
    except EdgeposeError as error:
        raise click.BadParameter(str(error)) from None


@click.command(short_help="Find out how the sensors sit on the wearer.")
@source_options
@click.option(
    "--out",
    type=click.Path(dir_okay=False),
    default="calib.json",
    show_default=True,
    help="Calibration to write, JSON; - is stdout.",
)
@click.option(
    "--pose",
    type=click.Choice(list(calibration.POSES)),
    default="straight",
    show_default=True,
    help="Pose that is held: arms hanging, or arms out to the sides.",
)
@click.option(
    "--body-frame",
    callback=_body_frame,
    default="pelvis:-z",
    show_default=True,
    metavar="head|SENSOR:AXIS|heading:DEG",
    help=(
        "Where the wearer faces during the hold. SENSOR:AXIS: where this axis of this sensor points "
        "(pelvis:-z fits a pelvis sensor worn flat on the lower back, Z out of its face). heading:DEG: "
        "degrees from X of the inertial frame towards Y. head: as the head sensor, worn with X to the left, "
        "Y up, Z forward."
    ),
)
@click.option(
    "--heading-reset",
    metavar="FILE|live",
    help=(
        "Bring the headings of sensors without a common north together first: a recording of all six lying "
        "side by side in one orientation, or live from the port.  [default: none, the sensors share a north]"
    ),
)
@click.option(
    "--hold",
    type=click.FloatRange(0.2, 600),
    default=4.0,
    show_default=True,
    help="Length of the hold, seconds.",
)
@click.option(
    "--from",
    "from_s",
    type=float,
    help=(
        "Start of the hold on the clock of --file, seconds.  "
        "[default: the first window that is as still as the stillest]"
    ),
)
@click.option(
    "--countdown",
    type=click.FloatRange(0, 600),
    default=3.0,
    show_default=True,
    help="Time before each live hold, seconds.",
)
def calibrate(
    source: SourceFlags,
    out: str,
    pose: str,
    body_frame: str,
    heading_reset: str | None,
    hold: float,
    from_s: float | None,
    countdown: float,
) -> None:
    """Find out how the six sensors sit on their wearer.

    The wearer holds a pose for a few seconds, live (--port, --can) or in a recording (--file). The
    calibration says which way the wearer faces and how each sensor is turned on its bone; `edgepose run`
    needs it. Repeat it whenever a sensor was taken off or slipped.

    \b
      edgepose calibrate --port /dev/ttyUSB0
      edgepose calibrate --sensors rig.toml --pose t-pose
      edgepose calibrate --file walk.csv --from 2.5 --body-frame heading:0 --out walk.json
    """
    live = source.live
    if live and from_s is not None:
        raise click.UsageError("--from needs a recording that is read at once: --file without --realtime")
    if heading_reset == "live" and not live:
        raise click.UsageError(
            "--heading-reset live needs --port; give a recording of the sensors lying instead"
        )
    _check_writable(out)
    say = _Guide(err=out == "-")
    metadata: dict[str, Any] = {
        "program": f"edgepose {__version__}",
        "source": source.name,
        "hold_s": hold,
    }
    reset: HeadingReset | None = None
    if heading_reset is not None and heading_reset != "live":
        say(f"Heading reset from {heading_reset}.")
        lying, _ = _window(
            heading_reset,
            _read(source._replace(file=Path(heading_reset), port=None, can=None)),
            None,
            hold,
            say,
        )
        reset = calibration.heading_offsets(lying)
    if live:
        with source.open() as opened:
            batches = _all_reporting(iter(opened), say)
            if heading_reset == "live":
                reset = _repeated(batches, "lying", countdown, hold, say, calibration.heading_offsets)
                _wait_for_enter(batches, say)
            summary = _repeated(batches, pose, countdown, hold, say, calibration.check_hold)
    else:
        held, metadata["from_s"] = _window(source.name, _read(source), from_s, hold, say)
        if from_s is None:
            say("If the wearer stood in the pose at another time, say so with --from.")
        summary = calibration.check_hold(held, "choose a still part with --from, or record again")
    for warning in summary.warnings:
        click.echo(f"warning: {warning}", err=True)
    metadata["samples"] = dict(zip(PLACEMENTS, summary.samples, strict=True))
    metadata["force_m_s2"] = _by_sensor(np.linalg.norm(summary.force, axis=-1))
    metadata["warnings"] = summary.warnings
    if reset is not None:
        metadata["heading_reset"] = {"source": heading_reset, "tilt_deg": _by_sensor(reset.tilt_deg)}
    result = calibration.calibrate(
        summary,
        pose=pose,
        body_frame=body_frame,
        created=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        heading_offset=None if reset is None else reset.offset,
        metadata=metadata,
    )
    if source.sensors is not None:
        for warning in read_map(source.sensors).mounting_warnings(calibration.mounting(result)):
            click.echo(f"warning: {warning}", err=True)
    if out == "-":
        click.echo(calibration.to_json(result), nl=False)
    else:
        calibration.save(result, out)
    say(_table(result, summary, reset))
    say(f"Wrote {'stdout' if out == '-' else out}.")


def _by_sensor(values: Array) -> dict[str, float | None]:
    """Numbers (6,) for a person, by placement; None where there is none."""
    return {
        name: None if math.isnan(v) else round(float(v), 3)
        for name, v in zip(PLACEMENTS, values, strict=True)
    }


class _Guide:
    """Says things to the wearer: on stdout, or on stderr where stdout is the result."""

    def __init__(self, err: bool) -> None:
        self.err = err
        self.stream = sys.stderr if err else sys.stdout

    def __call__(self, text: str) -> None:
        click.echo(text, err=self.err)


def _check_writable(out: str) -> None:
    # Before anybody stands still for it.
    if out != "-" and not Path(out).parent.is_dir():
        raise EdgeposeError(f"{out}: no folder {Path(out).parent}; make it first or choose another --out")


# --- recordings ---------------------------------------------------------------------------------------------


def _read(source: SourceFlags) -> tuple[Hold, str | None]:
    """Everything in a recording or a raw capture, and what is wrong with its end."""
    path = source.file
    assert path is not None
    if is_recording(path):
        recording = read_recording(path)
        return calibration.hold_from_recording(recording), recording.damage
    with source._replace(realtime=False).open() as opened:
        return calibration.hold_from_samples(
            chain.from_iterable(samples for _, samples in opened)
        ), opened.damage


def _window(
    name: str, read: tuple[Hold, str | None], from_s: float | None, seconds: float, say: _Guide
) -> tuple[Hold, float]:
    """The part of a recording that is a hold, and its start on the recording's clock, seconds."""
    everything, damage = read
    if damage:
        click.echo(f"warning: {damage}", err=True)
    start = calibration.stillest_start(everything, seconds) if from_s is None else from_s
    first = min((s.time_s[0] for s in everything if len(s.time_s)), default=0.0)
    last = max((s.time_s[-1] for s in everything if len(s.time_s)), default=0.0)
    # The last sample comes a little before the end.
    if from_s is not None and not first - 1e-6 <= start <= last - seconds + 0.1:
        raise EdgeposeError(
            f"{name}: it has no {seconds:g} s from {start:g} s; it lasts from {first:.2f} to {last:.2f} s, "
            "choose --from and --hold within that"
        )
    why = "" if from_s is not None else ", the first as still as the stillest"
    say(f"{name}: hold from {start:.2f} to {start + seconds:.2f} s{why}.")
    return calibration.cut(everything, start, start + seconds), start


# --- live ---------------------------------------------------------------------------------------------------


def _all_reporting(batches: Iterator[Batch], say: _Guide) -> Iterator[Batch]:
    """The rest of the batches once all six sensors have reported; says which are missing."""
    passed, said = 0.0, 0
    start_s: float | None = None
    missing = set(range(len(PLACEMENTS)))
    for now_s, samples in batches:
        start_s = now_s if start_s is None else start_s
        passed = now_s - start_s
        missing -= {sample.sensor for sample in samples}
        if not missing:
            say("All six sensors report.")
            return batches
        if int(passed) > said:
            said = int(passed)
            say(f"Waiting for {_names(missing)}.")
        if passed > ALL_REPORT_S:
            break
    raise EdgeposeError(f"nothing from {_names(missing)} in {passed:.0f} s: check power, link and id of each")


def _names(sensors: set[int]) -> str:
    return ", ".join(PLACEMENTS[i] for i in sorted(sensors))


def _repeated(
    batches: Iterator[Batch],
    pose: str,
    countdown_s: float,
    hold_s: float,
    say: _Guide,
    check: Callable[[Hold], Any],
) -> Any:
    """What `check` makes of a live hold; one with movement in it is repeated."""
    say(_DO[pose])
    for left in range(REPEATS, -1, -1):
        for second in range(math.ceil(countdown_s), 0, -1):
            say(f"The hold starts in {second} s")
            _during(batches, min(1.0, countdown_s - second + 1.0))
        say(f"Hold still for {hold_s:g} s.")
        samples = _with_progress(batches, hold_s, say)
        try:
            return check(calibration.hold_from_samples(samples))
        except MovedError as error:
            if not left:
                raise
            say(f"Not still: {error}. Once more.")
    raise AssertionError("the last repeat returns or raises")


def _during(
    batches: Iterator[Batch], seconds: float, step: Callable[[float], None] | None = None
) -> list[ImuSample]:
    """Samples that come within some seconds of the source's clock; `step` hears how many by now."""
    collected: list[ImuSample] = []
    start_s: float | None = None
    for now_s, samples in batches:
        start_s = now_s if start_s is None else start_s
        collected += samples
        if step is not None:
            step(min(now_s - start_s, seconds))
        if now_s - start_s >= seconds:
            return collected
    raise EdgeposeError(
        "the source ended before the hold was over; use a longer one or a shorter --countdown"
    )


def _with_progress(batches: Iterator[Batch], seconds: float, say: _Guide) -> list[ImuSample]:
    if say.stream.isatty():
        with click.progressbar(length=100, label="Hold still", file=say.stream, show_eta=False) as bar:
            return _during(batches, seconds, lambda passed: bar.update(int(100 * passed / seconds) - bar.pos))
    whole = 0

    def line(passed: float) -> None:
        nonlocal whole
        if int(passed) > whole and passed < seconds:
            whole = int(passed)
            say(f"{whole} of {seconds:g} s")

    return _during(batches, seconds, line)


def _wait_for_enter(batches: Iterator[Batch], say: _Guide) -> None:
    """Time to put the sensors on; elsewhere than on a terminal --countdown has to give it."""
    if not sys.stdin.isatty():
        return
    say("Put the sensors on. Press Enter when the wearer stands ready.")
    # Samples have to be taken off the port meanwhile, so that none of them is old afterwards.
    reader = threading.Thread(target=sys.stdin.readline, daemon=True)
    reader.start()
    for _ in batches:
        if not reader.is_alive():
            return


# --- result -------------------------------------------------------------------------------------------------


def _table(result: Calibration, summary: HoldSummary, reset: HeadingReset | None) -> str:
    lines = ["sensor           samples  residual deg  |force| m/s^2  heading deg  sits"]
    for i, (name, sits) in enumerate(zip(PLACEMENTS, calibration.mounting(result), strict=True)):
        force = float(np.linalg.norm(summary.force[i]))
        heading = "-" if reset is None else f"{math.degrees(reset.offset[i]):.1f}"
        lines.append(
            f"{name:16}{summary.samples[i]:8d}{result.residual_deg[i]:14.2f}"
            f"{'-' if math.isnan(force) else f'{force:.2f}':>15}{heading:>13}  {sits}"
        )
    return "\n".join(lines)
