"""Models as objects: poses from arrays, without a run."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edgepose.errors import ModelError
from edgepose.inference import archive
from edgepose.inference.engine import FRAMES_PER_STEP, Engine, StreamEngine, check_finite
from edgepose.inference.loading import load

_log = logging.getLogger(__name__)


class Estimate(NamedTuple):
    """A network's results for the T frames of a whole recording.

    Attributes:
        rotations: (T, 24, 3, 3) local rotations, joint 0 relative to the body frame.
        std: (T, 24) standard deviations of the joints it estimates, radians; 0 for the others.
        place: (T, 10) contacts and velocity, see `EngineOutput.place`; None if the archive has none.
    """

    rotations: NDArray[np.float32]
    std: NDArray[np.float32]
    place: NDArray[np.float32] | None


class Model:
    """A loaded model archive.

    Attributes:
        metadata: the archive's own description.
        rate_hz: frame rate for which the model was trained, frames per second.
        past: frames in a bidirectional model's window before the present one.
        future: frames after the present one that the model waits for; 0 for a unidirectional model.
        precision: precision of the weights at run time.
        runtime: what runs the network, "torch" or "numpy".
        has_place: whether the model estimates contacts and the velocity of the pelvis, see
            `edgepose.inference.engine.EngineOutput`.
    """

    def __init__(
        self, name: str | Path, *, trust: bool = False, precision: str = "auto", runtime: str = "auto"
    ) -> None:
        """Load an archive.

        Args:
            name: name of a bundled model, or path of an archive.
            trust: load the archive although its checksum is unknown; loading an archive with torch runs its
                code.
            precision: precision of the weights, "auto", "f32", "fp16" or "int8".
            runtime: "torch", "numpy" (f32 only, runs no code of the archive), or "auto": torch where it is
                installed.

        Raises:
            ModelError: there is no such archive, it is damaged or not trusted, or cannot run here.
        """
        info = archive.read_info(archive.find_archive(str(name)))
        self.metadata: dict[str, Any] = info.metadata
        self.rate_hz = float(info.metadata["rate_hz"])
        self.past, self.future = int(info.metadata["past"]), int(info.metadata["future"])
        self.has_place = archive.has_place(info.metadata)
        self._module, self.runtime, self.precision = load(info, trust, runtime, precision, _log.warning)

    def engine(self, frames_per_step: int = 1) -> Engine:
        """Return a new engine, which makes poses frame by frame and has its own state.

        Args:
            frames_per_step: number of frames computed together; more than one is faster, for recordings.
        """
        many = frames_per_step > 1 and self.precision != "int8" and hasattr(self._module, "stream_many")
        return StreamEngine(
            self._module, self.past, self.future, frames_per_step if many else 1, place=self.has_place
        )

    def poses(self, orientation: ArrayLike, acceleration: ArrayLike) -> NDArray[np.float32]:
        """Estimate the poses of a whole recording (DIP section 3).

        Args:
            orientation: (T, 6, 3, 3) orientations of the segments in the body frame, R_TB, in the order of
                `edgepose.PLACEMENTS`, at `rate_hz`.
            acceleration: (T, 6, 3) accelerations in the body frame without gravity, m/s^2.

        Returns:
            (T, 24, 3, 3) rotations of SMPL's joints, each relative to its parent, the pelvis relative to the
            body frame.

        Raises:
            ModelError: the arrays have other shapes, or numbers in them or in the poses are not finite.
        """
        return self.estimate(orientation, acceleration).rotations

    def estimate(self, orientation: ArrayLike, acceleration: ArrayLike) -> Estimate:
        """Estimate poses, their deviations and the place in a whole recording; see `poses`."""
        bones, force = np.asarray(orientation, np.float32), np.asarray(acceleration, np.float32)
        frames = len(bones)
        if bones.shape != (frames, 6, 3, 3) or force.shape != (frames, 6, 3):
            raise ModelError(
                "orientation must be (T, 6, 3, 3) and acceleration (T, 6, 3), not "
                f"{bones.shape} and {force.shape}"
            )
        if not (np.isfinite(bones).all() and np.isfinite(force).all()):
            raise ModelError("orientation or acceleration has a NaN or an infinite number")
        engine = self.engine(FRAMES_PER_STEP)
        outputs = [each for i in range(frames) for each in engine.push(i, bones[i], force[i])]
        outputs += engine.finish()
        for each in outputs:
            check_finite(each)
        if not outputs:
            return Estimate(np.empty((0, 24, 3, 3), np.float32), np.empty((0, 24), np.float32), None)
        rotations, std = (np.stack(column) for column in zip(*(each[1:3] for each in outputs), strict=True))
        places = [each.place for each in outputs if each.place is not None]
        return Estimate(rotations, std, np.stack(places) if places else None)


def load_model(
    name: str | Path, *, trust: bool = False, precision: str = "auto", runtime: str = "auto"
) -> Model:
    """Load a model archive; see `Model`."""
    return Model(name, trust=trust, precision=precision, runtime=runtime)
