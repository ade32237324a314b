"""Poses as comma-separated values, one row a frame. The columns are described in docs/outputs.md."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from edgepose.errors import EdgeposeError
from edgepose.growing_files import FLUSH_S, GrowingFile
from edgepose.pose import PoseFrame
from edgepose.rotations import matrix_to_euler_zxy, matrix_to_quat, matrix_to_rotvec
from edgepose.sinks import Sink
from edgepose.skeleton import JOINTS

FORMS = {
    "axis-angle": ("x", "y", "z"),
    "quat": ("w", "x", "y", "z"),
    "matrix": ("r00", "r01", "r02", "r10", "r11", "r12", "r20", "r21", "r22"),
    "euler": ("rz", "rx", "ry"),
}
"""Column endings of each representation; euler: R = Rz Rx Ry, turns about the axes as they have moved."""


def pose_columns(rotations: str, std: bool, translation: bool = False) -> list[str]:
    """Names of all columns, in order; `rotations` is a key of `FORMS`."""
    names = ["frame", "time_s", "status"] + [f"{joint}_{end}" for joint in JOINTS for end in FORMS[rotations]]
    names += [f"{joint}_std" for joint in JOINTS] if std else []
    return names + [f"trans_{axis}" for axis in "xyz"] if translation else names


def _numbers(rotations: str, matrices: NDArray[Any]) -> NDArray[Any]:
    """Rotation matrices (24, 3, 3) in the representation `rotations`, (24, n)."""
    if rotations == "axis-angle":
        return matrix_to_rotvec(matrices)
    if rotations == "quat":
        return matrix_to_quat(matrices)
    if rotations == "euler":
        return matrix_to_euler_zxy(matrices)
    return matrices


class CsvSink(Sink):
    """Writes poses to a file, or to standard output for the path "-".

    Rows to a file are gathered and written about once a second; a pipe or terminal gets each at once, so that
    a program that reads along has no added latency. After an error a file ends at a whole row.
    """

    def __init__(
        self,
        path: str | Path,
        rotations: str = "axis-angle",
        std: bool = False,
        translation: bool = False,
        *,
        overwrite: bool = True,
        follow: bool = True,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        """Open the file and write the header.

        Args:
            path: file to write; "-" is standard output. It appears with the first pose.
            rotations: a key of `FORMS`; angles are in radians.
            std: add the network's standard deviation of each joint, radians.
            translation: add the place of the pelvis, metres, which every pose must then have.
            overwrite: whether it may take the place of a file.
            follow: write to the file at the end of a link; without, in the place of the link.
            stopped: whether the run is to end: then a reader that takes nothing is not waited for.

        Raises:
            EdgeposeError: the file cannot be written.
        """
        if rotations not in FORMS:
            raise EdgeposeError(f"unknown rotations {rotations!r}: choose one of {', '.join(FORMS)}")
        self._rotations, self._std, self._translation = rotations, std, translation
        columns = pose_columns(rotations, std, translation)
        self._format = ",".join(["%d,%.6f,%s"] + ["%.6f"] * (len(columns) - 3)) + "\n"
        self._closed, self._empty = False, True
        self._file = GrowingFile(path, "poses", overwrite=overwrite, follow=follow, stopped=stopped)
        self._rows = [",".join(columns) + "\n"]
        try:
            self._flush()
        except EdgeposeError:
            self.discard()
            raise

    def start(self) -> None:
        """Let the file appear; where one is there already, with the first pose.

        Raises:
            EdgeposeError: another file is there now.
        """
        if not self._file.exists:
            self._file.start()

    def write(self, pose: PoseFrame) -> None:
        """Add a row; a file has it on disk within about a second."""
        if self._empty:
            self._empty = False
            self._file.start()
        numbers = _numbers(self._rotations, pose.rotations).ravel().tolist()
        if self._std:
            numbers += pose.std.tolist()
        if self._translation:
            if pose.translation is None:
                raise ValueError(f"pose {pose.index} has no translation")
            numbers += pose.translation.tolist()
        self._rows.append(self._format % (pose.index, pose.time_s, pose.status, *numbers))
        if not self._file.regular or time.monotonic() - self._flushed >= FLUSH_S:
            self._flush()

    def close(self) -> None:
        """Write what is still held back and close the file; standard output stays open. A file that is there
        already stays if no pose has come."""
        if self._closed:
            return
        self._closed = True
        try:
            self._flush()
        finally:
            self._file.close()

    def discard(self) -> None:
        """As `close`, but without a pose no file appears."""
        if not self._empty:
            self.close()
            return
        self._closed = True
        self._file.discard()

    def _flush(self) -> None:
        rows, self._rows = "".join(self._rows).encode(), []
        self._flushed = time.monotonic()
        if rows:
            self._file.write(rows)
