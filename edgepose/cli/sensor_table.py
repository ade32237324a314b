"""The table of sensors that `edgepose check` shows: headline, a row for each sensor, advice."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import click

from edgepose.calibration.static_pose import all_of
from edgepose.cli.terminal.live_page import is_coloured
from edgepose.cli.terminal.messages import LEAST_COLUMNS, pieces, printable

if TYPE_CHECKING:
    from edgepose.diagnostics.rules import Diagnosis
    from edgepose.diagnostics.sensor_health import SensorHealth
    from edgepose.sources import SourceCounters

LISTEN_S = 1.5
"""Time before the live page shows the table, seconds."""

_NUMBER = re.compile(r"(?<![\w.-])[-+]?\d+(?:\.\d+)?(?![\w.-]*\w)")
"""A number between spaces, not one inside of a word or a flag."""


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


class _Column(NamedTuple):
    """A column of the table.

    Attributes:
        header: name of the column.
        unit: unit of its numbers.
        field: field of `SensorHealth` with the numbers.
        spec: format of a number.
        rank: order in which columns are left out on a narrow screen, highest first.
    """

    header: str
    unit: str
    field: str
    spec: str
    rank: int

    def text(self, sensor: SensorHealth) -> str:
        """Return the cell of a sensor."""
        value = getattr(sensor, self.field)
        return "-" if math.isnan(value) else format(value, self.spec)


_COLUMNS = (
    _Column("rate", "Hz", "rate_hz", ".1f", 0),
    _Column("jitter", "ms", "jitter_ms", ".1f", 9),
    _Column("lost", "%", "lost_percent", ".1f", 1),
    _Column("late", "ms", "late_ms", ".0f", 7),
    _Column("age", "s", "age_s", ".1f", 6),
    _Column("clock", "ppm", "clock_ppm", "+.0f", 5),
    _Column("norm", "m/s²", "norm_m_s2", ".2f", 2),
    _Column("gravity", "m/s²", "gravity_error_m_s2", ".2f", 10),
    _Column("tilt", "deg", "tilt_deg", ".1f", 1),
    _Column("noise", "m/s²", "acc_noise_m_s2", ".2f", 8),
    _Column("noise", "deg/s", "gyr_noise_deg_s", ".1f", 4),
    _Column("bias", "deg/s", "bias_deg_s", ".1f", 3),
    _Column("field", "uT", "field_ut", ".1f", 11),
    _Column("heading", "deg", "heading_deg", "+.0f", 3),
)

_NOTHING = "no packet came from any sensor: switch them on, and check the lines' names, --baud and --protocol"


def page_lines(name: str, state: State, warnings: Sequence[str], width: int) -> list[str]:
    """Return the lines of the live page.

    Args:
        name: name of the source.
        state: what is known now.
        warnings: of the program so far.
        width: columns of the terminal.
    """
    title = printable(f"edgepose check; Ctrl-C ends it  {name}")
    table = ["listening ..."] if state.seconds < LISTEN_S else table_lines(state, width)
    return [title[:width], *table, *(piece[:width] for piece in _wrapped(warnings, width))]


def table_lines(state: State, width: int | None) -> list[str]:
    """Return a headline, a row for each sensor and advice, fitted into `width` columns (None: any width)."""
    fine = len(state.sensors) - state.problems
    counters = state.counters
    headline = (
        f"{state.seconds:.0f} s: {fine} of {len(state.sensors)} sensors fine; packets "
        f"{counters.packets} good, {counters.lost} lost, {counters.bad} bad, {counters.unknown} unknown"
    )
    advice = _grouped_advice(state) if any(sensor.samples for sensor, _ in state.sensors) else [_NOTHING]
    return [
        *_wrapped([headline], width),
        "",
        *_rows(state, width),
        *([""] if advice else []),
        *_wrapped(advice, width),
    ]


def _grouped_advice(state: State) -> list[str]:
    """Return each piece of advice once, with the sensors that it is for and the range of its numbers."""
    groups: dict[str, list[tuple[str, str]]] = {}
    for sensor, finding in state.sensors:
        if finding.advice:
            pattern = _NUMBER.sub("#", finding.advice)
            groups.setdefault(pattern, []).append((sensor.placement, finding.advice))
    lines = []
    everyone = f"{all_of([sensor.placement for sensor, _ in state.sensors])} sensors"
    for group in groups.values():
        names = ", ".join(name for name, _ in group) if len(group) < len(state.sensors) else everyone
        words = _NUMBER.split(group[0][1])
        columns = zip(*(_NUMBER.findall(advice) for _, advice in group), strict=True)
        numbers = [*map(_span, columns), ""]
        lines.append(f"{names}: {''.join(w + n for w, n in zip(words, numbers, strict=True))}")
    return lines


def _span(numbers: Sequence[str]) -> str:
    """Return a number that several sensors have, or the smallest and the largest of theirs."""
    least, most = min(numbers, key=float), max(numbers, key=float)
    return least if least == most else f"{least} to {most}"


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


def _wrapped(lines: Sequence[str], width: int | None) -> list[str]:
    if width is None or not lines:
        return list(lines)
    return [
        piece for line in "\n".join(lines).split("\n") for piece in pieces(line, max(width, LEAST_COLUMNS))
    ]
