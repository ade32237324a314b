"""`edgepose check`: find out what is wrong with a rig."""

from __future__ import annotations

import dataclasses
import json
import logging
import math
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from edgepose.cli.options.source import source_options
from edgepose.cli.terminal.live_page import Page, is_coloured, is_terminal
from edgepose.cli.terminal.messages import LEAST_COLUMNS, pieces, printable, say, show
from edgepose.cli.terminal.stop_signal import StopSignal
from edgepose.config import SourceConfig
from edgepose.errors import EdgeposeError

if TYPE_CHECKING:
    from edgepose.diagnostics.rules import Diagnosis
    from edgepose.diagnostics.sensor_health import SensorHealth, SensorHealthMonitor
    from edgepose.sources import Source, SourceCounters

_log = logging.getLogger(__name__)

REDRAW_S = 0.25
"""Time between two updates of the live page, seconds."""

LISTEN_S = 1.5
"""Time before the live page shows the table, seconds."""

DEFAULT_S = 10.0
"""Time to listen where there is no terminal, seconds."""


class State(NamedTuple):
    """State of the sensors at one time.

    Attributes:
        seconds: time since the start, on the source's clock.
        counters: packet counts of the source.
        sensors: health of each sensor, and its diagnosis.
    """

    seconds: float
    counters: SourceCounters
    sensors: list[tuple[SensorHealth, Diagnosis]]

    @property
    def problems(self) -> int:
        """Number of sensors with a problem."""
        return sum(finding.problem for _, finding in self.sensors)


@click.command()
@source_options
@click.option(
    "--seconds",
    type=click.FloatRange(0, min_open=True),
    help="How long to listen, seconds.  [default: until Ctrl-C on a terminal, "
    f"{DEFAULT_S:g} elsewhere; to the end of --file]",
)
@click.option(
    "--calibration",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Calibration of a wearer who stands in its pose: headings and placements are compared with it.",
)
@click.option("--json", "as_json", is_flag=True, help="Write the result as JSON.")
@click.pass_context
def check(
    ctx: click.Context, source: SourceConfig, seconds: float | None, calibration: Path | None, as_json: bool
) -> None:
    """Show the health of each sensor, and how to fix problems.

    docs/guide/check.md in the repository explains the findings.

    The sensors may lie on a table or be worn. Hold them still for some seconds: gravity, noise and bias only
    show at rest. Then turn each one to and fro: gyroscope and orientation can only be compared in motion.

    The exit code is 0 if all six sensors are fine, and 1 if one of them, or a part of the file, is not.

    \b
    Examples:
      edgepose check --port /dev/ttyUSB0
      edgepose check --can socketcan:can0 --seconds 20 --json
      edgepose check --port /dev/ttyUSB0 --calibration calib.json
      edgepose check --file walk.npz
    """
    from edgepose.calibration import load_calibration
    from edgepose.diagnostics.sensor_health import SensorHealthMonitor
    from edgepose.pipeline.rig_comparison import missing_heading_reset, other_devices
    from edgepose.sources import open_source

    loaded = None if calibration is None else load_calibration(calibration)
    health = SensorHealthMonitor(loaded)
    if seconds is None:
        seconds = DEFAULT_S if source.live and not is_terminal() else math.inf
    with ExitStack() as stack:
        page = stack.enter_context(Page()) if is_terminal() and source.live and not as_json else None
        warnings = stack.enter_context(_warnings(hidden=page is not None))
        opened = stack.enter_context(open_source(**source.arguments(), lenient=True))
        stop = stack.enter_context(StopSignal())

        def watch(now: Callable[[], State]) -> None:
            if page is not None:
                page.draw(_page_lines(source.name, now(), warnings))

        state, error = _listen(opened, health, source.file is None, seconds, lambda: stop.asked, watch)
        differences = [] if loaded is None else other_devices(loaded, opened.devices)
        for difference in [*differences, *missing_heading_reset(loaded, opened.devices)]:
            _log.warning("%s", difference)
    if page is not None:
        for warning in warnings:
            say(f"warning: {warning}")
    if opened.damage:
        say(f"warning: {opened.damage}")
        warnings.append(opened.damage)
    if error is not None and not as_json and not any(sensor.samples for sensor, _ in state.sensors):
        raise error  # a table of sensors that sent nothing would hide the reason
    if as_json:
        show(_json(source.name, state, warnings))
    else:
        # Not with show, which would remove the colours; the cells contain no text from devices.
        click.echo("\n".join(_lines(state, shutil.get_terminal_size().columns if is_terminal() else None)))
    if error is not None:
        raise error
    ctx.exit(1 if state.problems or opened.damage else 0)


