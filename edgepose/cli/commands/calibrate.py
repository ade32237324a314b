"""`edgepose calibrate`: find out how the sensors sit on the wearer."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from edgepose import calibration
from edgepose.calibration import Calibration
from edgepose.cli.calibration_job import CalibrationJob, calibration_of
from edgepose.cli.calibration_session import (
    ROUTINE_S,
    CalibrationPlan,
    Measured,
    measure_live,
    measure_recorded,
)
from edgepose.cli.calibration_verdict import DAMAGED, judge, next_command, table, values
from edgepose.cli.guide.guide import Guide, end_stage
from edgepose.cli.guide.phone_page import PhonePage, address_in_network
from edgepose.cli.options.body import HEIGHT
from edgepose.cli.options.float_range import FloatRange
from edgepose.cli.options.gathered import gathered
from edgepose.cli.options.inputs import check_jobs, recordings_or_source
from edgepose.cli.options.json_result import json_option, show_json
from edgepose.cli.options.outputs import address, check_files, overwrite_option
from edgepose.cli.options.recording_time import RecordingTime, RecordingTimeType
from edgepose.cli.options.source import (
    filter_options,
    lacking_sensors,
    source_options,
    without_option,
)
from edgepose.cli.terminal import messages as terminal
from edgepose.config import SourceConfig
from edgepose.errors import EdgeposeError
from edgepose.orientation.stage import OrientationStage
from edgepose.placements import PLACEMENTS
from edgepose.sinks.output_files import check_output
from edgepose.sources import LINE_FLAGS
from edgepose.sources.sensor_map import SensorMap, read_map
from edgepose.utils.similar_names import choices

PAGE_PORT = 8090
"""Port of the page without an address."""

_RESETS = ("live", "motion", "steps", "mounting")
"""Ways to reset headings that are no file."""


def _body_frame(ctx: click.Context, param: click.Parameter, value: str | None) -> str | None:
    try:
        return None if value is None else calibration.check_body_frame(value)
    except EdgeposeError as error:
        raise click.BadParameter(str(error)) from None


def _heading_reset(ctx: click.Context, param: click.Parameter, value: str | None) -> str | None:
    if value is not None and re.fullmatch(r"mounting:(?![+-]?[xyz]$).*", value):
        raise click.BadParameter(f"{value}: an axis is x, y or z, or the opposite direction, such as -z")
    if value is not None and not _is_reset(value):
        raise click.BadParameter(f"{value}: no such file; {choices(value, _RESETS, 'without a file it is')}")
    return value


def _is_reset(value: str) -> bool:
    return value in _RESETS or value.startswith("mounting:") or Path(value).exists()


def _span(
    ctx: click.Context, param: click.Parameter, value: str | None
) -> tuple[RecordingTime, RecordingTime] | None:
    if value is None:
        return None
    parts = value.split(":")
    if len(parts) != 2:
        raise click.BadParameter(f"{value!r} is not FROM:TO, two times in seconds such as 12.5:40")
    start, end = (RecordingTimeType().convert(part, param, ctx) for part in parts)
    if start.since_start == end.since_start and start.seconds >= end.seconds:
        raise click.BadParameter(f"{value!r} is not FROM:TO, its end is not after its start")
    return start, end


_PLAN_FLAGS = [
    click.option(
        "--pose",
        type=click.Choice([*calibration.POSES, calibration.TWO_POSES]),
        default="straight",
        show_default=True,
        help="Pose to hold: arms hanging, arms out to the sides, or one after the other, which also shows "
        "the direction that the wearer faces.",
    ),
    click.option(
        "--body-frame",
        callback=_body_frame,
        metavar="head|SENSOR:AXIS|heading:DEG",
        help="Direction that the wearer faces during the hold. SENSOR:AXIS: that of this axis of this "
        "sensor (pelvis:-z fits a pelvis sensor worn flat on the lower back, Z out of its face). "
        "heading:DEG: degrees from X of the inertial frame towards Y. head: that of the head sensor, "
        "worn with X to the left, Y up, Z forward.  [default: pelvis:-z, or what the heading reset finds]",
    ),
    click.option(
        "--heading-reset",
        callback=_heading_reset,
        metavar="FILE|live|motion|steps|mounting[:AXIS]",
        help="Align the headings of sensors without a common north. FILE: by a recording of all "
        "lying side by side in one orientation. live: the same, with the sensors themselves. motion: by "
        "movements after the hold. steps: by some steps straight ahead after the hold. mounting: by the "
        "mountings in the sensor map. mounting:AXIS: by this axis of every sensor, which faces forward in "
        "the pose.  [default: none, the sensors share a north]",
    ),
    click.option(
        "--motion",
        callback=_span,
        metavar="FROM:TO",
        help="Start and end of the movements for --heading-reset motion, or of the stand, the steps and the "
        "stand for steps, on the clock of --file, seconds; with a plus sign, since its start.  [default: up "
        f"to {ROUTINE_S:g} s from the end of the hold on; for steps from its start on]",
    ),
    click.option(
        "--hold",
        "hold_s",
        type=FloatRange(0.2, 600),
        default=4.0,
        show_default=True,
        help="Length of the hold, seconds.",
    ),
    click.option(
        "--from",
        "start",
        type=RecordingTimeType(),
        metavar="[+]SECONDS",
        help="Start of the hold on the clock of --file, seconds; with a plus sign, since its start.  "
        "[default: the first of the stillest parts]",
    ),
    click.option(
        "--countdown",
        "countdown_s",
        type=FloatRange(0, 600),
        default=10.0,
        show_default=True,
        help="Time before each live hold, seconds; before each movement 3 at most.",
    ),
]


def _plan_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the flags for the steps of a calibration; the command gets them as `plan: CalibrationPlan`."""
    return gathered(command, _PLAN_FLAGS, "plan", CalibrationPlan)


