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

from edgepose.errors import as_told
from edgepose.inference.engine import BatchEngine, Body, EngineOutput
from edgepose.pipeline.run import RunSummary, Walk
from edgepose.sources import Source

LOOK_S = 0.004
"""Time between two looks at sources that come at their own pace, seconds; a quarter of a frame."""


class _Waiting(NamedTuple):
    body: Body
    arrived: float  # see `Walk.arrived`


class Wearer:
    """One of several wearers; an error of any kind ends only their part.

    Attributes:
        walk: from the wearer's samples to the outputs.
        waiting: frames that have not been through the network.
        ended: no more samples are taken.
    """

    def __init__(self, source: Source, walk: Walk, tell: Callable[[str], None]) -> None:
        """Nothing has come.

        Args:
            source: entered, and not one that waits.
            walk: from the wearer's samples to the outputs.
            tell: hears of an error.
        """
        self.walk = walk
        self.waiting: deque[_Waiting] = deque()
        self.ended = False
        self._source, self._batches, self._tell = source, source.__iter__(), tell
        self._spoilt = False  # an output can take no more

    def look(self) -> None:
        """Takes the next batch."""
        try:
            batch = next(self._batches, None)
            if batch is not None:
                self._put(self.walk.take(batch))
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
            self._put(self.walk.flush())
        except Exception as error:
            self._fail(error)

    def write(self, outputs: list[EngineOutput], arrived: float) -> None:
        """Writes poses unless an output has failed before."""
        try:
            if not self._spoilt:
                self.walk.write(outputs, arrived)
        except Exception as error:
            self._spoilt = True
            self._fail(error)
            self.end()
            self.waiting.clear()

    def close(self) -> None:
        """Closes outputs and source: what they were open on is free for others."""
        self.walk.close()
        try:
            self._source.__exit__(None, None, None)
        except Exception as error:
            self.walk.end(as_told(error))

    def _put(self, bodies: Iterable[Body]) -> None:
        self.waiting += (_Waiting(body, self.walk.arrived) for body in bodies)

    def _fail(self, error: Exception) -> None:
        told = as_told(error)
        if self.walk.summary.error is None:
            self._tell(f"ended: {told}")
        self.walk.end(told)


def run_together(
    wearers: Sequence[Wearer],
    engine: BatchEngine,
    look_s: float,
    stopped: Callable[[], bool] = lambda: False,
    on_turn: Callable[[RunSummary], None] = lambda total: None,
) -> None:
    """Runs all to their ends, or until `stopped`; counts and errors are in the summaries of their walks.

    Outputs are closed as their wearers end: of an hour of poses that takes a while, and holds up nobody.

    Args:
        wearers: numbered as the engine's.
        engine: makes poses.
        look_s: time between two looks while nothing waits, seconds; 0 does not pause.
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
                    wearer.look()
            frames = {i: wearer.waiting.popleft() for i, wearer in going.items() if wearer.waiting}
            _step(engine, frames, going)
            for i in [i for i, wearer in going.items() if wearer.ended and not wearer.waiting]:
                wearer = going.pop(i)
                wearer.write(engine.finish(i), wearer.walk.arrived)
                wearer.walk.end()
                closed.append(closing.submit(wearer.close))
            on_turn(_total([wearer.walk.summary for wearer in wearers]))
            if look_s and not any(wearer.waiting for wearer in going.values()):
                # Looks that are missed are left out.
                due_s += look_s * max(1, ceil((time.monotonic() - due_s) / look_s))
                time.sleep(max(0.0, due_s - time.monotonic()))
    for each in closed:
        each.result()  # raises what was not foreseen


def _step(engine: BatchEngine, frames: dict[int, _Waiting], wearers: dict[int, Wearer]) -> None:
    """One frame of each wearer who has one, to its sinks."""
    for i, outputs in engine.push({i: waiting.body for i, waiting in frames.items()}).items():
        wearers[i].write(outputs, frames[i].arrived)


def _total(summaries: Sequence[RunSummary]) -> RunSummary:
    """What all have done together, as far as it is shown while they go on."""
    return RunSummary(
        poses=sum(summary.poses for summary in summaries),
        held=sum(summary.held for summary in summaries),
        behind_s=max(summary.late_s for summary in summaries),
    )
