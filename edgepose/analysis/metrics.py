"""Error metrics of poses against reference poses, as used in the literature.

Every metric has one value per frame, so that a mean can be reported with its deviation and number of frames.
Poses are local rotations (T, 24, 3, 3). "Root-aligned" means that the pelvis of both bodies is at the origin
with the identity as its orientation: the direction a person faces, which the pelvis sensor measures, does not
count.

Sources: DIP is Huang et al., Deep Inertial Poser, 2018; SIP is von Marcard et al., Sparse Inertial Poser,
2017; numbers of equations, tables and sections are those of these papers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edgepose.rotations import geodesic_angle
from edgepose.skeleton import PREDICTED, UNOBSERVED, forward_kinematics

Array = NDArray[np.float64]

SIP_JOINTS = (1, 2, 16, 17)
"""Hips and shoulders: the joints of thighs and upper arms, which carry SIP's four validation sensors."""

LABELS = {
    "sip_error_deg": "SIP error, deg",
    "joint_angle_error_15_deg": "joint angle error, 15 predicted joints, deg",
    "joint_angle_error_10_deg": "joint angle error, 10 joints without a sensor, deg",
    "position_error_cm": "position error, cm",
    "jitter_km_s3": "jitter, km/s^3",
    "jitter_reference_km_s3": "jitter of the reference, km/s^3",
}
"""Labels of the keys of `per_frame` and `summary`."""

HEADINGS = {
    "sip_error_deg": "SIP, deg",
    "joint_angle_error_15_deg": "15 joints, deg",
    "joint_angle_error_10_deg": "10 joints, deg",
    "position_error_cm": "position, cm",
    "jitter_km_s3": "jitter, km/s^3",
    "jitter_reference_km_s3": "reference jitter",
}
"""The same, short enough for a column heading."""


class Metric(NamedTuple):
    """Mean and standard deviation of a metric over a number of frames; NaN if there are none."""

    mean: float
    std: float
    frames: int


def sip_error(predicted: ArrayLike, true: ArrayLike) -> Array:
    """Return the SIP error (T,), degrees: the joint angle error of hips and shoulders.

    SIP eq. 33 without the square. The authors' evaluation of DIP computes the joint angle error over these
    four joints, so this is comparable to the angles in DIP's tables 2 to 5.
    """
    return joint_angle_error(predicted, true, SIP_JOINTS)


def joint_angle_error(predicted: ArrayLike, true: ArrayLike, joints: Sequence[int] = PREDICTED) -> Array:
    """Return the mean geodesic distance (T,), degrees, of the root-aligned global rotations of some joints.

    This is the usual definition; state the joints with each number.

    Args:
        predicted: (T, 24, 3, 3) local rotations.
        true: (T, 24, 3, 3) local rotations.
        joints: the 15 joints that a network predicts, or `UNOBSERVED`, the 10 of them without a sensor.
    """
    return angle_errors(predicted, true)[:, list(joints)].mean(axis=-1)


def angle_errors(predicted: ArrayLike, true: ArrayLike) -> Array:
    """Return the geodesic distances (T, 24), degrees, of the root-aligned global rotations of all joints.

    Args:
        predicted: (T, 24, 3, 3) local rotations.
        true: (T, 24, 3, 3) local rotations.
    """
    predicted, true = _same_shape(predicted, true)
    no_offsets = np.zeros((24, 3))
    rotations, _ = _root_aligned(predicted, no_offsets)
    reference, _ = _root_aligned(true, no_offsets)
    return np.rad2deg(geodesic_angle(rotations, reference))


def position_error(predicted: ArrayLike, true: ArrayLike, offsets: ArrayLike) -> Array:
    """Return the mean distance (T,), cm, of the root-aligned positions of all 24 joints.

    The pelvis, always at the origin, is one of the 24. DIP 5.1; SIP eq. 34 without the square. `offsets`
    (24, 3), metres, is the body for both poses.
    """
    predicted, true = _same_shape(predicted, true)
    _, positions = _root_aligned(predicted, offsets)
    _, reference = _root_aligned(true, offsets)
    return 100.0 * np.linalg.norm(positions - reference, axis=-1).mean(axis=-1)


