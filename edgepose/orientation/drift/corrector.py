"""Stage that turns sensors back by the heading errors that have been found.

Assumptions:
- Frames come in order; the vertical of the sensors' inertial frames is their Z.
- A correction changes slowly, so that no limb jumps and the network sees no motion that is none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.imu import ImuFrame
from edgepose.orientation.drift.estimator import DriftEstimator
from edgepose.orientation.drift.evidence import block_of

Array = NDArray[np.float64]

BLOCK_S = 0.5
"""Time over which evidence is collected, seconds."""
FASTEST = math.radians(0.5)
"""Largest rate of a correction, rad/s."""
GAP_S = 2.0
"""After a longer pause between frames, evidence is collected from scratch, seconds."""


class DriftCorrector:
    """Corrects the headings of the frames of one wearer.

    Attributes:
        corrections: (S,) angles by which headings are turned back at present, rad.
    """

    def __init__(self, straight: Array, placements: Sequence[str], root: int) -> None:
        """Start after a calibration.

        Args:
            straight: (S, 3, 3) R_TB in the straight pose.
            placements: names of the sensors.
            root: index of the pelvis.
        """
        self._straight, self._root = straight, root
        self._estimator = DriftEstimator(placements, root)
        self.corrections = np.zeros(len(placements))
        self._target = self.corrections
        self._bias = self._estimator.bias
        self._time_s: float | None = None
        self._frame: ImuFrame | None = None  # as measured, to be observed
        self._frames: list[ImuFrame] = []
        self._bones: list[Array] = []
        self._offset: Array | None = None  # headings of the calibration
        self._reset: Array | None = None  # by a re-zero that goes on

    def correct(self, frame: ImuFrame) -> ImuFrame:
        """Return a frame with corrected headings."""
        passed_s = 0.0 if self._time_s is None else frame.time_s - self._time_s
        if passed_s > GAP_S:
            self._frames, self._bones = [], []
            self._estimator.pass_over(passed_s)
            self._bias = self._estimator.bias
        self._time_s, self._frame = frame.time_s, frame
        self._target = self._target + self._bias * passed_s
        step = FASTEST * min(passed_s, BLOCK_S)
        # After a long pause, a whole turn more or less makes no difference.
        change = np.clip(rot.wrapped(self._target - self.corrections), -step, step)
        still = frame.held | frame.held[self._root]
        self.corrections = self.corrections + np.where(still, 0.0, change)
        return turned_back(frame, self.corrections)

    def observe(self, bones: Array, heading_offset: Array) -> None:
        """Learn from the frame that was corrected last; one without bones need not be observed.

        Args:
            bones: (S, 3, 3) R_TB, after the correction.
            heading_offset: (S,) headings of the calibration that made them, rad; a re-zero changes them.
        """
        before, self._offset = self._offset, heading_offset
        # Mostly they are the same array.
        turned = None if before is None or before is heading_offset else heading_offset - before
        assert self._frame is not None, "a frame is corrected before its bones are observed"
        self._frames.append(self._frame)
        self._bones.append(bones)
        if turned is not None and turned.any():
            self._reset = turned if self._reset is None else self._reset + turned
            self._keep_last()
        elif self._reset is not None:
            self._take_rezero(self._reset)
        elif self._frames[-1].time_s - self._frames[0].time_s >= BLOCK_S - 1e-6:
            self._take_block()

    def _keep_last(self) -> None:
        self._frames, self._bones = self._frames[-1:], self._bones[-1:]

    def _take_block(self) -> None:
        first = self._frames[0]
        block = block_of(
            self._frames[-1].time_s - first.time_s,
            np.stack([frame.orientation for frame in self._frames]),
            np.stack(self._bones[1:]),
            [frame.held for frame in self._frames],
            self._straight,
            self._root,
        )
        measured = block.heading + self.corrections - self.corrections[self._root]
        self._estimator.update(block._replace(heading=measured))
        self._target, self._bias = self._estimator.error, self._estimator.bias
        self._keep_last()

    def _take_rezero(self, turned: Array) -> None:
        """Learn from a re-zero: the headings of the pose were wrong by what it changed, (S,) angles, rad."""
        wrong = self.corrections - turned
        self._estimator.rezero(wrong - wrong[self._root], self.corrections, self._frames[-1].held)
        self._target, self._bias = self.corrections, self._estimator.bias
        self._reset = None
        self._keep_last()


def turned_back(frame: ImuFrame, angles: Array) -> ImuFrame:
    """Return a frame whose sensors are turned about the vertical by the opposite of angles (S,), rad."""
    # Plain floats take half of the time of numpy for a few sensors.
    orientation, force = [], []
    for angle, (w, x, y, z), (ax, ay, az) in zip(
        angles.tolist(), frame.orientation.tolist(), frame.force.tolist(), strict=True
    ):
        c, s = math.cos(0.5 * angle), math.sin(0.5 * angle)
        orientation.append((w * c + z * s, x * c + y * s, y * c - x * s, z * c - w * s))
        c, s = c * c - s * s, 2.0 * c * s
        force.append((ax * c + ay * s, ay * c - ax * s, az))
    return frame._replace(orientation=np.array(orientation), force=np.array(force))
