"""One wearer's pipeline: from samples through calibration and dropout handling to the outputs."""

from __future__ import annotations

import time
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from edgepose.calibration import POSES, Calibration, apply_calibration
from edgepose.calibration.misfit import MisfitDetector
from edgepose.calibration.rezero import HeadingRezero
from edgepose.calibration.sensor_to_segment import added_bones
from edgepose.calibration.slip import Slip
from edgepose.diagnostics.rig_monitor import RigMonitor
from edgepose.errors import EdgeposeError
from edgepose.imu import ImuFrame
from edgepose.inference.engine import EngineInput, EngineOutput, check_finite
from edgepose.orientation.drift import DriftCorrector
from edgepose.orientation.stage import OrientationStage
from edgepose.pipeline.added_sensors import AddedSensorStage
from edgepose.pipeline.dropout import assumed_bones, extrapolate_dropouts
from edgepose.pipeline.dropout_monitor import DropoutMonitor
from edgepose.pipeline.frame_synchronizer import FrameSynchronizer
from edgepose.pipeline.place_stage import PlaceStage
from edgepose.pipeline.pose_resampler import PoseResampler
from edgepose.pipeline.pose_writer import PoseWriter
from edgepose.placements import PLACEMENTS, ROOT
from edgepose.pose import PoseFrame
from edgepose.sinks.base import Sink
from edgepose.sinks.group import SinkGroup
from edgepose.sources import Batch

LATENCIES = 216_000
"""Number of latencies kept, those of the last hour at 60 Hz: a run may last for weeks."""


@dataclass
class RunSummary:
    """Counts of a run.

    Attributes:
        poses: poses written.
        warming_up: poses written before the network's window was full.
        held: poses written in which a sensor's last values were repeated.
        held_by_sensor: frames in which each sensor was held, by name.
        backlog_s: time that the newest batch had waited before it was read, seconds.
        seconds: wall time from the first samples to the end.
        latency_s: time from the arrival of the newest packet here until the newest pose was sent, seconds.
        latencies_s: latencies of the newest LATENCIES poses, in no order, seconds.
        slips: sensors that have turned on their limbs, as far as found.
        distance_m: distance walked, metres, see `PlaceStage`; None if the place is not followed.
        corrections_deg: angles by which headings are turned back at present, degrees, in the order of
            PLACEMENTS; None if drift is not corrected.
        error: the error that ended the run early, if any.
    """

    poses: int = 0
    warming_up: int = 0
    held: int = 0
    held_by_sensor: Counter[str] = field(default_factory=Counter)
    backlog_s: float = 0.0
    seconds: float = 0.0
    latency_s: float = 0.0
    latencies_s: array[float] = field(default_factory=lambda: array("f"), repr=False)
    slips: list[Slip] = field(default_factory=list)
    distance_m: float | None = None
    corrections_deg: list[float] | None = None
    error: EdgeposeError | None = None

    def sent(self, latency_s: float) -> None:
        """Count a pose that was sent with a latency, seconds."""
        self.latency_s = latency_s
        if len(self.latencies_s) < LATENCIES:
            self.latencies_s.append(latency_s)
        else:
            self.latencies_s[self.poses % LATENCIES] = latency_s
        self.poses += 1


def pose_frame(output: EngineOutput, without: Sequence[str] = ()) -> PoseFrame:
    """Return the pose of a frame from the network's output, without translation and contacts.

    Args:
        output: of the network.
        without: sensors that the rig lacks, which do not count as held.

    Raises:
        ModelError: the network has computed NaN or infinity.
    """
    check_finite(output)
    frame: ImuFrame = output.frame
    held = frozenset(compress(PLACEMENTS, frame.held.tolist())).difference(without)
    return PoseFrame(frame.index, frame.time_s, output.rotations, output.std, None, held, output.warming_up)


def orientation_stage(calibration: Calibration) -> OrientationStage:
    """Return the stage that orients a rig's samples as its calibration's were."""
    return OrientationStage(calibration.filter, calibration.north, calibration.names)


