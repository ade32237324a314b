"""Common base of outputs to text files with one line for each pose and a start that tells their number."""

from __future__ import annotations

import contextlib
from abc import abstractmethod
from collections.abc import Sequence
from pathlib import Path

from edgepose.errors import EdgeposeError
from edgepose.pose import PoseFrame
from edgepose.sinks.pose_file import PoseFileSink
from edgepose.utils.growing_files import GrowingFile
from edgepose.utils.output_targets import is_stream

BLOCK = 600
"""Largest number of poses kept in memory before they are written."""

COUNT = "#number-of-lines"
"""Placeholder in the start of a file for the number of lines after it, which is updated in place."""


class RowFileSink(PoseFileSink):
    """Writes poses as lines to a file on a disk, which is valid after every write, about once a second."""

    def __init__(self, path: str | Path, kind: str, head: str, *, overwrite: bool) -> None:
        """Open the file and write its start.

        Args:
            path: file to write; it appears with the first poses.
            kind: name of the format, for messages.
            head: the start of the file, which may hold `COUNT` once.
            overwrite: replace an existing file.

        Raises:
            EdgeposeError: the file cannot be written.
        """
        self._poses: list[PoseFrame] = []
        self._count = 0
        if is_stream(path):
            raise EdgeposeError(
                f"cannot write {kind} to {path}: it must be a file on a disk, because the number of frames "
                "at its start is filled in at the end"
            )
        output = GrowingFile(path, "poses", overwrite=overwrite)
        self._file = output.file
        before, self._counted, after = head.partition(COUNT)
        self._count_at = len(before.encode())
        super().__init__(output, f"{before}{self._number()}{after}".encode())

    @abstractmethod
    def _lines(self, poses: Sequence[PoseFrame]) -> bytes:
        """Return the lines of the next poses, of which there is at least one."""

    def _number(self) -> str:
        return f"{self._count:<{len(COUNT)}}" if self._counted else ""

    def _add(self, pose: PoseFrame) -> bool:
        self._poses.append(pose)
        return len(self._poses) >= BLOCK

    def _write_collected(self) -> None:
        poses, self._poses = self._poses, []
        if not poses:
            return
        rows = self._lines(poses)
        start = self._file.tell()
        try:
            self._output.write(rows)
        finally:
            self._count += rows[: self._file.tell() - start].count(b"\n")
            end = self._file.seek(0, 2)
            # Overwriting in place works even on a full disk.
            with contextlib.suppress(OSError):
                self._file.seek(self._count_at)
                self._file.write(self._number().encode())
            self._file.seek(end)
