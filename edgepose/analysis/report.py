"""One-page report on a file of poses: angles over time, ranges of motion, steps, sensors, figures.

The page is a self-contained HTML file. Needs matplotlib, which is imported only when a page is made.
"""

from __future__ import annotations

import base64
import html
import io
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import edgepose
from edgepose.analysis.figures import INK, PREDICTION, require_matplotlib, skeleton_strip
from edgepose.analysis.joint_angles import (
    ANGLES,
    LIMBS,
    WalkingBout,
    held_angles,
    joint_angles,
    walking_bouts,
)
from edgepose.analysis.path import draw_path, path_of, seen_from_above
from edgepose.calibration.slip import Slip, SlipMonitor
from edgepose.placements import BONES
from edgepose.pose import PoseSequence, held_sensors, known_sensors, longest_holds
from edgepose.skeleton import Body, global_rotations
from edgepose.utils.durable_files import write_whole

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

FIGURES = 8
"""Number of instants that are drawn."""

POINTS = 3000
"""Largest number of points of a plotted line; more would not be visible."""

SLIP_RATE = 10.0
"""Poses a second in which slipped sensors are looked for."""

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222; max-width: 60rem; margin: 2rem auto; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.1rem; margin-top: 2rem; }
table { border-collapse: collapse; } th, td { padding: .15rem .8rem .15rem 0; text-align: right; }
th:first-child, td:first-child, td:nth-child(7), th:nth-child(7) { text-align: left; }
.about td { text-align: left; }
th { border-bottom: 1px solid #999; }
img { max-width: 100%; } .note { color: #666; }
"""


def write_report(
    path: Path, poses: PoseSequence, body: Body, name: str, overwrite: bool = True, date: str = ""
) -> None:
    """Write the page.

    Args:
        path: file to write.
        poses: at least one.
        body: for the figures, and for the steps, which are found from the feet.
        name: of the poses, for the heading.
        overwrite: whether an existing file may be replaced.
        date: of the file, for poses that do not say when they were made.

    Raises:
        EdgeposeError: matplotlib is not installed, or the file cannot be written.
    """
    require_matplotlib("a report")
    angles = joint_angles(poses.rotations)
    held = held_angles(held_sensors(poses.held))
    bouts = walking_bouts(poses.rotations, body.offsets, poses.rate)
    times = poses.time_s - poses.time_s[0]
    parts = [
        f"<h1>{html.escape(name)}</h1>",
        f"<p>{len(times)} poses, {times[-1]:.1f} s, {poses.rate:g} a second</p>",
        _origin(poses, name, date),
        _image(_strip(poses, times, body), "Figures at instants of the recording"),
        "<h2>Steps</h2>",
        *_steps(bouts, times, poses),
        *_path(poses, bouts, body),
        "<h2>Angles over time</h2>",
        _image(_plots(times, angles, held, bouts), "Joint angles over time"),
        "<p class='note'>Light: left, dark: right. Grey: walking. Dotted, on hatching: not measured, because "
        "a sensor of the angle sent nothing and its last values were repeated.</p>",
        "<h2>Range of motion</h2>",
        _ranges(angles, held),
        "<h2>Sensors</h2>",
        *_sensors(poses),
        *[
            f"<p>{slip.placement.replace('_', ' ')} has {slip.message}.</p>"
            for slip in find_slips(poses, body)
        ],
    ]
    page = (
        f"<!doctype html><html lang='en'><head><meta charset='utf-8'><title>{html.escape(name)}</title>"
        f"<style>{STYLE}</style></head><body>{chr(10).join(parts)}</body></html>\n"
    )
    write_whole(path, page, "the report", overwrite=overwrite)


def _origin(poses: PoseSequence, name: str, date: str) -> str:
    """Tabulate where the poses come from, as far as the file says."""
    about = poses.about
    rows = [
        ("poses", name),
        ("recording or port", about.get("source", "")),
        ("made", about.get("date", f"{date} (date of the file)" if date else "")),
        ("model", about.get("model", "")),
        ("calibration", about.get("calibration", "")),
        ("made with", f"edgepose {about['edgepose']}" if "edgepose" in about else ""),
        ("report made with", f"edgepose {edgepose.__version__}"),
    ]
    table = _table(("", ""), [(key, html.escape(value)) for key, value in rows if value])
    if not about:
        table += (
            "<p class='note'>Model, calibration and recording are not in this file. The NPZ files of "
            "edgepose run hold them.</p>"
        )
    return table.replace("<table>", "<table class='about'>", 1)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [f"<tr>{''.join(f'<th>{cell}</th>' for cell in head)}</tr>"]
    lines += [f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows]
    return f"<table>{''.join(lines)}</table>"


def _image(png: bytes, about: str) -> str:
    return f"<img alt='{about}' src='data:image/png;base64,{base64.b64encode(png).decode()}'>"


def _strip(poses: PoseSequence, times: Array, body: Body) -> bytes:
    chosen = np.unique(np.linspace(0, len(times) - 1, FIGURES).round().astype(int))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "strip.png"
        notes = ["held" if poses.held[i] else "" for i in chosen]
        shown = notes if any(notes) else []
        skeleton_strip(path, poses.rotations[chosen], times[chosen], body.offsets, notes=shown)
        return path.read_bytes()


def extremes(values: Array) -> NDArray[np.int64]:
    """Return the rows of values (T,) that a plot needs, in order: the minimum and maximum of each bin."""
    if len(values) <= POINTS:
        return np.arange(len(values))
    step = -(-len(values) // (POINTS // 2))
    starts = np.arange(0, len(values), step)
    # The last bin is filled up with the last value.
    bins = np.pad(values, (0, -len(values) % step), mode="edge").reshape(-1, step)
    rows = np.concatenate([starts + bins.argmin(axis=1), starts + bins.argmax(axis=1)])
    return np.unique(np.minimum(rows, len(values) - 1))


def _plots(
    times: Array, angles: dict[str, Array], held: dict[str, Flags], bouts: Sequence[WalkingBout]
) -> bytes:
    """Plot each angle in a panel, left and right together; values that were not measured look different."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 1.35 * len(ANGLES)), dpi=110, facecolor="white", layout="constrained")
    panels: Any = figure.subplots(len(ANGLES), 1, sharex=True)
    for panel, name in zip(panels, ANGLES, strict=True):
        for bout in bouts:
            panel.axvspan(times[bout.frames[0]], times[bout.frames[-1]], color="#EEEEEE", linewidth=0)
        sides = ("left", "right") if name in LIMBS else ("trunk",)
        for side in sides:
            key = f"{side} {name}" if name in LIMBS else name
            shown = extremes(angles[key])
            _plot_line(panel, times[shown], angles[key][shown], held[key][shown], PREDICTION[side])
        panel.set_title(f"{name}, deg", loc="left", fontsize=9, color=INK)
        panel.tick_params(labelsize=8)
        panel.grid(color="#E5E5E5", linewidth=0.6)
        panel.spines[["top", "right"]].set_visible(False)
    panels[-1].set_xlabel("time, s", fontsize=9)
    panels[-1].set_xlim(0.0, max(float(times[-1]), 1e-3))
    picture = io.BytesIO()
    figure.savefig(picture, format="png")
    return picture.getvalue()


def _plot_line(panel: Any, times: Array, values: Array, held: Flags, colour: str) -> None:
    """Plot values (n,), those that are held (n,) dotted on hatching."""
    panel.plot(times, np.where(held, np.nan, values), color=colour, linewidth=1.0)
    if held.any():
        # With its neighbours, so that the line has no gaps.
        near = held | np.roll(held, 1) & (np.arange(len(held)) > 0) | np.roll(held, -1) & (times < times[-1])
        panel.plot(
            times, np.where(near, values, np.nan), color=colour, linewidth=0.8, linestyle=":", alpha=0.6
        )
        panel.fill_between(
            times, 0.0, 1.0, where=near, transform=panel.get_xaxis_transform(), facecolor="none",
            hatch="////", edgecolor="#DDDDDD", linewidth=0.0, zorder=0,
        )  # fmt: skip


def _ranges(angles: dict[str, Array], held: dict[str, Flags]) -> str:
    """Tabulate smallest and largest value, range and mean of each measured angle, without outliers."""
    rows = []
    for name, about in ANGLES.items():
        for key in (f"left {name}", f"right {name}") if name in LIMBS else (name,):
            measured = angles[key][~held[key]]
            numbers = ["-"] * 4
            if len(measured):
                low, high = np.percentile(measured, [0.5, 99.5])
                numbers = [f"{round(value):d}" for value in (low, high, high - low, measured.mean())]
            rows.append((key, *numbers, f"{100 * held[key].mean():.0f} %", about))
    table = _table(("angle, deg", "least", "most", "range", "mean", "not measured", "what it is"), rows)
    note = (
        "Poses in which the angle was not measured are left out, and so are the lowest and the highest 0.5 % "
        "of the others. All angles are 0 when standing straight."
    )
    return f"{table}<p class='note'>{note}</p>"


def _steps(bouts: Sequence[WalkingBout], times: Array, poses: PoseSequence) -> list[str]:
    """Tabulate step count, cadence, and times and lengths of steps over all bouts of walking."""
    if not bouts:
        return ["<p>No walking was found.</p>"]
    step_s = np.concatenate([np.diff(bout.frames) for bout in bouts]) / poses.rate
    # A step of the left foot ends with the left foot in front.
    left = np.concatenate([bout.left[1:] for bout in bouts])
    seconds = sum(times[bout.frames[-1]] - times[bout.frames[0]] for bout in bouts)
    cadence = 60.0 / step_s
    rows = [
        ("steps", f"{sum(len(bout.frames) for bout in bouts)} in {seconds:.0f} s of walking"),
        ("cadence", f"{60.0 / step_s.mean():.0f} steps a minute (deviation {cadence.std():.0f})"),
        ("time of a left step", f"{step_s[left].mean():.2f} s"),
        ("time of a right step", f"{step_s[~left].mean():.2f} s"),
    ]
    if poses.translation is not None:
        moves = [np.diff(seen_from_above(poses.translation[bout.frames]), axis=0) for bout in bouts]
        step_m = np.linalg.norm(np.concatenate(moves), axis=1)
        rows += [
            ("length of a left step", f"{step_m[left].mean():.2f} m"),
            ("length of a right step", f"{step_m[~left].mean():.2f} m"),
        ]
    return [_table(("walking", ""), rows)]


def _path(poses: PoseSequence, bouts: Sequence[WalkingBout], body: Body) -> list[str]:
    """Tabulate and draw the path; empty if the translation is unknown."""
    if poses.translation is None:
        return []
    path = path_of(poses.translation, poses.rate)
    walking = [path.speed[bout.frames[0] : bout.frames[-1] + 1] for bout in bouts]
    low, high = poses.translation[:, 1].min(), poses.translation[:, 1].max()
    rows = [
        ("length", f"{path.distance_m:.1f} m"),
        ("from start to end", f"{path.apart_m:.1f} m"),
        *([("speed of walking", f"{np.concatenate(walking).mean():.2f} m/s")] if bouts else []),
        ("highest speed", f"{path.speed.max():.2f} m/s"),
        ("height of the pelvis", f"{low:.2f} to {high:.2f} m"),
    ]
    note = (
        "Speeds are those of the path averaged over half a second. As in a run, steps of less than 25 cm do "
        "not count for the length."
    )
    return [
        "<h2>Path</h2>",
        _table(("path of the pelvis", ""), rows),
        _image(draw_path(poses, body), "Path seen from above"),
        f"<p class='note'>{note}</p>",
    ]


def find_slips(poses: PoseSequence, body: Body) -> list[Slip]:
    """Return the sensors that seem to have turned on their limbs."""
    rows = np.arange(0, len(poses.rotations), max(1, round(poses.rate / SLIP_RATE)))
    rows = rows[~held_sensors([poses.held[row] for row in rows]).any(axis=1)]
    bones = global_rotations(poses.rotations[rows])[:, list(BONES)]
    monitor = SlipMonitor(north=False, without=poses.about.get("without", "").split(", "))
    return [
        slip
        for time_s, instant in zip(poses.time_s[rows].tolist(), bones, strict=True)
        for slip in monitor.update(time_s, instant)
    ]


def _sensors(poses: PoseSequence) -> list[str]:
    """Tabulate how often each sensor's last values were repeated."""
    names, rate = known_sensors(poses.held), poses.rate
    held = held_sensors(poses.held, names)
    rows = [
        (name.replace("_", " "), str(column.sum()), f"{100 * column.mean():.1f} %", f"{longest / rate:.2f} s")
        for name, column, longest in zip(names, held.T, longest_holds(held), strict=True)
    ]
    filling = sum(poses.warming_up)
    result = [_table(("sensor", "poses with repeated values", "of all", "longest"), rows)]
    if filling:
        result.append(f"<p class='note'>In {filling} poses the window was filling.</p>")
    return result
