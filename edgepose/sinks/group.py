"""The outputs of one wearer, of which each fails alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from edgepose.errors import EdgeposeError, as_edgepose_error
from edgepose.pose import PoseFrame
from edgepose.sinks.base import Sink


class SinkGroup:
    """Writes poses to several sinks. One that fails is left out from then on; the others get all poses.

    Attributes:
        errors: the first error of each sink that has failed.
    """

    def __init__(self, sinks: Sequence[Sink], notify: Callable[[str], None] = lambda text: None) -> None:
        """Store the sinks.

        Args:
            sinks: open outputs, in the order in which each pose is written to them.
            notify: called with a message when a sink fails while others go on.
        """
        self.errors: list[EdgeposeError] = []
        self._sinks, self._working, self._notify = list(sinks), list(sinks), notify

    @property
    def has_live(self) -> bool:
        """Whether a sink shows poses as they come."""
        return any(sink.live for sink in self._sinks)

    def write(self, pose: PoseFrame, live: bool = True) -> None:
        """Write a pose.

        Args:
            pose: the pose.
            live: write it to live sinks, too.

        Raises:
            EdgeposeError: the last working sink has failed.
        """
        failed = []
        for sink in self._working:
            if live or not sink.live:
                try:
                    sink.write(pose)
                except Exception as error:  # also of sinks of other packages
                    failed.append((sink, as_edgepose_error(error)))
        for sink, reported in failed:
            self._working.remove(sink)
            self.errors.append(reported)
            if not self._working:
                raise reported
            self._notify(f"{reported}; this output has ended, the others go on")

    def close(self) -> None:
        """Close all sinks, also those that have failed; `errors` then has the errors of all."""
        for sink in self._sinks:
            try:
                sink.close()
            except Exception as error:
                if sink in self._working:  # the first error of the others has been reported
                    self._working.remove(sink)
                    self.errors.append(as_edgepose_error(error))

    @property
    def error(self) -> EdgeposeError | None:
        """The errors of all sinks as one; None if there is none."""
        if not self.errors or len(self._sinks) == 1:
            return self.errors[0] if self.errors else None
        texts = dict.fromkeys(map(str, self.errors))
        failed = f"{len(self.errors)} of {len(self._sinks)} outputs failed"
        return EdgeposeError(f"{failed}: {'; '.join(texts)}")
