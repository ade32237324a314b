"""CSV output: one row per frame. Columns: docs/reference/outputs.md."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from edgepose.errors import EdgeposeError
from edgepose.formats.poses.csv_columns import ROTATION_FORMATS, numbers, pose_columns, rotation_columns
from edgepose.pose import PoseFrame, format_status, place_values
from edgepose.sinks.base import Sink, SinkContext
from edgepose.sinks.pose_file import PoseFileSink
from edgepose.sinks.shared_numbers import rotvec_text
from edgepose.utils.growing_files import GrowingFile
from edgepose.utils.output_targets import FileTarget


class CsvSink(PoseFileSink):
    """Writes poses to a CSV file, or to standard output for the path "-".

    Rows for a file are collected and written about once a second. A pipe or terminal gets each row at once,
    so that there is no added latency for its reader. After an error a file ends with a complete row.
    """

    def __init__(
        self,
        path: str | Path,
        rotations: str = "axis-angle",
        std: bool = False,
        translation: bool = False,
        contacts: bool = False,
        *,
        overwrite: bool = True,
        follow: bool = True,
        stopped: Callable[[], bool] = lambda: False,
        waits: bool = True,
    ) -> None:
        """Open the file and write the header.

        Args:
            path: file to write; "-" is standard output. It appears with the first pose.
            rotations: a key of `ROTATION_FORMATS`; angles are in radians.
            std: add the network's standard deviation of each joint, radians.
            translation: add the position of the pelvis, metres, which every pose must then have.
            contacts: add the probabilities of contact, which every pose must then have.
            overwrite: replace an existing file.
            follow: write to the target of a symbolic link; if false, replace the link.
            stopped: whether the run is to end; a reader that has stopped reading is then not waited for.
            waits: `write` waits for a slow reader of a pipe, which otherwise reads later.

        Raises:
            EdgeposeError: the file cannot be written.
        """
        if rotations not in ROTATION_FORMATS:
            raise EdgeposeError(
                f"unknown rotations {rotations!r}: choose one of {', '.join(ROTATION_FORMATS)}"
            )
        self._rotations, self._std = rotations, std
        self._translation, self._contacts = translation, contacts
        columns = pose_columns(rotations, std, translation, contacts)
        angles = len(rotation_columns(rotations))
        self._rotations_format = ",".join(["%.6f"] * angles)
        others = len(columns) - 3 - angles
        self._format = "%d,%.6f,%s,%s" + ",%.6f" * others + "\n"
        self._rows: list[str] = []
        output = GrowingFile(path, "poses", overwrite=overwrite, follow=follow, stopped=stopped, waits=waits)
        super().__init__(output, (",".join(columns) + "\n").encode())

    def _add(self, pose: PoseFrame) -> bool:
        values = pose.std.tolist() if self._std else []
        values += place_values(pose, self._translation, self._contacts)
        status = format_status(pose.held, pose.warming_up)
        text = self._rotations_text(pose)
        self._rows.append(self._format % (pose.index, pose.time_s, status, text, *values))
        return not self._output.regular

    def _rotations_text(self, pose: PoseFrame) -> str:
        if self._rotations == "axis-angle":
            return rotvec_text(pose)
        return self._rotations_format % tuple(numbers(self._rotations, pose.rotations).ravel().tolist())

    def _write_collected(self) -> None:
        rows, self._rows = "".join(self._rows).encode(), []
        if rows:
            self._output.write(rows)


def open_sink(target: FileTarget, context: SinkContext) -> Sink:
    """Open a `CsvSink`."""
    rotations = target.option("rotations") or context.rotations
    return CsvSink(
        *(target.path, rotations, context.std, context.translation, context.contacts),
        overwrite=context.overwrite,
        stopped=context.stopped,
        waits=not context.paced,
    )
