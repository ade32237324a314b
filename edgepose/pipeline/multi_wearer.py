"""Several wearers at once: each walks for itself, and the network takes one step for all that have a frame.

A turn looks at every source, then takes the next frame of each wearer that has one through the network.
What becomes ready between two looks goes together, and on a busy machine turns are longer and steps fuller,
so that what a frame costs falls as more is asked for. Nobody waits for anybody: who has no frame has no part
in the step.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from math import ceil
from typing import NamedTuple

from edgepose.errors import as_edgepose_error
from edgepose.inference.engine import EngineInput, EngineOutput, MultiWearerEngine
from edgepose.pipeline.wearer_pipeline import RunSummary, WearerPipeline
from edgepose.sources import Source

POLL_S = 0.004
"""Time between two looks at sources that come at their own pace, seconds; a quarter of a frame."""


class _Waiting(NamedTuple):
    body: EngineInput
    arrived: float  # see `WearerPipeline.arrived`


class Wearer:
    """One of several wearers; an error of any kind ends only their part.

    Attributes:
        pipeline: from the wearer's samples to the outputs.
        waiting: frames that have not been through the network.
        ended: no more samples are taken.
    """

    def __init__(self, source: Source, pipeline: WearerPipeline, notify: Callable[[str], None]) -> None:
        """Nothing has come.

        Args:
            source: entered, and not one that waits.
            pipeline: from the wearer's samples to the outputs.
            notify: hears of an error.
        """
        self.pipeline = pipeline
        self.waiting: deque[_Waiting] = deque()
        self.ended = False
        self._source, self._batches, self._tell = source, source.__iter__(), notify
        self._spoilt = False  # an output can take no more

    def poll(self) -> None:
        """Takes the next batch."""
        try:
            batch = next(self._batches, None)
            if batch is not None:
                self._put(self.pipeline.process(batch))
                return
        except Exception as error:
            self._fail(error)
        self.end()

    def end(self) -> None:
        """Takes no more, but for the last frames of what has come."""
        if self.ended:
            return
        self.ended = True
        try:
            self._batches.close()
            self._put(self.pipeline.flush())
        except Exception as error:
            self._fail(error)

    def write(self, outputs: list[EngineOutput], arrived: float) -> None:
        """Writes poses unless an output has failed before."""
        try:
            if not self._spoilt:
                self.pipeline.emit(outputs, arrived)
        except Exception as error:
            self._spoilt = True
            self._fail(error)
            self.end()
            self.waiting.clear()

    def close(self) -> None:
        """Closes outputs and source: what they were open on is free for others."""
        self.pipeline.close()
        try:
            self._source.__exit__(None, None, None)
        except Exception as error:
            self.pipeline.end(as_edgepose_error(error))

    def _put(self, bodies: Iterable[EngineInput]) -> None:
        self.waiting += (_Waiting(body, self.pipeline.arrived) for body in bodies)

    def _fail(self, error: Exception) -> None:
        told = as_edgepose_error(error)
        if self.pipeline.summary.error is None:
            self._tell(f"ended: {told}")
        self.pipeline.end(told)


def run_together(
    wearers: Sequence[Wearer],
    engine: MultiWearerEngine,
    poll_s: float,
    stopped: Callable[[], bool] = lambda: False,
    on_turn: Callable[[RunSummary], None] = lambda total: None,
) -> None:
    """Runs all to their ends, or until `stopped`; counts and errors are in the summaries of their pipelines.

    Outputs are closed as their wearers end: of an hour of poses that takes a while, and holds up nobody.

    Args:
        wearers: numbered as the engine's.
        engine: makes poses.
        poll_s: time between two looks while nothing waits, seconds; 0 does not pause.
        stopped: asked in each turn whether to end the run.
        on_turn: called after each turn with what all have done together.
    """
    going = dict(enumerate(wearers))
    closed: list[Future[None]] = []
    due_s = time.monotonic()
    with ThreadPoolExecutor() as closing:
        while going:
            if stopped():
                for wearer in going.values():
                    wearer.end()
            for wearer in going.values():
                if not wearer.ended:
                    wearer.poll()
            frames = {i: wearer.waiting.popleft() for i, wearer in going.items() if wearer.waiting}
            _step(engine, frames, going)
            for i in [i for i, wearer in going.items() if wearer.ended and not wearer.waiting]:
                wearer = going.pop(i)
                wearer.write(engine.finish(i), wearer.pipeline.arrived)
                wearer.pipeline.end()
                closed.append(closing.submit(wearer.close))
            on_turn(_total([wearer.pipeline.summary for wearer in wearers]))
            if poll_s and not any(wearer.waiting for wearer in going.values()):
                # Looks that are missed are left out.
                due_s += poll_s * max(1, ceil((time.monotonic() - due_s) / poll_s))
                time.sleep(max(0.0, due_s - time.monotonic()))
    for each in closed:
        each.result()  # raises what was not foreseen


def _step(engine: MultiWearerEngine, frames: dict[int, _Waiting], wearers: dict[int, Wearer]) -> None:
    """One frame of each wearer who has one, to its sinks."""
    for i, outputs in engine.push({i: waiting.body for i, waiting in frames.items()}).items():
        wearers[i].write(outputs, frames[i].arrived)


def _total(summaries: Sequence[RunSummary]) -> RunSummary:
    """What all have done together, as far as it is shown while they go on."""
    return RunSummary(
        poses=sum(summary.poses for summary in summaries),
        held=sum(summary.held for summary in summaries),
        backlog_s=max(summary.latency_s for summary in summaries),
    )
