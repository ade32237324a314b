"""Pictures of poses; needs matplotlib, which is imported only when one is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edgepose.errors import EdgeposeError
from edgepose.sinks.output_files import check_output
from edgepose.skeleton import forward_kinematics
from edgepose.utils.durable_files import replace_file
from edgepose.utils.output_targets import is_stream

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

PICTURES = (".png", ".pdf", ".svg")

AZIMUTH = np.deg2rad(25.0)
"""Direction of the viewer: this angle from the figure's front towards its left side."""

# Limbs as chains of joints with their thickness in metres; "left" and "right" as seen by the figure.
LIMBS = (
    ("left", (1, 4, 7, 10), 0.075),
    ("right", (2, 5, 8, 11), 0.075),
    ("left", (16, 18, 20, 22), 0.06),
    ("right", (17, 19, 21, 23), 0.06),
)
TORSO_THICKNESS = 0.065
NECK_THICKNESS = 0.07
RIM = 0.025

# Points other than joints: joint, position in its bone frame, metres.
LEFT_WAIST, RIGHT_WAIST, HEAD_CENTRE, NOSE = range(24, 28)
EXTRA_POINTS = (
    (3, (0.075, 0.02, 0.0)),
    (3, (-0.075, 0.02, 0.0)),
    (15, (0.0, 0.085, 0.02)),
    (15, (0.0, 0.075, 0.1)),
)
TORSO = (16, LEFT_WAIST, 1, 2, RIGHT_WAIST, 17, 12)
HEAD_RADIUS = 0.105

# One hue for the prediction and none for the reference; the sides differ in lightness, which every eye sees.
PREDICTION = {"left": "#56B4E9", "trunk": "#2A6F9E", "right": "#0B3C5D"}
REFERENCE = {"left": "#C9C9C9", "trunk": "#969696", "right": "#6A6A6A"}
INK = "#333333"

WIDTH_IN, DPI = 8.0, 200
"""A strip is 1600 pixels wide."""


class FlatBody(NamedTuple):
    """A body on the picture plane, metres.

    Attributes:
        points: (28, 2) joints and `EXTRA_POINTS`, right and up.
        depths: (28,) distance of each towards the viewer.
    """

    points: Array
    depths: Array


def project(points: ArrayLike, azimuth: float = AZIMUTH) -> tuple[Array, Array]:
    """Project points (..., 3) in T to (..., 2), right and up, and depths (...) towards the viewer.

    The figure faces the viewer, so its left (+X) is at the viewer's right. The viewer stands `azimuth`
    radians from its front towards its left side.
    """
    x, y, z = np.moveaxis(np.asarray(points, float), -1, 0)
    c, s = np.cos(azimuth), np.sin(azimuth)
    return np.stack([c * x - s * z, y], axis=-1), s * x + c * z


def require_matplotlib(what: str) -> None:
    """Raise EdgeposeError unless matplotlib, an optional extra, is installed; `what` names what needs it."""
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError as error:
        raise EdgeposeError(
            f"{what} needs matplotlib: install it with pip install 'edgepose[plot]'"
        ) from error


def check_picture(path: Path, what: str, overwrite: bool = False) -> None:
    """Check before long work that a picture can be written to `path`.

    Raises:
        EdgeposeError: matplotlib is missing, or the kind of picture or the folder is unsuitable.
    """
    require_matplotlib(what)
    if is_stream(path):
        return
    if path.suffix.lower() not in PICTURES:
        raise EdgeposeError(f"{path}: pictures are written as {', '.join(PICTURES)}")
    if not path.resolve().parent.is_dir():
        raise EdgeposeError(f"{path}: no folder {path.parent}; make it first or choose another name")
    check_output(path, "the picture", PICTURES, overwrite)


def save_picture(figure: Figure, path: str | Path, *, overwrite: bool, **options: Any) -> None:
    """Write a figure; on failure the file stays as it was.

    Args:
        figure: to draw.
        path: of the picture; its ending sets the kind (png, svg, pdf), and a device or pipe without one gets
            png.
        overwrite: whether an existing file may be replaced.
        options: of matplotlib's `savefig`.

    Raises:
        EdgeposeError: it cannot be written.
    """
    kind = Path(path).suffix[1:] or "png"

    def write(part: Path) -> None:
        figure.savefig(part, format=kind, **options)

    try:
        replace_file(path, write, "the picture", overwrite=overwrite)
    except ValueError as error:  # an ending that matplotlib does not know
        raise EdgeposeError(f"cannot write the picture {path}: {error}") from error


