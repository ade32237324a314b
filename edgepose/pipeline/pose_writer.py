"""Writing of poses to the outputs of a run: all of them to files, only recent ones to live outputs."""

from __future__ import annotations

from collections.abc import Callable
from math import inf

from edgepose.pipeline.pose_resampler import PoseResampler
from edgepose.pose import PoseFrame
from edgepose.sinks.group import SinkGroup

OLD_S = 1.0
"""Age from which a pose is of no use to a live output, seconds, beyond the network's look-ahead."""

QUIET_S = 30.0
"""Least time between two reports of late poses, seconds: a machine at its limit would cause many."""


class PoseWriter:
    """Writes each pose to the sinks.

    After a machine has been busy with something else, a backlog of poses comes all at once. Live outputs skip
    it, so that their receivers see the present again as soon as possible.

    Attributes:
        skipped: poses that live outputs have skipped.
    """

    def __init__(
        self,
        sinks: SinkGroup,
        look_ahead_s: float | None,
        notify: Callable[[str], None],
        resampler: PoseResampler | None = None,
    ) -> None:
        """Store the sinks.

        Args:
            sinks: outputs.
            look_ahead_s: age of each pose on a machine without delay, seconds; None if poses have no age,
                because the samples come from a file as fast as it is read.
            notify: called with a message when live outputs skip poses.
            resampler: changes the rate of the poses; None keeps it.
        """
        self.skipped = 0
        self._sinks = sinks
        self._oldest_s = inf if look_ahead_s is None or not sinks.has_live else OLD_S + look_ahead_s
        self._notify, self._resampler = notify, resampler
        self._reported_s = -inf  # time of the pose at the last report

    def write(self, pose: PoseFrame, age_s: float) -> None:
        """Write a pose that was measured `age_s` ago, seconds.

        Raises:
            EdgeposeError: see `SinkGroup.write`.
        """
        is_old = age_s > self._oldest_s
        if is_old:
            self.skipped += 1
            if pose.time_s - self._reported_s >= QUIET_S:
                self._reported_s = pose.time_s
                self._notify(f"poses are {age_s:.1f} s late; live outputs skip those older than {OLD_S:g} s")
        for each in [pose] if self._resampler is None else self._resampler.add(pose):
            self._sinks.write(each, live=not is_old)