@click.command()
@recordings_or_source
@source_options
@without_option
@filter_options
@click.option(
    "--out",
    default="calib.json",
    show_default=True,
    metavar="FILE",
    help="Calibration file to write, JSON; - is standard output. A folder with recordings IN.",
)
@overwrite_option
@click.option(
    "--height",
    "height_m",
    type=HEIGHT,
    help="The wearer's height, metres, which run then uses.",
)
@click.option(
    "--page",
    is_flag=False,
    flag_value=f"127.0.0.1:{PAGE_PORT}",
    callback=address,
    metavar="[HOST:PORT]",
    help="Guide the wearer by a page at this address of this machine, for a browser or a phone, with sound "
    f"and buttons; live sources only.  [default without a value: 127.0.0.1:{PAGE_PORT}]",
)
@_plan_options
@click.option(
    "--jobs",
    type=click.IntRange(1),
    default=1,
    show_default=True,
    help="Number of processes for the recordings IN, each of which calibrates from one at a time.",
)
@json_option
def calibrate(
    inputs: tuple[Path, ...],
    source: SourceConfig,
    without: tuple[str, ...],
    filter: str,
    no_mag: bool,
    out: str,
    overwrite: bool,
    height_m: float | None,
    page: tuple[str, int] | None,
    plan: CalibrationPlan,
    jobs: int,
    as_json: bool,
) -> None:
    """Find out how the sensors sit on their wearer.

    The wearer holds a pose for a few seconds, live (--port, --can, --listen, --connect, --ble, --hid) or in a
    recording (--file). The calibration, which `edgepose run` needs, contains the direction that the wearer
    faces and the orientation of each sensor on its segment. Repeat it after one came off or slipped.

    IN are recordings to calibrate from, each by itself, instead of a source: files, patterns and folders.
    --out then names a folder for the calibrations.

    \b
    Examples:
      edgepose calibrate --port /dev/ttyUSB0
      edgepose calibrate --port COM3 --filter kalman --heading-reset motion
      edgepose calibrate --port COM3 --page 192.168.1.5:8090
      edgepose calibrate --sensors rig.toml --pose t-pose
      edgepose calibrate --file walk.csv --from +2.5 --body-frame heading:0
      edgepose calibrate takes/ --out calibrations --jobs 2
    """
    _check_use(source, plan, page)
    check_jobs(jobs, inputs)
    if no_mag and filter == "none":
        raise click.UsageError("--no-mag is for a --filter")
    if as_json and out == "-":
        raise click.UsageError("--out - and --json both write to standard output; name a file")
    files = {"--file": source.file, "--sensors": source.sensors, "--heading-reset": plan.side_by_side}
    if not inputs:
        check_files([("--out", out)], files)
        _check_writable(out, overwrite)
    sensor_map = None if source.sensors is None else read_map(source.sensors)
    plan = _for_rig(plan, sensor_map, without)
    job = CalibrationJob(source, plan, filter, not no_mag, height_m, sensor_map)
    if inputs:
        from edgepose.cli.calibrate_recordings import calibrate_recordings

        calibrate_recordings(inputs, job, out, overwrite, jobs, as_json)
        return
    with ExitStack() as stack:
        phone = None if page is None else stack.enter_context(PhonePage(*page))
        guide = stack.enter_context(Guide(err=out == "-" or as_json, phone=phone))
        if phone is not None:
            _announce(phone, guide)
        last = _repeated(job, guide, out, overwrite)
    if as_json:
        show_json("calibrate", {"planned": 1, "calibrations": [values(job.source, out, *last)]})
    if last[0].damaged:
        raise EdgeposeError(f"{DAMAGED} above")