def _page_lines(name: str, state: State, warnings: list[str]) -> list[str]:
    width = shutil.get_terminal_size().columns
    title = printable(f"edgepose check  {name}; Ctrl-C ends")
    table = ["listening ..."] if state.seconds < LISTEN_S else _lines(state, width)
    return [title[:width], *table, *(piece[:width] for piece in _wrapped(warnings, width))]


def _listen(
    source: Source,
    health: SensorHealthMonitor,
    live: bool,
    seconds: float,
    stopped: Callable[[], bool],
    watch: Callable[[Callable[[], State]], None],
) -> tuple[State, EdgeposeError | None]:
    """Return the state at the end, and the error that ended it, if any.

    Args:
        source: the open source.
        health: monitor that gets the samples.
        live: whether samples arrive from devices, so that their delay means something.
        seconds: how long to listen.
        stopped: whether to end early.
        watch: called every `REDRAW_S` with a callable that returns the state.
    """
    from edgepose.diagnostics.rules import diagnose

    start_s: float | None = None
    now_s = shown_s = 0.0

    def state() -> State:
        sensors = [(sensor, diagnose(sensor)) for sensor in health.report(now_s, source.clocks)]
        return State(0.0 if start_s is None else now_s - start_s, source.counters, sensors)

    try:
        for batch in source:
            now_s = batch.now_s
            start_s = now_s if start_s is None else start_s
            health.add(batch.samples, now_s + batch.ahead_s if live else math.nan)
            if time.monotonic() - shown_s >= REDRAW_S:
                watch(state)
                shown_s = time.monotonic()
            if now_s - start_s >= seconds or stopped():
                break
    except EdgeposeError as error:
        return state(), error
    return state(), None


@contextmanager
def _warnings(hidden: bool) -> Iterator[list[str]]:
    """Collect the program's warnings while the context is entered.

    Args:
        hidden: do not write them to standard error as well.
    """
    result: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: result.append(printable(record.getMessage()))  # type: ignore[method-assign]
    logger = logging.getLogger("edgepose")
    logger.addHandler(handler)
    logger.propagate = not hidden
    try:
        yield result
    finally:
        logger.removeHandler(handler)
        logger.propagate = True


# --- the table ----------------------------------------------------------------------------------------------


class _Column(NamedTuple):
    """A column of the table.

    Attributes:
        header: name of the column.
        unit: unit of its numbers.
        text: returns the text of a sensor's cell.
        rank: order in which columns are left out on a narrow screen, highest first.
    """

    header: str
    unit: str
    text: Callable[[SensorHealth], str]
    rank: int


def _number(field: str, decimals: int, sign: str = "") -> Callable[[SensorHealth], str]:
    def text(sensor: SensorHealth) -> str:
        value = getattr(sensor, field)
        return "-" if math.isnan(value) else f"{value:{sign}.{decimals}f}"

    return text


