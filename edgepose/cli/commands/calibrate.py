"""`edgepose calibrate`: from a hold of a known pose, live or in a recording, to a calibration file."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import click
import numpy as np

from edgepose import __version__, calibration
from edgepose.calibration import Calibration, HeadingReset, HoldSummary
from edgepose.cli.calibration_session import ROUTINE_S, CalibrationPlan, finds_forward, live, recorded
from edgepose.cli.options.outputs import check_files, overwrite_option
from edgepose.cli.options.source import filter_options, source_options
from edgepose.cli.prompts import Prompter
from edgepose.cli.terminal import messages as terminal
from edgepose.config import SourceConfig
from edgepose.errors import EdgeposeError
from edgepose.orientation.stage import OrientationStage
from edgepose.placements import PLACEMENTS
from edgepose.rotations import Array
from edgepose.sources.sensor_map import read_map
from edgepose.utils.output_targets import check_output


def _body_frame(ctx: click.Context, param: click.Parameter, value: str | None) -> str | None:
    try:
        return None if value is None else calibration.check_body_frame(value)
    except EdgeposeError as error:
        raise click.BadParameter(str(error)) from None


def _heading_reset(ctx: click.Context, param: click.Parameter, value: str | None) -> str | None:
    if value is not None and re.fullmatch(r"mounting:(?![+-]?[xyz]$).*", value):
        raise click.BadParameter(f"{value}: an axis is x, y or z, or with - the other way, such as -z")
    return value


def _span(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[float, float] | None:
    if value is None:
        return None
    try:
        start, end = map(float, value.split(":"))
    except ValueError:
        start = end = math.nan
    if not -math.inf < start < end < math.inf:
        raise click.BadParameter(f"{value!r} is not FROM:TO, two times in seconds such as 12.5:40")
    return start, end


@click.command(short_help="Find out how the sensors sit on the wearer.")
@source_options
@filter_options
@click.option(
    "--out",
    type=click.Path(dir_okay=False),
    default="calib.json",
    show_default=True,
    help="Calibration to write, JSON; - is stdout.",
)
@overwrite_option
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
    metavar="head|SENSOR:AXIS|heading:DEG",
    help=(
        "Where the wearer faces during the hold. SENSOR:AXIS: where this axis of this sensor points "
        "(pelvis:-z fits a pelvis sensor worn flat on the lower back, Z out of its face). heading:DEG: "
        "degrees from X of the inertial frame towards Y. head: as the head sensor, worn with X to the left, "
        "Y up, Z forward.  [default: pelvis:-z, or what the heading reset has found]"
    ),
)
@click.option(
    "--heading-reset",
    callback=_heading_reset,
    metavar="FILE|live|motion|mounting[:AXIS]",
    help=(
        "Bring the headings of sensors without a common north together. FILE: a recording of all six lying "
        "side by side in one orientation; live: the same, from the sensors themselves. motion: from "
        "movements after the hold. mounting: from what the map of sensors says of each; mounting:AXIS: this "
        "axis of every sensor faces forward in the pose.  [default: none, the sensors share a north]"
    ),
)
@click.option(
    "--motion",
    callback=_span,
    metavar="FROM:TO",
    help=(
        "Where the movements for --heading-reset motion are on the clock of --file, seconds.  "
        f"[default: from the end of the hold on, {ROUTINE_S:g} s at most]"
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
    source: SourceConfig,
    filter: str,
    no_mag: bool,
    out: str,
    overwrite: bool,
    pose: str,
    body_frame: str | None,
    heading_reset: str | None,
    motion: tuple[float, float] | None,
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
      edgepose calibrate --port /dev/ttyUSB0 --filter kalman --heading-reset motion
      edgepose calibrate --sensors rig.toml --pose t-pose
      edgepose calibrate --file walk.csv --from 2.5 --body-frame heading:0 --out walk.json
    """
    _check_use(source, heading_reset, motion, pose, from_s)
    lying = None if heading_reset is None or not Path(heading_reset).is_file() else Path(heading_reset)
    inputs = {"--file": source.file, "--sensors": source.sensors, "--heading-reset": lying}
    check_files({"--out": out}, inputs)
    _check_writable(out, overwrite)
    said = None if source.sensors is None else read_map(source.sensors)
    mounted = {} if said is None else {name: device.mounting for name, device in said.devices.items()}
    plan = CalibrationPlan(
        pose, heading_reset, _words(heading_reset, mounted), motion, hold, from_s, countdown
    )
    orient = OrientationStage(filter, magnetometer=not no_mag)
    say = Prompter(err=out == "-")
    metadata: dict[str, Any] = {
        "program": f"edgepose {__version__}",
        "source": source.name,
        "hold_s": hold,
    }
    measured = (live if source.live else recorded)(source, plan, orient, say)
    summary, reset = measured.summary, measured.reset
    if measured.from_s is not None:
        metadata["from_s"] = measured.from_s
    if measured.devices:
        metadata["devices"] = {
            PLACEMENTS[place]: device._asdict() for place, device in sorted(measured.devices.items())
        }
    warnings = [*summary.warnings, *(() if reset is None else reset.warnings)]
    for warning in warnings:
        terminal.say(f"warning: {warning}")
    metadata["samples"] = dict(zip(PLACEMENTS, summary.samples, strict=True))
    metadata["force_m_s2"] = _by_sensor(np.linalg.norm(summary.force, axis=-1))
    metadata["warnings"] = warnings
    if reset is not None:
        metadata["heading_reset"] = {"source": heading_reset, "error_deg": _by_sensor(reset.error_deg)}
    result = calibration.calibrate(
        summary,
        pose=pose,
        body_frame=body_frame or ("heading:0" if finds_forward(heading_reset) else "pelvis:-z"),
        created=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        heading_offset=None if reset is None else reset.offset,
        metadata=metadata,
        filter=filter,
        north=orient.north and (filter != "none" or reset is None),
    )
    if said is not None:
        for warning in calibration.mounting_warnings(result, mounted, said.path):
            terminal.say(f"warning: {warning}")
    if out == "-":
        click.echo(calibration.to_json(result), nl=False)
    else:
        calibration.save(result, out, overwrite)
    say(_table(result, summary, reset))
    say(f"Wrote {'stdout' if out == '-' else out}.")


