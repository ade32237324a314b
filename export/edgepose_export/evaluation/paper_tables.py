"""Tables in the form of DIP's tables 2 to 5, for comparison with the paper."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from edgepose.inference.archive import is_windowed
from edgepose_export.evaluation.evaluate import Mode, Table


def _offline(metadata: Mapping[str, Any]) -> list[Mode]:
    return [Mode("offline")]


def _online(metadata: Mapping[str, Any]) -> list[Mode]:
    return [Mode("stream", 0, metadata["future"])]


def _windows(metadata: Mapping[str, Any]) -> list[Mode]:
    """Return both windows of table 3; a network without windows is streamed."""
    if not is_windowed(metadata):
        return _online(metadata)
    return [Mode("window", 20, 5), Mode("window", 50, 5)]


class PaperTable(NamedTuple):
    """One of the paper's tables.

    Attributes:
        modes: function that returns the modes to run, from an archive's metadata.
        positions: whether the table has positional errors, too.
    """

    modes: Callable[[Mapping[str, Any]], list[Mode]]
    positions: bool


TABLES = {
    "2": PaperTable(_offline, True),
    "3": PaperTable(_windows, True),
    "4": PaperTable(_online, False),
    "5": PaperTable(_offline, False),
}
"""2: offline; 3: online with 20 or 50 past and 5 future frames; 4: networks without recurrence, online;
5: with and without accelerations, offline.
"""


def format_paper_table(tables: Mapping[str, Table], positions: bool) -> str:
    """Format a table with a row per method and, side by side, the paper's columns for each part of the split.

    The joint angle error is that of the paper's own evaluation, over hips and shoulders: `sip_error_deg`.
    """
    columns = ["μ_ang, deg", "σ_ang, deg"] + (["μ_pos, cm", "σ_pos, cm"] if positions else [])
    keys = ["sip_error_deg"] + (["position_error_cm"] if positions else [])
    head = [["", *(part if i == 0 else "" for part in tables for i in range(len(columns)))]]
    head.append(["", *columns * len(tables)])
    names = list(next(iter(tables.values())))
    rows = [
        [
            name,
            *(
                f"{number:.2f}"
                for table in tables.values()
                for key in keys
                for number in table[name][key][:2]
            ),
        ]
        for name in names
    ]
    widths = [max(map(len, column)) for column in zip(*head[1:], *rows, strict=True)]
    # A part's name may run into the empty columns to its right.
    lines = ["".join(cell.ljust(width + 2) for cell, width in zip(head[0], widths, strict=True))]
    for name, *cells in [head[1], *rows]:
        padded = (cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True))
        lines.append("  ".join([name.ljust(widths[0]), *padded]))
    frames = ", ".join(f"{part} {table[names[0]]['sip_error_deg'].frames}" for part, table in tables.items())
    lines.append(f"μ mean, σ deviation; ang: SIP error, hips and shoulders; frames: {frames}")
    return "\n".join(line.rstrip() for line in lines)
