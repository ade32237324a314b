"""A second sequence of poses beside the first: its figure, and the angles between the two."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgepose.analysis.metrics import PREDICTED, angle_errors
from edgepose.pose import PoseSequence
from edgepose.skeleton import JOINTS

Array = NDArray[np.float64]

BESIDE, OVER, HIDDEN = "beside the figure", "over it", "hidden"

BESIDE_M = np.array([-1.0, 0.0, 0.0])
"""From the figure to the reference beside it: to the wearer's right, where no panel covers it, metres."""

SOME = 2000
"""Poses whose mean error is shown for the whole file."""


class Reference:
    """Where the reference is drawn, and how far the poses are from it."""

    def __init__(self, server: Any, poses: PoseSequence, reference: PoseSequence, name: str) -> None:
        """Put the choice on the page of a viser server.

        Args:
            server: the server.
            poses: poses that are shown.
            reference: poses to compare them with.
            name: node of the scene whose children are the reference's.
        """
        self._poses, self._reference = poses, reference
        self._frame = server.scene.add_frame(f"/{name}", show_axes=False)
        self._choice = server.gui.add_dropdown("reference", (BESIDE, OVER, HIDDEN))
        self._choice.on_update(lambda event: self._place())
        self._place()
        some = np.unique(np.linspace(0, len(poses.frames) - 1, SOME).astype(int))
        self._mean_deg = float(self._errors(some)[:, list(PREDICTED)].mean())

    def nearest(self, i: int) -> int:
        """Return the index of the reference pose nearest to pose i, on one clock or from both starts."""
        poses, reference = self._poses, self._reference
        common = reference.time_s[0] <= poses.time_s[-1] and poses.time_s[0] <= reference.time_s[-1]
        start = 0.0 if common else poses.time_s[0] - reference.time_s[0]
        return int(np.abs(reference.time_s - (poses.time_s[i] - start)).argmin())

    def text(self, i: int) -> str:
        """Return Markdown about the angles between pose i and the reference."""
        (errors,) = self._errors(np.array([i]))
        worst = max(PREDICTED, key=lambda joint: errors[joint])
        return (
            f"error **{errors[list(PREDICTED)].mean():.1f}°**, most at {JOINTS[worst].replace('_', ' ')}: "
            f"{errors[worst]:.0f}°; mean of the file {self._mean_deg:.1f}°"
        )

    def _errors(self, chosen: NDArray[np.int_]) -> Array:
        """Return the angles (N, 24) of some poses, degrees."""
        matched = [self.nearest(i) for i in chosen.tolist()]
        return angle_errors(self._poses.rotations[chosen], self._reference.rotations[matched])

    def _place(self) -> None:
        self._frame.visible = self._choice.value != HIDDEN
        self._frame.position = BESIDE_M if self._choice.value == BESIDE else 0.0 * BESIDE_M
