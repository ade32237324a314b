"""Tables of `edgepose bench`: speeds, and their ratios to those of an earlier report."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from edgepose.errors import EdgeposeError
from edgepose.utils.text_files import read_text

Models = list[dict[str, Any]]
"""The models of a report of `edgepose bench --json`."""


def speed_tables(report: dict[str, Any], budget_us: float) -> str:
    """Return the speeds as Markdown tables."""
    tables = tables_of(report, budget_us).values()
    return "\n\n".join("\n".join(lines) for lines in tables)


def tables_of(report: dict[str, Any], budget_us: float) -> dict[str, list[str]]:
    """Return the lines of each table by its name; `machine` is a line of text.

    Args:
        report: what `edgepose bench --json` prints.
        budget_us: time between two frames, microseconds.
    """
    about, models = report["machine"], report["models"]
    steps = _header(["us a frame", *(model["name"] for model in models)])
    for step in models[0]["steps_us"]:
        steps.append(_row([step, *(f"{model['steps_us'][step]:.0f}" for model in models)]))
    return {
        "machine": [f"{about['processor']}, one core; Python {about['python']}, torch {about['torch']}"],
        "steps": steps,
        "full_speed": _full_speed(models),
        "live": _live(models, budget_us),
        "networks": _networks(models, budget_us),
        "start": _starts(models),
    }


def _full_speed(models: Models) -> list[str]:
    lines = _header(["packets to UDP, full speed", "frames a second", "p50 ms", "p99 ms", "max ms"])
    for model in models:
        speed = model["full_speed"]
        times = (f"{speed[name]:.2f}" for name in ("p50_ms", "p99_ms", "max_ms"))
        lines.append(_row([model["name"], f"{speed['per_s']:.0f}", *times]))
    return lines


def _live(models: Models, budget_us: float) -> list[str]:
    lines = _header(["live run at 60 Hz", "us a pose", "of a core", "waits", "p50 ms", "p99 ms"])
    for model in (model for model in models if model["live"] is not None):
        live = model["live"]
        times = (f"{live[name]:.2f}" for name in ("waits", "p50_ms", "p99_ms"))
        share = f"{100 * live['us'] / budget_us:.1f} %"
        lines.append(_row([model["name"], f"{live['us']:.0f}", share, *times]))
    return lines


def _networks(models: Models, budget_us: float) -> list[str]:
    lines = _header(
        ["model", "way", "weights", "us", "p50", "p99", "max", "frames a second", "of 1/60 s", "times"]
    )
    for row in (row for model in models for row in model["ways"]):
        name = "torch.nn.LSTM, defaults" if row["mode"] == "reference" else row["mode"]
        times = (f"{row[key]:.0f}" for key in ("us", "p50_us", "p99_us", "max_us"))
        share = f"{100 * row['us'] / budget_us:.1f} %"
        speed = f"{1e6 / row['us']:.0f}"
        lines.append(
            _row([row["model"], name, row["precision"], *times, speed, share, f"{row['times']:.1f}"])
        )
    return lines


def _starts(models: Models) -> list[str]:
    lines = _header(["a fresh process", "imports s", "model s", "memory MB"])
    for name, runtime, start in ((m["name"], *item) for m in models for item in m["start"].items()):
        memory = "-" if start["memory_mb"] is None else f"{start['memory_mb']:.0f}"
        imports, load = (f"{start[key]:.2f}" for key in ("imports_s", "load_s"))
        lines.append(_row([f"{name}, {runtime}", imports, load, memory]))
    return lines


Figures = dict[str, float]
"""Costs by name: less is better in all of them."""


def read_report(path: Path) -> dict[str, Figures]:
    """Read what `edgepose bench --json` printed; return the figures of each model.

    Raises:
        EdgeposeError: it cannot be read, or is something else.
    """
    try:
        return {str(model["name"]): _figures(model) for model in json.loads(read_text(path))["models"]}
    except OSError as error:
        raise EdgeposeError(f"{path}: cannot read it: {error.strerror}") from None
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        raise EdgeposeError(f"{path}: not what edgepose bench --json prints") from None


def _figures(model: dict[str, Any]) -> Figures:
    """Return the figures of a model in a report."""
    figures = {f"us a frame, {step}": us for step, us in model["steps_us"].items()}
    live = model.get("live")
    if live is not None:
        figures |= {"us a pose, live run at 60 Hz": live["us"], "p99 ms, live run at 60 Hz": live["p99_ms"]}
    figures |= {f"us a frame, {way['mode']} in {way['precision']}": way["us"] for way in model["ways"]}
    for runtime, start in model["start"].items():
        figures |= {f"{key.replace('_', ' ')}, {runtime}": value for key, value in start.items()}
    return {name: float(value) for name, value in figures.items() if value is not None}


def compared(before: dict[str, Figures], report: dict[str, Any]) -> dict[str, dict[str, list[float]]]:
    """Return by model the figures that are known from before: before, now, and their ratio."""
    result = {}
    for model in report["models"]:
        old = before.get(model["name"], {})
        result[model["name"]] = {
            name: [old[name], now, now / old[name]] for name, now in _figures(model).items() if old.get(name)
        }
    return result


def ratio_table(models: dict[str, dict[str, list[float]]]) -> str:
    """Return the result of `compared` as a Markdown table."""
    lines = _header(["", "before", "now", "ratio"])
    for model, figures in models.items():
        if not figures:
            lines.append(_row([f"{model}: not measured before", "-", "-", "-"]))
        for name, (before, now, ratio) in figures.items():
            lines.append(_row([f"{model}, {name}", f"{before:.4g}", f"{now:.4g}", f"{ratio:.2f}"]))
    return "\n".join(lines)


def _row(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _header(cells: list[str]) -> list[str]:
    return [_row(cells), "|" + "---|" * len(cells)]
