"""One wearer's samples through calibration and dropout handling to the outputs, in order."""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from edgepose.calibration import apply_calibration
from edgepose.calibration.misfit import MisfitDetector
from edgepose.calibration.rezero import HeadingRezero
from edgepose.errors import EdgeposeError, as_edgepose_error
from edgepose.imu import ImuFrame, ImuSample
from edgepose.inference.engine import EngineInput, EngineOutput
from edgepose.pipeline.dropout import extrapolate_dropouts
from edgepose.pipeline.dropout_monitor import DropoutMonitor
from edgepose.pipeline.frame_synchronizer import FrameSynchronizer
from edgepose.placements import PLACEMENTS
from edgepose.pose import PoseFrame
from edgepose.sinks.base import Sink
from edgepose.sources import Batch

LATENCIES = 216_000
"""Latencies that are kept: those of the last hour at 60 Hz. A run may last for weeks."""


@dataclass
class RunSummary:
    """Counts of a run.

    Attributes:
        poses: poses written.
        filling: of these, poses made before the network's past was full.
        held: of these, poses in which a sensor's last values were repeated.
        held_by_sensor: frames in which each sensor was held, in the order of PLACEMENTS.
        behind_s: how long the newest batch had waited to be taken.
        seconds: wall time from the first samples to the end.
        late_s: seconds from the arrival of the newest packet here to the newest pose's being sent.
        latencies_s: that of the newest LATENCIES poses, in no order.
        error: what ended the run early, if anything did.
    """

    poses: int = 0
    warming_up: int = 0
    held: int = 0
    held_by_sensor: list[int] = field(default_factory=lambda: [0] * len(PLACEMENTS))
    backlog_s: float = 0.0
    seconds: float = 0.0
    latency_s: float = 0.0
    latencies_s: array[float] = field(default_factory=lambda: array("f"), repr=False)
    error: EdgeposeError | None = None

    def sent(self, late_s: float) -> None:
        """Counts a pose that was sent so late, seconds."""
        self.latency_s = late_s
        if len(self.latencies_s) < LATENCIES:
            self.latencies_s.append(late_s)
        else:
            self.latencies_s[self.poses % LATENCIES] = late_s
        self.poses += 1


def pose_frame(output: EngineOutput) -> PoseFrame:
    """The pose of a frame that went through the network."""
    frame: ImuFrame = output.frame
    held = frozenset(name for name, held in zip(PLACEMENTS, frame.held.tolist(), strict=True) if held)
    return PoseFrame(frame.index, frame.time_s, output.rotations, output.std, None, held, output.warming_up)


class WearerPipeline:
    """One wearer's pipeline from samples to sinks, but for the network, which may serve several wearers.

    Attributes:
        summary: counts so far.
        clock: makes frames.
        arrived: when the samples taken last had arrived, on `time.perf_counter`.
    """

    def __init__(
        self,
        clock: FrameSynchronizer,
        headings: HeadingRezero,
        sinks: list[Sink],
        orient: Callable[[list[ImuSample]], list[ImuSample]] = lambda samples: samples,
        notify: Callable[[str], None] = lambda text: None,
        on_pose: Callable[[RunSummary], None] = lambda summary: None,
        misfits: MisfitDetector | None = None,
        warn: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Nothing has come.

        Args:
            clock: makes frames.
            headings: the calibration of each frame; frames without one give no pose.
            sinks: written in order.
            orient: makes raw samples oriented ones.
            notify: hears of sensors that fall silent and are back.
            on_pose: called after each pose was written.
            misfits: finds out whether the calibration can be the wearer's.
            warn: hears that it cannot.
        """
        self.summary, self.clock = RunSummary(), clock
        self.arrived = self._started = time.perf_counter()
        self._headings, self._sinks, self._orient, self._tell = headings, sinks, orient, notify
        self._on_pose, self._misfits, self._warn = on_pose, misfits, warn
        self._silences = DropoutMonitor()
        self._bones: NDArray[np.float64] | None = None  # of the frame before

    def process(self, batch: Batch) -> Iterator[EngineInput]:
        """Bodies of the frames that are ready after a batch."""
        self.summary.backlog_s = batch.backlog_s
        self.arrived = time.perf_counter() - batch.backlog_s
        if batch.samples:
            self.clock.push(self._orient(batch.samples), batch.now_s)
        return self._bodies(self.clock.frames(batch.now_s))

    def flush(self) -> Iterator[EngineInput]:
        """Bodies of the last frames."""
        yield from self._bodies(self.clock.flush())
        if self._misfits is not None:
            for line in self._misfits.at_end():
                self._warn(line)

    def emit(self, outputs: list[EngineOutput], arrived: float) -> None:
        """Writes poses whose newest packet arrived at a time on `time.perf_counter`."""
        summary = self.summary
        for output in outputs:
            frame: ImuFrame = output.frame
            pose = pose_frame(output)
            for sink in self._sinks:
                sink.write(pose)
            summary.warming_up += output.warming_up
            if frame.held.any():
                summary.held += 1
                for i in np.flatnonzero(frame.held):
                    summary.held_by_sensor[i] += 1
            summary.sent(time.perf_counter() - arrived)
            self._on_pose(summary)

    def end(self, error: EdgeposeError | None = None) -> None:
        """The walk is over, by an error unless there was one before."""
        self.summary.error = self.summary.error or error
        self.summary.seconds = time.perf_counter() - self._started

    def close(self) -> None:
        """Closes the sinks; what goes wrong then ends the pipeline as any error does."""
        for sink in self._sinks:
            try:
                sink.close()
            except Exception as error:
                self.summary.error = self.summary.error or as_edgepose_error(error)

    def _bodies(self, frames: list[ImuFrame]) -> Iterator[EngineInput]:
        for frame in frames:
            for line in self._silences.update(frame):
                self._tell(line)
            calibration = self._headings.calibration_for(frame)
            if calibration is not None:
                bones, acceleration = apply_calibration(calibration, frame.orientation, frame.force)
                if self._misfits is not None:
                    for line in self._misfits.update(frame, bones):
                        self._warn(line)
                bones, acceleration = extrapolate_dropouts(bones, acceleration, frame.held, self._bones)
                self._bones = bones
                yield EngineInput(frame, bones.astype(np.float32), acceleration.astype(np.float32))
