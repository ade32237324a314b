"""OpenSim outputs: orientations of bodies (.sto) and coordinates of joints (.mot)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edgepose.formats.opensim import BODIES, Coordinates, body_orientations
from edgepose.pose import PoseFrame, pelvis_positions
from edgepose.rotations import matrix_to_quat
from edgepose.sinks.base import Sink, SinkContext
from edgepose.sinks.row_file import COUNT, RowFileSink
from edgepose.sinks.spooled import open_file_sink
from edgepose.skeleton import Body, default_body
from edgepose.utils.output_targets import FileTarget


class _TableSink(RowFileSink):
    """Writes rows of numbers behind the seconds since the first pose."""

    _format: str
    _start_s: float | None = None

    def _table(self, poses: Sequence[PoseFrame], rows: NDArray[np.float64]) -> bytes:
        """Return the lines of poses, given their numbers (T, n)."""
        self._start_s = poses[0].time_s if self._start_s is None else self._start_s
        times = [pose.time_s - self._start_s for pose in poses]
        lines = zip(times, rows.tolist(), strict=True)
        return "".join(self._format % (time_s, *row) for time_s, row in lines).encode()


class StoSink(_TableSink):
    """Writes the orientations of bodies as OpenSense reads them, as of sensors that lie along the bodies."""

    def __init__(self, path: str | Path, rate: float = 60.0, *, overwrite: bool = True) -> None:
        """Open the file and write its start.

        Args:
            path: file to write; it appears with the first poses.
            rate: poses per second.
            overwrite: replace an existing file.

        Raises:
            EdgeposeError: the file cannot be written.
        """
        columns = "\t".join(["time", *(f"{body}_imu" for body in BODIES)])
        head = f"DataRate={rate:.6f}\nDataType=Quaternion\nversion=3\nOpenSimVersion=4.4\nendheader\n"
        self._format = "%.6f" + "\t%.8f,%.8f,%.8f,%.8f" * len(BODIES) + "\n"
        super().__init__(path, "STO", f"{head}{columns}\n", overwrite=overwrite)

    def _lines(self, poses: Sequence[PoseFrame]) -> bytes:
        quats = matrix_to_quat(body_orientations(np.stack([pose.rotations for pose in poses])))
        return self._table(poses, quats.reshape(len(poses), -1))


class MotSink(_TableSink):
    """Writes coordinates of OpenSim's full-body models: angles in degrees, positions in metres."""

    def __init__(
        self,
        path: str | Path,
        body: Body | None = None,
        model: str = "rajagopal",
        *,
        overwrite: bool = True,
    ) -> None:
        """Open the file and write its start.

        Args:
            path: file to write; it appears with the first poses.
            body: the wearer's body; None for the default body.
            model: family of models, a key of `MODELS`.
            overwrite: replace an existing file.

        Raises:
            EdgeposeError: the file cannot be written.
        """
        self._offsets = (body or default_body()).offsets
        self._coordinates = Coordinates(model, self._offsets)
        columns = ["time", *self._coordinates.names]
        self._format = "\t".join(["%.6f"] * len(columns)) + "\n"
        head = (
            f"Coordinates\nversion=1\nnRows={COUNT}\nnColumns={len(columns)}\ninDegrees=yes\nendheader\n"
            + "\t".join(columns)
            + "\n"
        )
        super().__init__(path, "MOT", head, overwrite=overwrite)

    def _lines(self, poses: Sequence[PoseFrame]) -> bytes:
        rotations = np.stack([pose.rotations for pose in poses]).astype(float)
        positions = pelvis_positions(poses, self._offsets)
        return self._table(poses, self._coordinates.add(rotations, positions))


def open_sto_sink(target: str, context: SinkContext) -> Sink:
    """Open a `StoSink`; a device or pipe gets the file once it is complete."""
    return open_file_sink(
        target, lambda path, overwrite: StoSink(path, context.rate, overwrite=overwrite), context
    )


def open_mot_sink(target: FileTarget, context: SinkContext) -> Sink:
    """Open a `MotSink`; a device or pipe gets the file once it is complete."""
    settings = context.body, target.option("model")
    return open_file_sink(
        target.path, lambda path, overwrite: MotSink(path, *settings, overwrite=overwrite), context
    )
