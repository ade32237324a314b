"""Several wearers in one loop: separate pipelines whose frames go through the network in batches.

Each turn of the loop polls every source, then runs the network on the next frame of each wearer who has one.
Frames that become ready between two polls share a batch. On a busy machine turns are longer and batches
fuller, so the cost per frame falls as the load rises. No wearer waits for another: a wearer without a frame
is left out of the batch.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import count
from math import ceil
from typing import NamedTuple

from edgepose.errors import as_edgepose_error
from edgepose.inference.engine import EngineInput, EngineOutput, MultiWearerEngine
from edgepose.pipeline.wearer_pipeline import RunSummary, WearerPipeline
from edgepose.sources import Source

POLL_S = 0.004
"""Time between two polls of live sources, seconds; a quarter of a frame."""


READ_TURNS = 4
"""Turns after which a wearer is polled even if no frame can be ready: device clocks need arrivals."""


class _Waiting(NamedTuple):
    engine_input: EngineInput
    arrived: float  # see `WearerPipeline.arrived`


class Wearer:
    """One of several wearers; an error of any kind ends only this wearer's part of the run.

    Attributes:
        pipeline: the wearer's pipeline from samples to outputs.
        waiting: frames that have not been through the network yet.
        ended: no more samples are read.
    """

    def __init__(self, source: Source, pipeline: WearerPipeline, notify: Callable[[str], None]) -> None:
        """Start to iterate over the source.

        Args:
            source: the wearer's source, entered and non-blocking.
            pipeline: the wearer's pipeline from samples to outputs.
            notify: called with a message if an error ends the wearer's part.
        """
        self.pipeline = pipeline
        self.waiting: deque[_Waiting] = deque()
        self.ended = False
        self._source, self._batches, self._notify = source, source.__iter__(), notify
        self._output_failed = False

    def is_due(self, turn: int) -> bool:
        """Return whether to poll in a turn: a frame can be ready, or it is time to read what has come."""
        return turn % READ_TURNS == 0 or time.perf_counter() >= self.pipeline.next_input_s()

    def poll(self) -> None:
        """Process the next batch."""
        try:
            batch = next(self._batches, None)
            if batch is not None:
                self._enqueue(self.pipeline.process(batch))
                return
        except Exception as error:
            self._fail(error)
        self.end()

    def end(self) -> None:
        """Stop reading; queue the last frames of the samples read so far."""
        if self.ended:
            return
        self.ended = True
        try:
            self._batches.close()
            self._enqueue(self.pipeline.flush())
        except Exception as error:
            self._fail(error)

    def write(self, outputs: list[EngineOutput], arrived: float) -> None:
        """Write poses unless an output has failed before."""
        try:
            if not self._output_failed:
                self.pipeline.emit(outputs, arrived)
        except Exception as error:
            self._output_failed = True
            self._fail(error)
            self.end()
            self.waiting.clear()

    def close(self) -> None:
        """Close outputs and source, so that others can use their files, ports and addresses."""
        self.pipeline.close()
        try:
            self._source.__exit__(None, None, None)
        except Exception as error:
            self.pipeline.end(as_edgepose_error(error))

    def _enqueue(self, engine_inputs: Iterable[EngineInput]) -> None:
        self.waiting += (_Waiting(engine_input, self.pipeline.arrived) for engine_input in engine_inputs)

    def _fail(self, error: Exception) -> None:
        reported = as_edgepose_error(error)
        if self.pipeline.summary.error is None:
            self._notify(f"ended: {reported}")
        self.pipeline.end(reported)


def run_together(
    wearers: Sequence[Wearer],
    engine: MultiWearerEngine,
    poll_s: float,
    stopped: Callable[[], bool] = lambda: False,
    on_turn: Callable[[RunSummary], None] = lambda total: None,
) -> None:
    """Run all wearers to their ends, or until `stopped`; the summaries of their pipelines keep the errors.

    A wearer's outputs are closed in a thread of their own as soon as the wearer ends: with an hour of poses
    that takes a while, and must not hold up the others.

    Args:
        wearers: the wearers, in the engine's order.
        engine: turns frames into poses.
        poll_s: time between two polls while no frame waits, seconds; 0 means no pause.
        stopped: called in each turn; true ends the run.
        on_turn: called after each turn with the counts of all wearers together.
    """
    running = dict(enumerate(wearers))
    closings: list[Future[None]] = []
    due_s = time.monotonic()
    with ThreadPoolExecutor() as executor:
        for turn in count():
            if not running:
                break
            if stopped():
                for wearer in running.values():
                    wearer.end()
            for i, wearer in running.items():
                if not wearer.ended and (not poll_s or wearer.is_due(turn + i)):
                    wearer.poll()
            frames = {i: wearer.waiting.popleft() for i, wearer in running.items() if wearer.waiting}
            _step(engine, frames, running)
            for i in [i for i, wearer in running.items() if wearer.ended and not wearer.waiting]:
                wearer = running.pop(i)
                wearer.write(engine.finish(i), wearer.pipeline.arrived)
                wearer.pipeline.end()
                closings.append(executor.submit(wearer.close))
            on_turn(_total([wearer.pipeline.summary for wearer in wearers]))
            if poll_s and not any(wearer.waiting for wearer in running.values()):
                # Polls that are overdue are skipped.
                due_s += poll_s * max(1, ceil((time.monotonic() - due_s) / poll_s))
                time.sleep(max(0.0, due_s - time.monotonic()))
    for closing in closings:
        closing.result()  # raises unexpected exceptions


def _step(engine: MultiWearerEngine, frames: dict[int, _Waiting], wearers: dict[int, Wearer]) -> None:
    """Run the network on one frame of each wearer who has one, and write the poses."""
    for i, outputs in engine.push({i: waiting.engine_input for i, waiting in frames.items()}).items():
        wearers[i].write(outputs, frames[i].arrived)


def _total(summaries: Sequence[RunSummary]) -> RunSummary:
    """Sum the counts that are shown during a run; corrections of headings are those of all sensors."""
    corrections = [angle for summary in summaries for angle in summary.corrections_deg or ()]
    return RunSummary(
        poses=sum(summary.poses for summary in summaries),
        held=sum(summary.held for summary in summaries),
        backlog_s=max(summary.latency_s for summary in summaries),
        corrections_deg=corrections or None,
    )
