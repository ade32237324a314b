"""The pipeline of the Python API: a source's samples in, poses out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from edgepose.calibration import Calibration
from edgepose.errors import EdgeposeError
from edgepose.imu import ImuSample
from edgepose.pipeline.place_stage import PlaceStage
from edgepose.pipeline.wearer_pipeline import RunSummary, WearerPipeline
from edgepose.pose import PoseFrame
from edgepose.sinks.base import Sink
from edgepose.skeleton import DEFAULT_HEIGHT, default_body
from edgepose.sources import Batch

if TYPE_CHECKING:
    from edgepose.inference.model import Model


class _PoseBuffer(Sink):
    """Keeps poses until they are taken."""

    def __init__(self) -> None:
        self._poses: list[PoseFrame] = []

    def write(self, pose: PoseFrame) -> None:
        self._poses.append(pose)

    def close(self) -> None:
        """Nothing is open."""

    def take(self) -> list[PoseFrame]:
        poses, self._poses = self._poses, []
        return poses


class Pipeline:
    """Turns the samples of one wearer into poses.

    Attributes:
        summary: counts so far.
    """

    def __init__(
        self,
        calibration: Calibration,
        model: str | Path | Model = "birnn",
        *,
        trust: bool = False,
        height: float | None = None,
        leg_length: float | None = None,
        place: bool = True,
        drift_correction: bool = True,
    ) -> None:
        """Load the model.

        Args:
            calibration: the wearer's calibration; it names the orientation filter to use.
            model: name of a bundled model, path of an archive, or a loaded model.
            trust: load an archive although its checksum is unknown.
            height: the wearer's stature, metres; None for the calibration's, or an average one.
            leg_length: length of the wearer's thigh and shank, hip joint to ankle, metres; None for the
                average at this height.
            place: follow the wearer through the room; otherwise poses have no translation.
            drift_correction: correct the headings of sensors without a common north while they drift.

        Raises:
            ModelError: the archive cannot be loaded.
            EdgeposeError: the height or leg length is impossible.
        """
        from edgepose.inference.model import Model

        self._calibration, self._follow, self._correct_drift = calibration, place, drift_correction
        if height is None:
            height = calibration.height_m or DEFAULT_HEIGHT
        self._body = default_body(height, leg_length_m=leg_length)
        self._model = model if isinstance(model, Model) else Model(model, trust=trust)
        self.summary = RunSummary()

    def poses(self, source: Iterable[Batch | tuple[float, list[ImuSample]]]) -> Iterator[PoseFrame]:
        """Yield poses as they become ready, to the end of the source.

        Args:
            source: an entered source of `edgepose.open_source`, or other batches, or pairs (time in seconds
                up to which everything has been delivered, samples).

        Raises:
            EdgeposeError: the source ended in an error; all poses before it have been yielded.
        """
        buffer, engine = _PoseBuffer(), self._model.engine()
        pipeline = WearerPipeline(
            self._calibration,
            self._model.rate_hz,
            [buffer],
            drift_correction=self._correct_drift,
            place=PlaceStage(self._body, without=self._calibration.without) if self._follow else None,
        )
        self.summary = pipeline.summary
        failure: EdgeposeError | None = None
        try:
            for batch in source:
                for engine_input in pipeline.process(Batch(*batch)):
                    pipeline.emit(engine.push(*engine_input), pipeline.arrived)
                yield from buffer.take()
        except EdgeposeError as error:
            failure = error  # raised once all poses before it have been yielded
        for engine_input in pipeline.flush():
            pipeline.emit(engine.push(*engine_input), pipeline.arrived)
        pipeline.emit(engine.finish(), pipeline.arrived)
        pipeline.end(failure)
        yield from buffer.take()
        if failure is not None:
            raise failure
