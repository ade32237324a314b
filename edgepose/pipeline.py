"""Joins the steps of the walk, from samples to poses; the only place that knows them all."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from edgepose.calibration import apply
from edgepose.engine import Engine, EngineOutput
from edgepose.errors import EdgeposeError
from edgepose.imu import ImuFrame, ImuSample
from edgepose.placements import PLACEMENTS
from edgepose.pose import PoseFrame
from edgepose.rezero import Headings
from edgepose.silence import Silences
from edgepose.sinks import Sink
from edgepose.sync import FrameClock

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
        latencies_s: for the newest frames that gave a pose, seconds from the arrival of their newest packet
            here to the pose's being sent.
        error: what ended the run early, if anything did.
    """

    poses: int = 0
    filling: int = 0
    held: int = 0
    held_by_sensor: list[int] = field(default_factory=lambda: [0] * len(PLACEMENTS))
    behind_s: float = 0.0
    seconds: float = 0.0
    latencies_s: deque[float] = field(default_factory=lambda: deque(maxlen=LATENCIES))
    error: EdgeposeError | None = None


def status(frame: ImuFrame, filling: bool) -> str:
    """The `status` of a pose, see `PoseFrame`."""
    parts = []
    if frame.held.any():
        parts.append(
            "held " + " ".join(name for name, held in zip(PLACEMENTS, frame.held, strict=True) if held)
        )
    if filling:
        parts.append("filling window")
    return "; ".join(parts) or "ok"


def run(
    source: Iterable[tuple[float, list[ImuSample]]],
    clock: FrameClock,
    headings: Headings,
    engine: Engine,
    sinks: list[Sink],
    orient: Callable[[list[ImuSample]], list[ImuSample]] = lambda samples: samples,
    tell: Callable[[str], None] = lambda text: None,
    on_pose: Callable[[RunSummary], None] = lambda summary: None,
    stopped: Callable[[], bool] = lambda: False,
    behind_s: Callable[[], float] = lambda: 0.0,
) -> RunSummary:
    """Runs a source to its end, or until `stopped`, and writes every pose to every sink.

    What the source gave before an error or the stop comes out. After an error of a sink nothing more is
    written. An error is kept in the summary for the caller to report.

    Args:
        source: batches (time on the source's clock, samples that came).
        clock: makes frames.
        headings: the calibration of each frame; frames without one give no pose.
        engine: makes poses.
        sinks: written in order.
        orient: makes raw samples oriented ones.
        tell: hears of sensors that fall silent and are back.
        on_pose: called after each pose was written.
        stopped: asked after each batch whether to end the run. An interrupt would lose the frame under way.
        behind_s: how long the newest batch had waited for this function, seconds.
    """
    summary, silences = RunSummary(), Silences()
    started = arrived = time.perf_counter()

    def write(outputs: list[EngineOutput]) -> None:
        for output in outputs:
            frame: ImuFrame = output.tag
            pose = PoseFrame(
                frame.index, frame.time_s, status(frame, output.filling), output.rotations, output.std
            )
            for sink in sinks:
                sink.write(pose)
            summary.poses += 1
            summary.filling += output.filling
            if frame.held.any():
                summary.held += 1
                for i in np.flatnonzero(frame.held):
                    summary.held_by_sensor[i] += 1
            summary.latencies_s.append(time.perf_counter() - arrived)
            on_pose(summary)

    def frames() -> Iterator[ImuFrame]:
        """All frames; an error of the source or the clock ends the samples, not the frames made of them."""
        nonlocal arrived
        try:
            for now_s, samples in source:
                summary.behind_s = behind_s()
                arrived = time.perf_counter() - summary.behind_s
                if samples:
                    clock.push(orient(samples), now_s)
                yield from clock.frames(now_s)
                if stopped():
                    break
        except EdgeposeError as error:
            summary.error = error
        yield from clock.flush()

    try:
        for frame in frames():
            for line in silences.of(frame):
                tell(line)
            calibration = headings.at(frame)
            if calibration is None:
                continue
            orientation, force = apply(calibration, frame.orientation, frame.force)
            write(engine.push(frame, orientation.astype(np.float32), force.astype(np.float32)))
        write(engine.finish())
    except EdgeposeError as error:
        summary.error = summary.error or error
    summary.seconds = time.perf_counter() - started
    return summary