def _repeated(
    job: CalibrationJob, guide: Guide, out: str, overwrite: bool
) -> tuple[Measured, Calibration, list[str]]:
    """Calibrate, again as often as the wearer asks for it; return what `_calibrated` returned last.

    The warnings include those that were logged meanwhile.

    Raises:
        EdgeposeError: the last calibration failed, or cannot be written.
    """
    while True:
        logged: list[str] = []
        try:
            with terminal.warnings_to(logged.append, hidden=False):
                measured, result, warnings = _calibrated(job, guide)
        except EdgeposeError as error:
            if not guide.wants_repeat(end_stage("REDO", str(error), job.plan.first_pose)):
                raise
            continue
        guide.close_page()
        for warning in warnings:
            terminal.say(f"warning: {warning}")
        warnings = [*logged, *warnings]
        if out != "-":
            calibration.save(result, out, overwrite)
            overwrite = True  # by a repetition
        guide(table(result, measured))
        if out != "-":
            guide(f"Wrote {out}.")
        judgement = judge(result, measured, warnings)
        guide(judgement.text)
        if out != "-" and not measured.damaged:
            guide("Next:")
            guide.command(next_command(job.source, out))
        if not guide.wants_repeat(end_stage(judgement.word, judgement.text, job.plan.first_pose)):
            if out == "-":  # once only, whatever the wearer repeats
                click.echo(calibration.to_json(result), nl=False)
                guide("Wrote stdout.")
            return measured, result, warnings


def _calibrated(job: CalibrationJob, guide: Guide) -> tuple[Measured, Calibration, list[str]]:
    """Measure once; return the measurements, the calibration, and warnings about it.

    Raises:
        EdgeposeError: sensors are missing, the wearer moved, or headings would be arbitrary.
    """
    source, plan = job.source, job.plan
    orient = OrientationStage(job.filter, job.magnetometer)
    measured = (measure_live if source.live else measure_recorded)(source, plan, orient, guide)
    return calibration_of(job, orient, measured, guide)


def _announce(phone: PhonePage, guide: Guide) -> None:
    """Say where the page is."""
    guide(f"Page for the wearer: {phone.url}")
    own = address_in_network()
    if phone.is_local and own is not None:
        guide(f"Only this machine can open it. For a phone in your network: --page {own}:{phone.port}")


def _check_use(source: SourceConfig, plan: CalibrationPlan, page: tuple[str, int] | None) -> None:
    """Raise click.UsageError if flags exclude each other."""
    if source.live and (plan.start is not None or plan.motion is not None):
        flag = "--motion" if plan.start is None else "--from"
        raise click.UsageError(f"{flag} needs a recording that is read at once: --file without --realtime")
    if page is not None and not source.live:
        raise click.UsageError(f"--page guides a wearer in front of live sensors: give {LINE_FLAGS}")
    if plan.heading_reset == "live" and not source.live:
        raise click.UsageError(
            f"--heading-reset live needs {LINE_FLAGS}; give a recording of the sensors lying side by side "
            "instead"
        )
    moves = plan.heading_reset in ("motion", "steps")
    if plan.motion is not None and not moves:
        raise click.UsageError("--motion needs --heading-reset motion or steps")
    if moves and plan.pose == "t-pose":
        raise click.UsageError(
            f"--heading-reset {plan.heading_reset} starts with hanging arms: use --pose straight"
        )


def _for_rig(plan: CalibrationPlan, sensor_map: SensorMap | None, without: Sequence[str]) -> CalibrationPlan:
    """Return the plan with the sensors of the rig and their mountings; say which of the six it lacks.

    Args:
        plan: the plan.
        sensor_map: map that names the sensors; None for the six.
        without: sensors that the rig lacks.

    Raises:
        EdgeposeError: the heading reset needs mountings, and the map does not have all of them.
    """
    stated = PLACEMENTS if sensor_map is None else sensor_map.devices
    names = [name for name in stated if name not in without]
    if lacking := lacking_sensors(names):
        terminal.say(lacking)
    mounting = _all_mountings(sensor_map) if plan.heading_reset == "mounting" else {}
    return dataclasses.replace(plan, names=names, mounting=mounting)


def _all_mountings(sensor_map: SensorMap | None) -> dict[str, str]:
    """Return the mounting of each sensor, by name.

    Raises:
        EdgeposeError: the sensor map does not have all of them.
    """
    devices = {} if sensor_map is None else sensor_map.devices
    known = {name: device.mounting for name, device in devices.items() if device.mounting is not None}
    if not known or len(known) < len(devices):
        raise EdgeposeError(
            "--heading-reset mounting needs --sensors MAP.toml with a mounting for each sensor, "
            "or the axis with which all of them face forward, such as mounting:z"
        )
    return known


def _check_writable(out: str, overwrite: bool) -> None:
    # Checked before the wearer has to stand still.
    if out != "-" and not Path(out).parent.is_dir():
        raise EdgeposeError(f"{out}: no folder {Path(out).parent}; make it first or choose another --out")
    check_output(out, "the calibration", (".json",), overwrite)