def skeleton_strip(
    path: str | Path,
    poses: ArrayLike,
    times: ArrayLike,
    offsets: ArrayLike,
    reference: ArrayLike | None = None,
    title: str | None = None,
    notes: Sequence[str] = (),
) -> None:
    """Draw stick figures at K instants side by side, with reference figures in a second row.

    Args:
        path: picture to write; its ending sets the kind (png, svg, pdf).
        poses: (K, 24, 3, 3) local rotations.
        times: (K,) seconds, written below the figures.
        offsets: (24, 3) joint position minus its parent's in the zero pose, metres.
        reference: (K, 24, 3, 3) local rotations of the reference at the same instants.
        title: line above the figures.
        notes: K texts below the times; none by default.

    Raises:
        EdgeposeError: matplotlib is not installed, or the file cannot be written.
    """
    require_matplotlib("drawing poses")
    times = np.asarray(times, float)
    rows = [(flatten(poses, offsets), PREDICTION)]
    if reference is not None:
        rows.append((flatten(reference, offsets), REFERENCE))
    if any(len(figures) != len(times) for figures, _ in rows) or not len(times):
        raise ValueError("poses, times and reference must be for the same instants, at least one")
    labels = [f"{time:.2f} s" for time in times]
    if notes:
        labels = ["\n".join(pair) for pair in zip(labels, notes, strict=True)]
    save_picture(_draw_rows(rows, labels, title), path, overwrite=True, dpi=DPI)


def _draw_rows(
    rows: Sequence[tuple[list[FlatBody], dict[str, str]]], labels: Sequence[str], title: str | None
) -> Figure:
    """Draw rows of figures, each with its colours, above their labels, with a legend and a title."""
    from matplotlib.figure import Figure

    centres, width = _columns([figures for figures, _ in rows])
    height = max(_top(f) for figures, _ in rows for f in figures) + 0.12
    label = 0.24 + 0.2 * max(text.count("\n") for text in labels)  # metres below the last ground line
    title_in, legend_in = 0.3 if title else 0.0, 0.36  # inches above the figures
    head_in = title_in + legend_in
    total = len(rows) * height + label
    # Leave room at the sides of a few figures instead of drawing them huge.
    canvas = max(width, total * WIDTH_IN / (1.8 * len(rows) + 1.2))
    scale = WIDTH_IN / canvas  # inches per metre
    body_in = total * scale
    figure = Figure(figsize=(WIDTH_IN, body_in + head_in), dpi=DPI, facecolor="white")
    axes = figure.add_axes((0.0, 0.0, 1.0, body_in / (body_in + head_in)))
    axes.set_axis_off()
    axes.set_xlim((width - canvas) / 2, (width + canvas) / 2)
    axes.set_ylim(-label - (len(rows) - 1) * height, height)

    for i, (figures, colours) in enumerate(rows):
        ground = -i * height
        axes.plot([0.1, width - 0.1], [ground, ground], color="#DDDDDD", linewidth=1.0, zorder=0)
        for figure_2d, centre in zip(figures, centres, strict=True):
            draw_body(axes, figure_2d, np.array([centre, ground]), colours, 72.0 * scale)
    for centre, text in zip(centres, labels, strict=True):
        y = -(len(rows) - 1) * height - 0.05
        axes.text(centre, y, text, ha="center", va="top", fontsize=8, color=INK)

    inch = 1.0 / (body_in + head_in)  # of the figure's height
    if title:
        figure.text(0.02, 1.0 - 0.6 * title_in * inch, title, ha="left", va="center", fontsize=10, color=INK)
    _legend(figure, 1.0 - (title_in + 0.5 * legend_in) * inch, len(rows) > 1)
    return figure