def jitter(local: ArrayLike, offsets: ArrayLike, rate: float) -> Array:
    """Return the mean norm (T - 3,), km/s^3, of the third time derivative of joint positions.

    This is the usual definition: third differences of consecutive frames at `rate` Hz over dt^3, of all 24
    joints of the body `offsets` (24, 3), metres, with the pelvis fixed in position but not in orientation.
    """
    _, positions = forward_kinematics(local, offsets)
    return np.linalg.norm(np.diff(positions, n=3, axis=0), axis=-1).mean(axis=-1) * rate**3 / 1000.0


def measure(values: ArrayLike) -> Metric:
    """Return mean, deviation and number of per-frame values, of one sequence or of several joined ones."""
    values = np.asarray(values, float)
    if not len(values):
        return Metric(float("nan"), float("nan"), 0)
    return Metric(float(values.mean()), float(values.std()), len(values))


def per_frame(predicted: ArrayLike, true: ArrayLike, offsets: ArrayLike, rate: float) -> dict[str, Array]:
    """Compute all metrics of one sequence, frame by frame: arguments as in `summary`, keys as in `LABELS`."""
    return {
        "sip_error_deg": sip_error(predicted, true),
        "joint_angle_error_15_deg": joint_angle_error(predicted, true, PREDICTED),
        "joint_angle_error_10_deg": joint_angle_error(predicted, true, UNOBSERVED),
        "position_error_cm": position_error(predicted, true, offsets),
        "jitter_km_s3": jitter(predicted, offsets, rate),
        "jitter_reference_km_s3": jitter(true, offsets, rate),
    }


def summary(predicted: ArrayLike, true: ArrayLike, offsets: ArrayLike, rate: float) -> dict[str, Metric]:
    """Compute all metrics of one sequence.

    Args:
        predicted: (T, 24, 3, 3) local rotations.
        true: (T, 24, 3, 3) local rotations at the same instants.
        offsets: (24, 3) joint position minus its parent's in the zero pose, metres.
        rate: frames a second, Hz.

    Returns:
        A `Metric` for each key of `LABELS`.
    """
    return {key: measure(values) for key, values in per_frame(predicted, true, offsets, rate).items()}


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table, its first column aligned to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for name, *cells in rows:
        padded = (cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True))
        lines.append("  ".join([name.ljust(widths[0]), *padded]).rstrip())
    return lines


def format_table(summaries: Mapping[str, Mapping[str, Metric]]) -> str:
    """Format a table with one line per method, one column per metric and "mean ± deviation" in each cell.

    If the methods differ in the number of frames (of the errors), it has its own column; otherwise it is in
    the last line. Jitter has three frames fewer per sequence.

    Args:
        summaries: result of `summary` for each method.
    """
    keys = [key for key in LABELS if any(key in row for row in summaries.values())]
    frames = {name: max((m.frames for m in row.values()), default=0) for name, row in summaries.items()}
    same = len(set(frames.values())) == 1
    table = [["method", *(HEADINGS[key] for key in keys), *([] if same else ["frames"])]]
    for name, row in summaries.items():
        cells = [f"{row[key].mean:.2f} ± {row[key].std:.2f}" if key in row else "-" for key in keys]
        table.append([name, *cells, *([] if same else [str(frames[name])])])
    lines = aligned(table)
    over = f" over {frames.popitem()[1]} frames" if same else ""
    lines.append(f"mean ± deviation{over}; 15 joints: all predicted, 10 joints: those without a sensor")
    return "\n".join(lines)


def _same_shape(predicted: ArrayLike, true: ArrayLike) -> tuple[Array, Array]:
    # Broadcasting one frame against many would return plausible numbers.
    predicted, true = np.asarray(predicted, float), np.asarray(true, float)
    if predicted.shape != true.shape or predicted.shape[1:] != (24, 3, 3):
        raise ValueError(
            f"poses of shapes {predicted.shape} and {true.shape}, expected two equal shapes (T, 24, 3, 3)"
        )
    return predicted, true


def _root_aligned(local: Array, offsets: ArrayLike) -> tuple[Array, Array]:
    """Return global rotations and positions with the pelvis at the origin and the identity orientation."""
    local, offsets = local.copy(), np.array(offsets, float)
    local[:, 0] = np.eye(3)
    offsets[0] = 0.0
    return forward_kinematics(local, offsets)
