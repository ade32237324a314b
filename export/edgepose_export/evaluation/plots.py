"""Plots of evaluations, including DIP's figures 5 and 6; they need matplotlib."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from edgepose.analysis.figures import require_matplotlib, save_picture
from edgepose.errors import EdgeposeError
from edgepose.utils.durable_files import reason

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from edgepose_export.evaluation.paths import Path as Walked
    from edgepose_export.evaluation.real_paths import RealPath
    from edgepose_export.evaluation.uncertainty import Reliability

Array = NDArray[np.float64]

PANEL_IN, DPI = 4.5, 150
MOST_DEG = 60
"""Larger errors are counted in the last bin of a histogram."""

PATH_FRAMES = 900
"""Frames of a path that are drawn; longer ones are tangles."""


def histogram(path: Path, parts: Mapping[str, Mapping[str, Array]], overwrite: bool = True) -> None:
    """Draw the distribution of errors, as DIP's figure 5.

    Args:
        path: picture to write.
        parts: errors (N,), deg, by part of the split and by method.
        overwrite: whether an existing file may be replaced.
    """
    figure, axes = _panels(list(parts))
    edges = np.arange(MOST_DEG + 1)
    for ax, methods in zip(axes, parts.values(), strict=True):
        for name, errors in methods.items():
            share = 100.0 * np.histogram(errors.clip(0, MOST_DEG), edges)[0] / len(errors)
            ax.stairs(share, edges, label=name)
        label = f"SIP error, deg (last bin: all above {MOST_DEG - 1})"
        ax.set(xlabel=label, ylabel="frames, %", xlim=(0, MOST_DEG), ylim=(0, None))
    _legend(figure, axes)
    _save(figure, path, overwrite)


def heat_map(
    path: Path, parts: Mapping[str, Array], past: list[int], future: list[int], overwrite: bool = True
) -> None:
    """Draw mean errors against past and future frames, as DIP's figure 6.

    Args:
        path: picture to write.
        parts: mean errors (len(future), len(past)), deg, by part of the split.
        past: numbers of past frames, in ascending order.
        future: numbers of future frames, in ascending order.
        overwrite: whether an existing file may be replaced.
    """
    figure, axes = _panels(list(parts))
    for ax, means in zip(axes, parts.values(), strict=True):
        image = ax.imshow(means, origin="lower", cmap="viridis_r", aspect="auto")
        ax.set_xticks(range(len(past)), past)
        ax.set_yticks(range(len(future)), future)
        ax.set(xlabel="past frames", ylabel="future frames")
        middle = (means.min() + means.max()) / 2
        for (row, column), value in np.ndenumerate(means):
            ink = "white" if value > middle else "black"
            ax.text(column, row, f"{value:.1f}", ha="center", va="center", color=ink, fontsize="small")
        figure.colorbar(image, ax=ax, label="SIP error, deg")
    _save(figure, path, overwrite)


def reliability_plot(
    path: Path, parts: Mapping[str, Mapping[str, Reliability]], overwrite: bool = True
) -> None:
    """Draw actual against predicted errors in quantiles of the predicted ones, for each part and method."""
    figure, axes = _panels(list(parts))
    for ax, methods in zip(axes, parts.values(), strict=True):
        most = 0.0
        for name, result in methods.items():
            ax.plot(result.predicted_deg, result.actual_deg, "o-", label=name)
            most = max(most, *result.predicted_deg, *result.actual_deg)
        ax.plot([0, most], [0, most], color="0.6", linestyle="--", label="as predicted")
        ax.set(xlabel="predicted standard deviation, deg", ylabel="actual RMS error, deg")
    _legend(figure, axes)
    _save(figure, path, overwrite)


def path_plot(path: Path, parts: Mapping[str, Sequence[Walked]], row: str, overwrite: bool = True) -> None:
    """Draw the starts of paths from above, one panel for each part: true ones in grey, estimates in colour.

    Args:
        path: picture to write.
        parts: paths by part of the split.
        row: the estimate to draw.
        overwrite: whether an existing file may be replaced.
    """
    figure, axes = _panels(list(parts))
    for ax, paths in zip(axes, parts.values(), strict=True):
        for i, walked in enumerate(paths):
            true, estimate = (each[:PATH_FRAMES] - each[0] for each in (walked.true, walked.estimates[row]))
            # The wearer's left is at the left of a wearer who walks up the page.
            ax.plot(-true[:, 0], true[:, 2], color="0.6", linewidth=3, label="true" if i == 0 else None)
            ax.plot(-estimate[:, 0], estimate[:, 2], linewidth=1.2, label="estimated" if i == 0 else None)
        ax.set(xlabel="to the right, m", ylabel="ahead, m", aspect="equal")
        ax.set_adjustable("datalim")
    _legend(figure, axes)
    _save(figure, path, overwrite)


def real_path_plot(
    path: Path, models: Mapping[str, tuple[RealPath, RealPath]], overwrite: bool = True
) -> None:
    """Draw the walker's path, seen from above, and heights of the sitter's pelvis and feet over time."""
    figure, (above, side) = _panels(["walker, from above", "sitter, heights"])
    for i, (name, (walker, sitter)) in enumerate(models.items()):
        ink = f"C{i}"
        above.plot(-walker.pelvis[:, 0], walker.pelvis[:, 2], color=ink, label=name)
        side.plot(sitter.wearer.time_s, sitter.pelvis[:, 1], color=ink, label=name)
        side.plot(sitter.wearer.time_s, sitter.feet[:, :, 1], color=ink, linewidth=0.6)
    above.set(xlabel="to the right, m", ylabel="ahead, m", aspect="equal")
    above.set_adjustable("datalim")
    side.set(xlabel="time, s", ylabel="pelvis, and soles (thin), m", ylim=(-0.1, None))
    _legend(figure, [above, side])
    _save(figure, path, overwrite)


def _panels(titles: list[str]) -> tuple[Figure, list[Any]]:
    """Return a figure with one panel per title, side by side."""
    require_matplotlib("drawing")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(PANEL_IN * len(titles) + 0.5, PANEL_IN), layout="constrained")
    axes = list(figure.subplots(1, len(titles), squeeze=False)[0])
    for ax, title in zip(axes, titles, strict=True):
        ax.set_title(title)
    return figure, axes


def _legend(figure: Figure, axes: list[Any]) -> None:
    """Add one legend for all panels, below them."""
    handles, labels = axes[0].get_legend_handles_labels()
    columns = 2 if len(axes) > 1 else 1
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, fontsize="small")


def _save(figure: Figure, path: Path, overwrite: bool) -> None:
    try:
        save_picture(figure, path, overwrite=overwrite, dpi=DPI)
    except EdgeposeError as error:
        raise EdgeposeError(f"{path}: cannot be written: {reason(error)}") from error
