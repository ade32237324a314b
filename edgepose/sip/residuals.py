"""Residuals of poses against the sensors: a table, advice about sensors that do not fit, and a plot."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from edgepose.analysis.figures import require_matplotlib, save_picture
from edgepose.sip.energy import Costs
from edgepose.sip.measurements import Measurements
from edgepose.sip.solve import Solution

ORIENTATION_LIMIT_DEG = 12.0
"""RMS of the orientation residual above which a sensor does not fit; 3 to 7 is usual."""

ACCELERATION_LIMIT = 2.5
"""RMS of the acceleration residual above which a sensor does not fit, m/s^2; 0.2 to 1 is usual."""


def concatenate(solutions: Sequence[Solution]) -> Solution:
    """Join consecutive solutions."""
    arrays = {
        name: np.concatenate([getattr(s, name) for s in solutions])
        for name in Solution._fields
        if name != "evaluations"
    }
    return Solution(**arrays, evaluations=sum(s.evaluations for s in solutions))


def table(solution: Solution, measurements: Measurements) -> str:
    """Format the cost per frame by term, and the residuals by sensor."""
    costs = dict(zip(Costs._fields, solution.costs.mean(axis=0), strict=True))
    lines = [
        "cost a frame  "
        + ", ".join(f"{name} {cost:.4g}" for name, cost in costs.items())
        + f", sum {sum(costs.values()):.4g}",
        "sensor            orientation deg  acceleration m/s^2  held",
    ]
    frames = len(solution.rotations)
    for i, (name, angle, acceleration) in enumerate(_residuals(solution, measurements)):
        held = int(measurements.held[:frames, i].sum())
        lines.append(f"{name:18}{angle:15.2f}{acceleration:20.2f}{held:6d}")
    return "\n".join(lines)


def values(solution: Solution, measurements: Measurements) -> dict[str, Any]:
    """Return the same for scripts; docs/reference/scripts.md describes the keys."""
    frames = len(solution.rotations)
    sensors = [
        {
            "name": name,
            "orientation_deg": angle,
            "acceleration_m_s2": acceleration,
            "held": int(measurements.held[:frames, i].sum()),
        }
        for i, (name, angle, acceleration) in enumerate(_residuals(solution, measurements))
    ]
    return {
        "frames": len(measurements.time_s),
        "poses": frames,
        "evaluations": solution.evaluations,
        "cost_per_frame": dict(zip(Costs._fields, solution.costs.mean(axis=0).tolist(), strict=True)),
        "sensors": sensors,
        "warnings": misfits(solution, measurements),
    }


def misfits(solution: Solution, measurements: Measurements) -> list[str]:
    """Return one line with advice for each sensor that does not fit."""
    return [
        f"{name} does not fit the others ({angle:.0f} deg, {acceleration:.1f} m/s^2 off): "
        "check that it is worn where its name says, and that it has been calibrated since it was put on"
        for name, angle, acceleration in _residuals(solution, measurements)
        if angle > ORIENTATION_LIMIT_DEG or acceleration > ACCELERATION_LIMIT
    ]


def _residuals(solution: Solution, measurements: Measurements) -> list[tuple[str, float, float]]:
    """Return name and RMS residuals of each sensor: orientation in degrees, acceleration in m/s^2."""
    angles = np.degrees(np.sqrt(np.mean(solution.orientation_residual**2, axis=0)))
    valid = measurements.valid[: len(solution.acceleration_residual)]
    accelerations = np.sqrt(
        np.sum(solution.acceleration_residual**2, axis=0) / np.maximum(valid.sum(axis=0), 1)
    )
    return list(zip(measurements.names, angles.tolist(), accelerations.tolist(), strict=True))


def plot(path: str | Path, solution: Solution, measurements: Measurements, overwrite: bool = True) -> None:
    """Plot the cost by term and the residuals by sensor over time.

    Raises:
        EdgeposeError: matplotlib is not installed, or the file cannot be written.
    """
    require_matplotlib("--plot")
    from matplotlib.figure import Figure

    times = measurements.time_s[: len(solution.rotations)]
    figure = Figure(figsize=(9.0, 7.0), dpi=130, layout="constrained")
    costs, angles, accelerations = figure.subplots(3, 1, sharex=True)
    for name, cost in zip(Costs._fields, solution.costs.T, strict=True):
        costs.semilogy(times, np.maximum(cost, 1e-8), linewidth=0.8, label=name)
    for i, name in enumerate(measurements.names):
        angles.plot(times, np.degrees(solution.orientation_residual[:, i]), linewidth=0.8, label=name)
        accelerations.plot(times, solution.acceleration_residual[:, i], linewidth=0.8)
    costs.set_ylabel("cost of a frame")
    angles.set_ylabel("orientation residual, deg")
    accelerations.set_ylabel("acceleration residual, m/s²")
    accelerations.set_xlabel("time, s")
    for axes in (costs, angles):
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=7, frameon=False)
    save_picture(figure, path, overwrite=overwrite)
