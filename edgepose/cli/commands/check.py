"""`edgepose check`: find out what is wrong with a rig."""

from __future__ import annotations

import dataclasses
import logging
import math
import shutil
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING

import click

from edgepose.cli.exit_codes import ATTENTION, DONE, FAILED
from edgepose.cli.options.calibrated_run import CalibratedRun, calibration_options
from edgepose.cli.options.float_range import FloatRange
from edgepose.cli.options.json_result import json_option, show_json
from edgepose.cli.options.source import lacking_sensors, source_options, without_option
from edgepose.cli.sensor_table import State, page_lines, table_lines
from edgepose.cli.terminal.live_page import Page, is_terminal
from edgepose.cli.terminal.messages import say, warnings_to
from edgepose.cli.terminal.stop_signal import StopSignal
from edgepose.config import SourceConfig
from edgepose.errors import EdgeposeError
from edgepose.placements import PLACEMENTS
from edgepose.utils.machine_lag import MachineLag

if TYPE_CHECKING:
    from edgepose.calibration import Calibration
    from edgepose.diagnostics.sensor_health import SensorHealthMonitor
    from edgepose.sources import Source

_log = logging.getLogger(__name__)

REDRAW_S = 0.25
"""Time between two updates of the live page, seconds."""

DEFAULT_S = 10.0
"""Time to listen where there is no terminal, seconds."""


@click.command()
@source_options
@without_option
@click.option(
    "--seconds",
    type=FloatRange(0, min_open=True),
    help="How long to listen, seconds.  [default: until Ctrl-C on a terminal, "
    f"{DEFAULT_S:g} elsewhere; to the end of --file]",
)
@calibration_options
@json_option
@click.pass_context
def check(
    ctx: click.Context,
    source: SourceConfig,
    without: tuple[str, ...],
    seconds: float | None,
    calibrated: CalibratedRun | None,
    as_json: bool,
) -> None:
    """Show the health of each sensor, and how to fix problems.

    docs/guide/check.md in the repository explains the findings.

    The sensors may lie on a table or be worn. Hold them still for some seconds: gravity, noise and bias only
    show at rest. Then turn each one to and fro: gyroscope and orientation can only be compared in motion.

    The exit code is 0 if all sensors are fine, and 3 if one of them is not, or if the rig has changed
    since the calibration. It is 1 if sensors or file could not be read to the end.

    \b
    Examples:
      edgepose check --port /dev/ttyUSB0
      edgepose check --can socketcan:can0 --seconds 20 --json
      edgepose check --port /dev/ttyUSB0 --calibration calib.json
      edgepose check --file walk.npz
    """
    from edgepose.diagnostics.rules import busy_machine
    from edgepose.diagnostics.sensor_health import SensorHealthMonitor
    from edgepose.sources import open_source

    warnings: list[str] = []
    calibration = None if calibrated is None else calibrated.calibration
    health = SensorHealthMonitor(calibration, _names(source, calibration, without))
    with ExitStack() as stack:
        page = stack.enter_context(Page()) if is_terminal() and source.live and not as_json else None
        stack.enter_context(warnings_to(warnings.append, hidden=page is not None))
        opened = stack.enter_context(open_source(**source.arguments(), lenient=True))
        stop = stack.enter_context(StopSignal())
        lag = stack.enter_context(MachineLag()) if source.file is None else None
        if seconds is None:
            seconds = DEFAULT_S if source.live and not is_terminal() else math.inf
            if source.live and not is_terminal():
                say(f"listening for {seconds:g} s; Ctrl-C ends it earlier")

        def watch(now: Callable[[], State]) -> None:
            if page is not None:
                width = shutil.get_terminal_size().columns
                page.draw(page_lines(source.name, now(), warnings, width))

        state, error = _listen(opened, health, lag, seconds, lambda: stop.asked, watch)
        changed = _changes(calibrated, source, opened, state)
        if (busy := busy_machine(sensor for sensor, _ in state.sensors)) is not None:
            _log.warning("%s", busy)
    if page is not None:
        for warning in warnings:
            say(f"warning: {warning}")
    if opened.damage:
        say(f"warning: {opened.damage}")
        warnings.append(opened.damage)
    _show(source.name, state, warnings, error, as_json)
    ctx.exit(ATTENTION if state.problems or changed else FAILED if opened.damage else DONE)