_COLUMNS = (
    _Column("rate", "Hz", _number("rate_hz", 1), 0),
    _Column("jitter", "ms", _number("jitter_ms", 1), 9),
    _Column("lost", "%", _number("lost_percent", 1), 1),
    _Column("late", "ms", _number("late_ms", 0), 7),
    _Column("age", "s", _number("age_s", 1), 6),
    _Column("clock", "ppm", _number("clock_ppm", 0, "+"), 5),
    _Column("norm", "m/s²", _number("norm_m_s2", 2), 2),
    _Column("gravity", "m/s²", _number("gravity_error_m_s2", 2), 10),
    _Column("tilt", "deg", _number("tilt_deg", 1), 1),
    _Column("noise", "m/s²", _number("acc_noise_m_s2", 2), 8),
    _Column("noise", "deg/s", _number("gyr_noise_deg_s", 1), 4),
    _Column("bias", "deg/s", _number("bias_deg_s", 1), 3),
    _Column("field", "uT", _number("field_ut", 1), 11),
    _Column("heading", "deg", _number("heading_deg", 0, "+"), 3),
)


_NOTHING = "no packet came from any sensor: switch them on, and check the lines' names, --baud and --protocol"


def _lines(state: State, width: int | None) -> list[str]:
    """Return a headline, a row for each sensor and advice, fitted into `width` columns (None: any width)."""
    fine = len(state.sensors) - state.problems
    counters = state.counters
    headline = (
        f"{state.seconds:.0f} s: {fine} of {len(state.sensors)} sensors fine; packets "
        f"{counters.packets} good, {counters.lost} lost, {counters.bad} bad, {counters.unknown} unknown"
    )
    advice = [f"{sensor.placement}: {finding.advice}" for sensor, finding in state.sensors if finding.advice]
    if not any(sensor.samples for sensor, _ in state.sensors):
        advice = [_NOTHING]
    return [headline[:width], "", *_rows(state, width), *([""] if advice else []), *_wrapped(advice, width)]


def _rows(state: State, width: int | None) -> list[str]:
    names = [["", "sensor", *(sensor.placement for sensor, _ in state.sensors)]]
    columns = [
        (column.rank, [column.header, column.unit, *(column.text(sensor) for sensor, _ in state.sensors)])
        for column in _COLUMNS
    ]
    findings = ["", "finding", *(finding.name for _, finding in state.sensors)]
    # Leave out columns that no sensor has values for, and on a narrow screen the least important ones.
    columns = [(rank, cells) for rank, cells in columns if any(cell != "-" for cell in cells[2:])]
    while columns and width is not None and _width([*names, *(c for _, c in columns), findings]) > width:
        columns.remove(max(columns))
    padded = [[cell.ljust(max(map(len, cells))) for cell in cells] for cells in names]
    padded += [[cell.rjust(max(map(len, cells))) for cell in cells] for _, cells in columns]
    rows = ["  ".join(cells) + "  " for cells in zip(*padded, strict=True)]
    colours = [None, None, *(_colour(finding) for _, finding in state.sensors)]
    return [
        (row + (click.style(finding, fg=colour) if colour and is_coloured() else finding)).rstrip()
        for row, finding, colour in zip(rows, findings, colours, strict=True)
    ]


def _width(columns: list[list[str]]) -> int:
    return sum(max(map(len, cells)) + 2 for cells in columns) - 2


def _colour(finding: Diagnosis) -> str:
    if finding.problem:
        return "red"
    return "yellow" if finding.advice else "green"


def _wrapped(lines: list[str], width: int | None) -> list[str]:
    if width is None or not lines:
        return lines
    return [
        piece for line in "\n".join(lines).split("\n") for piece in pieces(line, max(width, LEAST_COLUMNS))
    ]


def _json(name: str, state: State, warnings: list[str]) -> str:
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
                **_health_fields(sensor),
            }
            for sensor, finding in state.sensors
        ],
    }
    return json.dumps(document, indent=2, allow_nan=False)


def _health_fields(sensor: SensorHealth) -> dict[str, Any]:
    """Return the fields of a sensor's health for JSON; None for unknown numbers."""
    return {
        key: (float(f"{value:.6g}") if math.isfinite(value) else None) if isinstance(value, float) else value
        for key, value in dataclasses.asdict(sensor).items()
    }