def _check_use(
    source: SourceConfig,
    heading_reset: str | None,
    motion: tuple[float, float] | None,
    pose: str,
    from_s: float | None,
) -> None:
    """Raises click.UsageError where flags exclude each other."""
    if source.live and (from_s is not None or motion is not None):
        flag = "--motion" if from_s is None else "--from"
        raise click.UsageError(f"{flag} needs a recording that is read at once: --file without --realtime")
    if heading_reset == "live" and not source.live:
        raise click.UsageError(
            "--heading-reset live needs --port; give a recording of the sensors lying instead"
        )
    if motion is not None and heading_reset != "motion":
        raise click.UsageError("--motion goes with --heading-reset motion")
    if heading_reset == "motion" and pose != "straight":
        raise click.UsageError("--heading-reset motion begins with hanging arms: use --pose straight")


def _words(heading_reset: str | None, mounted: Mapping[str, str | None]) -> list[str]:
    """How the sensors sit, where the heading reset needs to know it.

    Raises:
        EdgeposeError: it does, and nobody has said it.
    """
    if heading_reset != "mounting":
        return []
    words = [text for text in mounted.values() if text is not None]
    if len(words) < len(PLACEMENTS):
        raise EdgeposeError(
            "--heading-reset mounting needs --sensors MAP.toml with a mounting for each sensor, "
            "or the axis with which all of them face forward, such as mounting:z"
        )
    return words


def _by_sensor(values: Array) -> dict[str, float | None]:
    """Numbers (6,) for a person, by placement; None where there is none."""
    return {
        name: None if math.isnan(v) else round(float(v), 3)
        for name, v in zip(PLACEMENTS, values, strict=True)
    }


def _check_writable(out: str, overwrite: bool) -> None:
    # Before anybody stands still for it.
    if out != "-" and not Path(out).parent.is_dir():
        raise EdgeposeError(f"{out}: no folder {Path(out).parent}; make it first or choose another --out")
    check_output(out, "the calibration", (".json",), overwrite)


# --- result -------------------------------------------------------------------------------------------------


def _table(result: Calibration, summary: HoldSummary, reset: HeadingReset | None) -> str:
    lines = ["sensor           samples  residual deg  |force| m/s^2  heading deg  its error  sits"]
    for i, (name, sits) in enumerate(zip(PLACEMENTS, calibration.mounting(result), strict=True)):
        force = float(np.linalg.norm(summary.force[i]))
        heading = "-" if reset is None else f"{math.degrees(reset.offset[i]):.1f}"
        error = "-" if reset is None else f"{reset.error_deg[i]:.1f}"
        lines.append(
            f"{name:16}{summary.samples[i]:8d}{result.residual_deg[i]:14.2f}"
            f"{'-' if math.isnan(force) else f'{force:.2f}':>15}{heading:>13}{error:>11}  {sits}"
        )
    return "\n".join(lines)
