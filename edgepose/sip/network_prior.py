"""A network's poses with their standard deviations, as the prior of each frame."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.errors import EdgeposeError
from edgepose.placements import PLACEMENTS
from edgepose.sip.measurements import Measurements, orientation_at
from edgepose.skeleton import global_rotations

if TYPE_CHECKING:
    from edgepose.inference.model import Estimate, Model

Array = NDArray[np.float64]

_LEAST_DEVIATION = np.deg2rad(3.5)  # added in squares: networks are too sure of bones that hardly move


class NetworkPrior(NamedTuple):
    """Poses that a network expects at T frames.

    Attributes:
        joints: (J,) joints whose bones it estimates.
        rotations: (T, 24, 3, 3) local rotations, joint 0 relative to T.
        orientation: (T, J, 3, 3) R_TB of the estimated bones.
        precision: (T, J) inverse standard deviation per axis of these orientations, 1/rad.
        place: (T, 10) contacts and velocity, see `edgepose.inference.engine.EngineOutput`; None if the
            network does not estimate them.
    """

    joints: NDArray[np.int_]
    rotations: Array
    orientation: Array
    precision: Array
    place: Array | None

    def part(self, frames: slice) -> NetworkPrior:
        """Return the prior of some frames."""
        place = None if self.place is None else self.place[frames]
        return NetworkPrior(
            self.joints, self.rotations[frames], self.orientation[frames], self.precision[frames], place
        )


def missing_for_network(measurements: Measurements) -> list[str]:
    """Return the placements without a sensor, or whose sensor measures no acceleration."""
    measured = {
        name for name, valid in zip(measurements.names, measurements.valid.T, strict=True) if valid.any()
    }
    # No acceleration counts in a recording of less than three frames.
    present = measured if len(measurements.time_s) > 2 else measurements.names
    return [name for name in PLACEMENTS if name not in present]


def network_prior(model: Model, network_frames: Measurements, time_s: Array) -> NetworkPrior:
    """Run a network over a whole recording.

    Args:
        model: the network.
        network_frames: measurements of at least the six placements at the network's rate.
        time_s: (T,) times at which poses are wanted, on the same clock.

    Raises:
        EdgeposeError: a placement is missing.
        ModelError: the network's poses are not finite.
    """
    missing = [name for name in PLACEMENTS if name not in network_frames.names]
    if missing:
        raise EdgeposeError(f"the network needs all six sensors, but {', '.join(missing)} is missing")
    columns = [network_frames.names.index(name) for name in PLACEMENTS]
    acceleration = network_frames.acceleration[:, columns]
    acceleration[1:] = 0.5 * (acceleration[1:] + acceleration[:-1])  # as `FrameSynchronizer` averages it
    found = model.estimate(network_frames.orientation[:, columns], acceleration)
    rotations, std, place = _resampled(found, network_frames.time_s, time_s)
    joints = np.flatnonzero(std.any(axis=0))
    orientation = global_rotations(rotations)[:, joints]
    # `std` is that of the angle, whose three components have a third of its square each.
    precision = np.sqrt(3.0) / np.hypot(std[:, joints], _LEAST_DEVIATION)
    return NetworkPrior(joints, rotations, orientation, precision, place)


def _resampled(found: Estimate, times: Array, wanted: Array) -> tuple[Array, Array, Array | None]:
    """Return local rotations, standard deviations and place at other times."""
    rotations, std = found.rotations.astype(float), found.std.astype(float)
    place = None if found.place is None else found.place.astype(float)
    if len(times) == len(wanted) and np.allclose(times, wanted, rtol=0.0, atol=1e-6):
        return rotations, std, place

    def interpolated(columns: Array) -> Array:
        return np.stack([np.interp(wanted, times, column) for column in columns.T], axis=1)

    quats = rot.matrix_to_quat(rotations)
    joints = [rot.quat_to_matrix(orientation_at(times, quats[:, j], wanted)) for j in range(quats.shape[1])]
    return np.stack(joints, axis=1), interpolated(std), None if place is None else interpolated(place)
