"""Write the tables of the documentation that are made from the code.

python tools/make_tables.py
python tools/make_tables.py --measure

A table stands between two comments, `table NAME: made by tools/make_tables.py` and `end of table`. Those of
measures stay as they are without --measure, which runs the shipped models on the recordings of real wearers.
"""

from __future__ import annotations

import inspect
import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path

from edgepose.analysis.metrics import Metric
from firmware_protocols.base import Protocol
from firmware_protocols.registry import BUILT_IN, PROTOCOLS

ROOT = Path(__file__).parents[1]
PAGES = ("README.md", "docs/guide/sensors.md", "docs/reference/models.md", "docs/research/training.md")

_BLOCK = re.compile(
    r"(<!-- table (\w+): made by tools/make_tables\.py -->\n).*?(<!-- end of table -->)", re.DOTALL
)


def protocols() -> str:
    """Return the table of wire formats, for a page in docs/guide."""
    head = ("sensors", "`--protocol`", "line", "baud or bit rate", "first id", "set the device to send")
    return _table([head, *(_row(PROTOCOLS[name]) for name in BUILT_IN)])


def _row(protocol: Protocol) -> Sequence[str]:
    page = f"../../firmware_protocols/docs/{protocol.page or protocol.name}.md".replace("docs/../", "")
    return (
        protocol.description,
        f"[`{protocol.name}`]({page})",
        {"bytes": "serial", "can": "CAN", "udp": "UDP", "hid": "USB HID"}[protocol.transport],
        str(protocol.default_bitrate or "-"),
        _first_id(protocol),
        protocol.setup or "-",
    )


def _first_id(protocol: Protocol) -> str:
    if not protocol.ids:
        return "-"
    first, second = protocol.ids[:2]
    if second != first + 1:
        return f"{first}, then {second} ..."
    return f"0x{first:X}" if first > 9 else str(first)


def _table(rows: Sequence[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(cell.replace("|", r"\|") for cell in row) + " |" for row in rows]
    return "\n".join([lines[0], "|" + "---|" * len(rows[0]), *lines[1:]]) + "\n"


@cache  # both tables need all of it
def _measured() -> dict[str, dict[str, dict[str, Metric]]]:
    """Return the tables of `edgepose evaluate --real` for all shipped models."""
    from edgepose.inference.archive import bundled_archives
    from edgepose.inference.model import Model
    from edgepose_export.evaluation.real_wearers import measure_models

    models = {f"`{path.stem}`": Model(path.stem) for path in bundled_archives()}
    return measure_models(models)


def settings() -> str:
    """Return the table of a training config's keys, from the docstrings and defaults of its classes."""
    from edgepose_export.networks.shape import NetworkShape
    from edgepose_export.synthesis.augmentation import Augmentation
    from edgepose_export.training.config import CHOICES, TrainConfig, config_values

    values = config_values(TrainConfig())
    rows = [("key", "default", "meaning")]
    for table, kind in (("", TrainConfig), ("network", NetworkShape), ("augmentation", Augmentation)):
        if table:
            rows.append((f"**`[{table}]`**", "", ""))
        defaults = values[table] if table else values
        meanings = _attributes(kind)
        for key in ("kind", "normalisation"):
            if key in meanings:
                meanings[key] = f"{meanings[key].split(',')[0]}: {', '.join(map(json.dumps, CHOICES[key]))}"
        rows += [
            (f"`{key}`", f"`{json.dumps(default)}`", meanings[key])
            for key, default in defaults.items()
            if not isinstance(default, dict)
        ]
        rows += [(f"**`[{key}]`**", "", meanings[key]) for key in ("shares",) if key in defaults]
    return _table(rows)


def _attributes(kind: type) -> dict[str, str]:
    """Return the texts of a docstring's section "Attributes" by name."""
    texts: dict[str, str] = {}
    name = ""
    for line in inspect.getdoc(kind).split("Attributes:\n")[1].splitlines():
        entry = re.match(r"    (\w+): (.*)", line)
        if entry:
            name, texts[entry[1]] = entry[1], entry[2]
        elif line.startswith(" " * 8):
            texts[name] += f" {line.strip()}"
    return texts


def walker() -> str:
    """Return the table of the real walker: errors while walking, and those of the N-pose at both ends."""
    start, walking, end = (table for title, table in _measured().items() if title.startswith("walker"))
    columns = list(next(iter(walking.values())))
    head = ["walking, deg", *columns[:-1], "N-pose, start", "N-pose, end", "jitter, km/s^3"]
    rows = [
        [
            name,
            *(_cell(walking[name][column]) for column in columns[:-1]),
            _cell(start[name][columns[-2]]),
            _cell(end[name][columns[-2]]),
            _cell(walking[name][columns[-1]], 2),
        ]
        for name in walking
    ]
    return _table([head, *rows])


def sitter() -> str:
    """Return the table of the real sitter: thighs from vertical, and strides."""
    thighs, gait = (table for title, table in _measured().items() if title.startswith("sitter"))
    parts = list(next(iter(thighs.values())))
    rows = [
        [
            f"{name}, {side}",
            *(_cell(thighs[f"{name}, {side}"][part]) for part in parts),
            _cell(gait[name][f"{side}, Hz"], 2),
        ]
        for name in gait
        for side in ("left", "right")
    ]
    return _table([["thigh from vertical, deg", *parts, "strides, Hz"], *rows])


def _cell(metric: Metric, digits: int = 1) -> str:
    return f"{metric.mean:.{digits}f} ± {metric.std:.{digits}f}"


TABLES: Mapping[str, Callable[[], str]] = {"protocols": protocols, "settings": settings}
"""Tables that are made from the code."""

MEASURED: Mapping[str, Callable[[], str]] = {"walker": walker, "sitter": sitter}
"""Tables that take seconds, and may differ in the last digit from machine to machine."""


def with_tables(text: str, tables: Mapping[str, Callable[[], str]] = TABLES) -> str:
    """Return a page with its tables of these names made again."""
    return _BLOCK.sub(
        lambda match: match[1] + tables[match[2]]() + match[3] if match[2] in tables else match[0], text
    )


if __name__ == "__main__":
    chosen = {**TABLES, **MEASURED} if "--measure" in sys.argv else TABLES
    for page in PAGES:
        path = ROOT / page
        before = path.read_text(encoding="utf-8")
        after = with_tables(before, chosen)
        path.write_text(after, encoding="utf-8")
        print(f"{page}: {'changed' if after != before else 'up to date'}")