def flatten(poses: ArrayLike, offsets: ArrayLike, azimuth: float = AZIMUTH) -> list[FlatBody]:
    """Project poses (K, 24, 3, 3) to the picture plane, pelvis at x = 0, lowest point on the ground y = 0."""
    offsets = np.array(offsets, float)
    offsets[0] = 0.0
    rotations, joints = forward_kinematics(poses, offsets)
    extra = [joints[:, j] + rotations[:, j] @ np.array(position) for j, position in EXTRA_POINTS]
    points, depths = project(np.concatenate([joints, np.stack(extra, axis=1)], axis=1), azimuth)
    lowest = np.minimum(points[:, :24, 1].min(axis=1) - 0.03, points[:, HEAD_CENTRE, 1] - HEAD_RADIUS)
    points[..., 1] -= lowest[:, None]
    return [FlatBody(*figure) for figure in zip(points, depths, strict=True)]


def _top(figure: FlatBody) -> float:
    return float(max(figure.points[:24, 1].max(), figure.points[HEAD_CENTRE, 1] + HEAD_RADIUS))


def _columns(rows: list[list[FlatBody]]) -> tuple[list[float], float]:
    """Return the pelvis position of each column, so that figures do not touch, and the width; metres."""
    gap, centres, edge = 0.22, [], 0.0
    for column in zip(*rows, strict=True):
        left = max(0.3, *(-f.points[:, 0].min() for f in column))
        right = max(0.3, *(f.points[:, 0].max() for f in column))
        centres.append(edge + gap / 2 + left)
        edge = centres[-1] + right + gap / 2
    return centres, edge


def draw_body(
    axes: Any, figure: FlatBody, at: Array, colours: dict[str, str], points_per_metre: float
) -> None:
    """Draw one body, moved by `at`, with nearer parts over further ones, each with a white rim."""
    from matplotlib.patches import Circle, Polygon

    points = figure.points + at
    for side, limb, thickness in LIMBS:
        chain = list(limb)
        # Without the shoulder or hip, so that a forearm in front of the chest is drawn in front of it.
        depth = 10.0 + figure.depths[chain[1:]].mean()
        for extra, colour, order in ((RIM, "white", depth), (0.0, colours[side], depth + 1e-3)):
            axes.plot(
                *points[chain].T,
                color=colour,
                linewidth=(thickness + extra) * points_per_metre,
                zorder=order,
                solid_capstyle="round",
                solid_joinstyle="round",
            )

    torso = list(TORSO)
    depth = 10.0 + figure.depths[torso].mean()
    for extra, colour, order in ((RIM, "white", depth), (0.0, colours["trunk"], depth + 1e-3)):
        width = (TORSO_THICKNESS + extra) * points_per_metre
        axes.add_patch(Polygon(points[torso], color=colour, linewidth=width, joinstyle="round", zorder=order))
    neck = [12, 15]
    axes.plot(
        *points[neck].T,
        color=colours["trunk"],
        linewidth=NECK_THICKNESS * points_per_metre,
        zorder=depth + 2e-3,
        solid_capstyle="round",
    )

    depth = 10.0 + figure.depths[HEAD_CENTRE]
    centre = tuple(points[HEAD_CENTRE])
    axes.add_patch(Circle(centre, HEAD_RADIUS + RIM / 2, color="white", linewidth=0, zorder=depth))
    axes.add_patch(Circle(centre, HEAD_RADIUS, color=colours["trunk"], linewidth=0, zorder=depth + 1e-3))
    if figure.depths[NOSE] > figure.depths[HEAD_CENTRE]:  # Else the figure looks away from the viewer.
        axes.add_patch(Circle(tuple(points[NOSE]), 0.022, color="white", linewidth=0, zorder=depth + 2e-3))


def _legend(figure: Any, y: float, with_reference: bool) -> None:
    from matplotlib.lines import Line2D

    entries = [("left limbs", PREDICTION["left"]), ("right limbs", PREDICTION["right"])]
    if with_reference:
        entries = [("predicted: left limbs", PREDICTION["left"]), ("right limbs", PREDICTION["right"])]
        entries += [("reference: left limbs", REFERENCE["left"]), ("right limbs", REFERENCE["right"])]
    handles = [Line2D([], [], color=c, linewidth=4, solid_capstyle="round", label=t) for t, c in entries]
    figure.legend(
        handles=handles, loc="center right", bbox_to_anchor=(0.99, y), ncols=len(handles), frameon=False,
        fontsize=8, labelcolor=INK, handlelength=1.2, columnspacing=1.4,
    )  # fmt: skip