def _names(source: SourceConfig, calibration: Calibration | None, without: tuple[str, ...]) -> list[str]:
    """Return the sensors of the rig, of its map, calibration, or the six; say which of the six it lacks."""
    from edgepose.sources.sensor_map import read_map

    stated = list(PLACEMENTS) if calibration is None else calibration.names
    if source.sensors is not None:
        stated = list(read_map(source.sensors).devices)
    names = [name for name in stated if name not in without]
    if lacking := lacking_sensors(names):
        say(lacking)
    return names


def _show(name: str, state: State, warnings: list[str], error: EdgeposeError | None, as_json: bool) -> None:
    """Show the result.

    Raises:
        EdgeposeError: the error that ended the source, if there is one.
    """
    if error is not None and not as_json and not any(sensor.samples for sensor, _ in state.sensors):
        raise error  # a table of sensors that sent nothing would hide the reason
    if as_json:
        _show_json(name, state, warnings)
    else:
        # Not with show, which would remove the colours; the cells contain no text from devices.
        width = shutil.get_terminal_size().columns if is_terminal() else None
        click.echo("\n".join(table_lines(state, width)))
    if error is not None:
        raise error


def _changes(calibrated: CalibratedRun | None, source: SourceConfig, opened: Source, state: State) -> bool:
    """Warn about each change of the rig since its calibration, and return whether there is one."""
    from edgepose.pipeline.rig_comparison import changes, missing_heading_reset, missing_quantities
    from edgepose.sources.sensor_map import read_map

    differences, calibration = [], None
    if calibrated is not None:
        calibration = calibrated.calibration
        sensor_map = None if source.sensors is None else read_map(source.sensors)
        reporting = [sensor for sensor, _ in state.sensors if sensor.samples]
        differences = [
            *calibrated.differences,
            *changes(calibration, opened.devices, sensor_map),
            *missing_quantities(
                calibration,
                [sensor.placement for sensor in reporting if not sensor.orientation],
                [sensor.placement for sensor in reporting if not sensor.magnetometer],
            ),
        ]
    for difference in [*differences, *missing_heading_reset(calibration, opened.devices)]:
        _log.warning("%s", difference)
    return bool(differences)


def _listen(
    source: Source,
    health: SensorHealthMonitor,
    lag: MachineLag | None,
    seconds: float,
    stopped: Callable[[], bool],
    watch: Callable[[Callable[[], State]], None],
) -> tuple[State, EdgeposeError | None]:
    """Return the state at the end, and the error that ended it, if any.

    Args:
        source: the open source.
        health: monitor that gets the samples.
        lag: of this machine; None if samples do not arrive from devices, so that their delay means nothing.
        seconds: how long to listen.
        stopped: whether to end early.
        watch: called every `REDRAW_S` with a callable that returns the state.
    """
    from edgepose.diagnostics.rules import diagnose

    start_s: float | None = None
    now_s = shown_s = 0.0

    def state() -> State:
        lag_ms = 0.0 if lag is None else lag.late_ms
        sensors = [(sensor, diagnose(sensor)) for sensor in health.report(now_s, source.clocks, lag_ms)]
        return State(0.0 if start_s is None else now_s - start_s, source.counters, sensors)

    try:
        for batch in source:
            now_s = batch.now_s
            start_s = now_s if start_s is None else start_s
            health.add(batch.samples, math.nan if lag is None else now_s + batch.ahead_s)
            if time.monotonic() - shown_s >= REDRAW_S:
                watch(state)
                shown_s = time.monotonic()
            if now_s - start_s >= seconds or stopped():
                break
    except EdgeposeError as error:
        return state(), error
    return state(), None


def _show_json(name: str, state: State, warnings: list[str]) -> None:
    document = {
        "source": name,
        "seconds": round(state.seconds, 3),
        **state.counters._asdict(),
        "warnings": warnings,
        "problems": state.problems,
        "sensors": [
            {
                "placement": sensor.placement,
                "finding": finding.name,
                "problem": finding.problem,
                "advice": finding.advice,
                **dataclasses.asdict(sensor),
            }
            for sensor, finding in state.sensors
        ],
    }
    show_json("check", document)