class WearerPipeline:
    """One wearer's pipeline from samples to sinks, without the network, which may serve several wearers.

    Attributes:
        summary: counts so far.
        clock: makes frames from samples.
        arrived: arrival of the newest samples, on the clock of `time.perf_counter`.
    """

    def __init__(
        self,
        calibration: Calibration,
        rate: float,
        sinks: list[Sink],
        *,
        grid: bool = False,
        orient: OrientationStage | None = None,
        headings: HeadingRezero | None = None,
        drift_correction: bool = True,
        notify: Callable[[str], None] = lambda text: None,
        on_pose: Callable[[RunSummary], None] = lambda summary: None,
        misfits: MisfitDetector | None = None,
        rig: RigMonitor | None = None,
        warn: Callable[[str], None] = lambda text: None,
        look_ahead_s: float | None = None,
        place: PlaceStage | None = None,
        resampler: PoseResampler | None = None,
    ) -> None:
        """Assemble the stages of a calibrated rig.

        Args:
            calibration: of the wearer; it names the rig's sensors and their filter.
            rate: frames per second.
            sinks: outputs, written in this order.
            grid: see `FrameSynchronizer`.
            orient: adds orientations to raw samples; None for the calibration's filter.
            headings: provides the calibration for each frame; frames without one produce no pose. None
                for those of `calibration`.
            drift_correction: correct the headings of sensors that share no north.
            notify: called with one message per sensor that drops out or comes back.
            on_pose: called after each pose has been written.
            misfits: checks whether the calibration fits the wearer.
            rig: checks the sensors as they measure.
            warn: called with one message per finding of `misfits` and `rig`, and about outputs that fail or
                skip poses.
            look_ahead_s: time by which poses come later than their frames, seconds, if samples come at their
                own pace; see `PoseWriter`.
            place: follows the wearer through the room; None leaves the poses without translation.
            resampler: changes the rate of the poses that are written; None keeps that of the frames.
        """
        added, without = calibration.added.names, calibration.without
        self.summary = RunSummary()
        self.clock = FrameSynchronizer(rate, grid=grid, added=added, without=without)
        self.arrived = self._started = time.perf_counter()
        self._orient = orientation_stage(calibration) if orient is None else orient
        self._headings = HeadingRezero(calibration) if headings is None else headings
        corrects = drift_correction and not calibration.north
        self._drift = DriftCorrector(POSES["straight"], PLACEMENTS, ROOT) if corrects else None
        self._notify = notify
        self._on_pose, self._misfits, self._rig, self._warn = on_pose, misfits, rig, warn
        if misfits is not None:
            self.summary.slips = misfits.slips
        self._sinks = SinkGroup(sinks, warn)
        self._writer, self._place = PoseWriter(self._sinks, look_ahead_s, warn, resampler), place
        self._added, self._without = AddedSensorStage(added) if added else None, without
        self._dropouts = DropoutMonitor(added, without)
        self._reported_unused = 0
        self._source_s = 0.0  # time on the source's clock at 0 of the clock of `arrived`
        self._bones: NDArray[np.float64] | None = None  # those of the previous frame

    def process(self, batch: Batch) -> Iterator[EngineInput]:
        """Yield the network inputs of the frames that are ready after a batch."""
        self.summary.backlog_s = batch.backlog_s
        self.arrived = time.perf_counter() - batch.backlog_s
        arrival_s = batch.now_s + batch.ahead_s
        self._source_s = arrival_s - self.arrived
        if batch.samples:
            self.clock.push(self._orient(batch.samples), arrival_s)
            self._report_unused()
        yield from self._engine_inputs(self.clock.frames(batch.now_s))
        # Poses do not wait for this: every two seconds it takes as long as several of them.
        if self._rig is not None:
            for line in self._rig.add(batch.samples, batch.now_s):
                self._warn(line)

    def next_input_s(self) -> float:
        """Return a time on the clock of `arrived` before which no frame will be ready."""
        return self.clock.next_ready_s() - self._source_s

    def flush(self) -> Iterator[EngineInput]:
        """Yield the network inputs of the last frames."""
        yield from self._engine_inputs(self.clock.flush())
        for line in [] if self._rig is None else self._rig.judge():
            self._warn(line)
        for line in [] if self._misfits is None else self._misfits.at_end():
            self._warn(line)

    def emit(self, outputs: list[EngineOutput], arrived: float) -> None:
        """Write poses whose newest packet arrived at a time on the clock of `time.perf_counter`."""
        summary = self.summary
        for output in outputs:
            frame: ImuFrame = output.frame
            age_s = time.perf_counter() + self._source_s - frame.time_s
            pose = pose_frame(output, self._without)
            if self._added is not None and frame.added is not None:
                pose = self._added.correct(pose, frame.added)
            if self._place is not None:
                pose = self._place.add_to(pose, output)
                summary.distance_m = self._place.distance_m
            self._writer.write(pose, age_s)
            summary.warming_up += output.warming_up
            if pose.held:
                summary.held += 1
                summary.held_by_sensor.update(pose.held)
            summary.sent(time.perf_counter() - arrived)
            self._on_pose(summary)

    @property
    def skipped(self) -> int:
        """Number of poses that were too old for live outputs."""
        return self._writer.skipped

    def end(self, error: EdgeposeError | None = None) -> None:
        """End the run; only the first error is kept."""
        self.summary.error = self.summary.error or error
        self.summary.seconds = time.perf_counter() - self._started

    def close(self) -> None:
        """Close the sinks; the summary gets their errors, unless the run has ended in another one."""
        self._sinks.close()
        if self.summary.error is None or self.summary.error in self._sinks.errors:
            self.summary.error = self._sinks.error

    def _report_unused(self) -> None:
        unused = self.clock.unused
        if len(unused) == self._reported_unused:
            return
        reasons: dict[str, list[str]] = {}
        for name in list(unused)[self._reported_unused :]:
            reasons.setdefault(unused[name], []).append(name)
        self._reported_unused = len(unused)
        for reason, names in reasons.items():
            self._warn(f"warning: samples of {', '.join(names)} are left out: {reason}")

    def _engine_inputs(self, frames: list[ImuFrame]) -> Iterator[EngineInput]:
        for frame in frames:
            for line in self._dropouts.update(frame):
                self._notify(line)
            if self._drift is not None:
                frame = self._drift.correct(frame)
            calibration = self._headings.calibration_for(frame)
            if calibration is not None:
                bones, acceleration = apply_calibration(calibration, frame.orientation, frame.force)
                if self._misfits is not None:
                    for line in self._misfits.update(frame, bones):
                        self._warn(line)
                if self._drift is not None:
                    self._drift.observe(bones, calibration.heading_offset)
                    self.summary.corrections_deg = np.degrees(self._drift.corrections).tolist()
                if self._bones is None and self._without:
                    self._bones = assumed_bones(bones, calibration.missing)
                if self._dropouts.any_held:
                    bones, acceleration = extrapolate_dropouts(bones, acceleration, frame.held, self._bones)
                self._bones = bones
                if frame.added is not None:
                    measured = added_bones(calibration, frame.added.orientation)
                    frame = frame._replace(added=frame.added._replace(bones=measured))
                yield EngineInput(frame, bones.astype(np.float32), acceleration.astype(np.float32))
