"""Runs one wearer's pipeline to the end of its source."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from edgepose.errors import as_edgepose_error
from edgepose.inference.engine import Engine, EngineInput
from edgepose.pipeline.wearer_pipeline import RunSummary, WearerPipeline
from edgepose.sources import Batch


def run(
    pipeline: WearerPipeline,
    source: Iterable[Batch],
    engine: Engine,
    stopped: Callable[[], bool] = lambda: False,
) -> RunSummary:
    """Runs a source to its end, or until `stopped`, and writes every pose to every sink.

    What the source gave before an error or the stop comes out. After an error of a sink nothing more is
    written. An error is kept in the summary for the caller to report.

    Args:
        pipeline: of one wearer.
        source: batches of samples.
        engine: makes poses.
        stopped: asked after each batch whether to end the run. An interrupt would lose the frame under way.
    """

    def bodies() -> Iterator[EngineInput]:
        """All bodies; an error of the source or the clock ends the samples, not the frames made of them."""
        try:
            for batch in source:
                yield from pipeline.process(batch)
                if stopped():
                    break
        except Exception as error:
            pipeline.end(as_edgepose_error(error))
        yield from pipeline.flush()

    try:
        for body in bodies():
            pipeline.emit(engine.push(*body), pipeline.arrived)
        pipeline.emit(engine.finish(), pipeline.arrived)
        pipeline.end()
    except Exception as error:
        pipeline.end(as_edgepose_error(error))
    return pipeline.summary
