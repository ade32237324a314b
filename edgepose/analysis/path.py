"""The path of a wearer through the room: distance, speed, and a picture from above."""

from __future__ import annotations

import io
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose.analysis.figures import INK, PREDICTION
from edgepose.place import DistanceWalked
from edgepose.pose import CONTACTS, PoseSequence
from edgepose.skeleton import JOINTS, Body, forward_kinematics

Array = NDArray[np.float64]

SMOOTH_S = 0.5
"""Time over which positions are averaged, seconds, so that jitter adds no distance."""

TOUCHING = 0.5
"""Probability of contact above which a foot leaves a print."""

SMALLEST_M = 1.0
"""Smallest width and height of the picture, metres."""


class Path(NamedTuple):
    """A path over level ground.

    Attributes:
        positions: (T, 2) smoothed position of the pelvis, see `seen_from_above`, metres.
        speed: (T,) metres per second.
        distance_m: distance walked, without sway, as a run reports it.
        apart_m: distance from its start to its end.
    """

    positions: Array
    speed: Array
    distance_m: float
    apart_m: float


def path_of(translation: Array, rate: float) -> Path:
    """Return the path for positions of the pelvis (T, 3), metres, at `rate` Hz."""
    from scipy.signal import savgol_filter

    path = seen_from_above(translation)
    width = min(round(SMOOTH_S * rate), len(path)) // 2 * 2 - 1
    if width > 2:
        path = savgol_filter(path, width, polyorder=1, axis=0)
    if len(path) < 2:
        return Path(path, np.zeros(len(path)), 0.0, 0.0)
    speed = np.linalg.norm(np.gradient(path, axis=0), axis=1) * rate
    walked = DistanceWalked()
    for position in translation:
        walked.add(position)
    return Path(path, speed, walked.distance_m, float(np.linalg.norm(path[-1] - path[0])))


def seen_from_above(positions: Array) -> Array:
    """Return positions (..., 3) in T as (..., 2): forward, which is along the page, and to the left."""
    return positions[..., [2, 0]]


def draw_path(poses: PoseSequence, body: Body) -> bytes:
    """Draw the path of the pelvis seen from above, with the prints of the feet, as PNG.

    Args:
        poses: with translation; without contacts there are no prints.
        body: for the positions of the feet.
    """
    from matplotlib.figure import Figure

    assert poses.translation is not None
    figure = Figure(figsize=(9.0, 3.6), dpi=110, facecolor="white", layout="constrained")
    axes: Any = figure.add_subplot()
    if poses.contacts is not None:
        _, joints = forward_kinematics(poses.rotations, body.offsets, poses.translation)
        for side in ("left", "right"):
            touching = poses.contacts[:, CONTACTS.index(f"{side}_ankle")] > TOUCHING
            prints = seen_from_above(joints[touching, JOINTS.index(f"{side}_ankle")])
            axes.plot(
                *prints.T, "o", markersize=3, color=PREDICTION[side], label=f"{side} foot on the ground"
            )
    path = seen_from_above(poses.translation)
    axes.plot(*path.T, color=PREDICTION["trunk"], linewidth=1.2, label="pelvis")
    axes.plot(*path[0], "o", markersize=9, markerfacecolor="white", color=INK, label="start")
    axes.plot(*path[-1], "s", markersize=8, color=INK, label="end")
    middle = (path.min(axis=0) + path.max(axis=0)) / 2.0
    axes.update_datalim([middle - SMALLEST_M / 2.0, middle + SMALLEST_M / 2.0])
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("forward, m", fontsize=9)
    axes.set_ylabel("to the left, m", fontsize=9)
    axes.tick_params(labelsize=8)
    axes.grid(color="#E5E5E5", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(fontsize=8, loc="outside upper right", ncols=5, frameon=False, labelcolor=INK)
    picture = io.BytesIO()
    figure.savefig(picture, format="png")
    return picture.getvalue()
