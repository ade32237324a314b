"""The loop that runs one wearer's pipeline to the end of its source."""

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
    """Run a source to its end, or until `stopped`, and write every pose to every sink.

    Samples that came before the stop or an error of the source are still processed. After an error of a sink
    nothing more is written. The summary keeps an error for the caller to report.

    Args:
        pipeline: the wearer's pipeline.
        source: batches of samples.
        engine: turns frames into poses.
        stopped: called after each batch; true ends the run. An interrupt would lose the frame in progress.
    """

    def engine_inputs() -> Iterator[EngineInput]:
        """Yield all network inputs; after an error of the source or the clock, those before it."""
        try:
            for batch in source:
                yield from pipeline.process(batch)
                if stopped():
                    break
        except Exception as error:
            pipeline.end(as_edgepose_error(error))
        yield from pipeline.flush()

    try:
        for engine_input in engine_inputs():
            pipeline.emit(engine.push(*engine_input), pipeline.arrived)
        pipeline.emit(engine.finish(), pipeline.arrived)
        pipeline.end()
    except Exception as error:
        pipeline.end(as_edgepose_error(error))
    return pipeline.summary
