"""Poses at another rate than the network's, as they come."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from edgepose.pose import LONGEST_GAP_S, PoseFrame
from edgepose.rotations import matrix_to_quat, quat_to_matrix, slerp

_SAME = 1e-3  # share of the time between two poses that counts as none


class PoseResampler:
    """Interpolates poses at even times, which coincide with poses where the rates allow.

    Rotations are interpolated on the sphere and positions linearly; everything else is that of the nearest
    pose. An interpolated pose comes with the first pose after it, so it is late by less than one frame.
    """

    def __init__(self, rate: float, input_rate: float) -> None:
        """Start without a pose.

        Args:
            rate: poses per second to return.
            input_rate: poses per second that are added.
        """
        self._rate, self._input_rate = rate, input_rate
        self._before: PoseFrame | None = None
        self._offset_s = 0.0  # of all times from multiples of 1 / rate
        self._tick = 0  # number of the next time
        self._count = 0

    def add(self, pose: PoseFrame) -> list[PoseFrame]:
        """Return the poses at the times up to that of the next pose, numbered from 0."""
        before, self._before = self._before, pose
        if before is None or not 0.0 < pose.time_s - before.time_s <= LONGEST_GAP_S:
            before = pose
            # Wearers on one grid of frames stay on one grid.
            self._offset_s = pose.time_s - round(pose.time_s * self._input_rate) / self._input_rate
            self._tick = int(np.ceil((pose.time_s - self._offset_s) * self._rate - _SAME))
        found = []
        for time_s in self._times(before.time_s, pose.time_s):
            found.append(_between(before, pose, time_s)._replace(index=self._count))
            self._count += 1
        return found

    def _times(self, start_s: float, end_s: float) -> Iterator[float]:
        """Yield the next times, seconds, until the end of the span between two poses."""
        margin_s = _SAME * max(end_s - start_s, 1.0 / self._input_rate)
        while (time_s := self._tick / self._rate + self._offset_s) <= end_s + margin_s:
            yield min(time_s, end_s)
            self._tick += 1


def _between(before: PoseFrame, after: PoseFrame, time_s: float) -> PoseFrame:
    """Return the pose at a time from that of one pose to that of another."""
    span_s = after.time_s - before.time_s
    share = (time_s - before.time_s) / span_s if span_s else 1.0
    if share >= 1.0 - _SAME:
        return after
    if share <= _SAME:
        return before
    quats = slerp(matrix_to_quat(before.rotations), matrix_to_quat(after.rotations), np.array(share))
    translation = after.translation
    if translation is not None and before.translation is not None:
        translation = before.translation + share * (translation - before.translation)
    nearest = before if share < 0.5 else after
    rotations = quat_to_matrix(quats).astype(np.float32)
    return nearest._replace(time_s=time_s, rotations=rotations, translation=translation)
