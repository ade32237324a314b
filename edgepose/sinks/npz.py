"""Poses as NPZ with the keys of AMASS, for what reads SMPL motion. The arrays are in docs/outputs.md."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgepose.durable_files import replace_file
from edgepose.errors import EdgeposeError
from edgepose.output_targets import find_target, part_path
from edgepose.pose import FILLING_WINDOW, PoseFrame, held_sensors, status_bits
from edgepose.poses import Poses, read_blocks
from edgepose.rotations import Z_UP_TO_T, matrix_to_rotvec
from edgepose.sinks import Sink
from edgepose.sinks.csv_file import CsvSink

BETAS = 16
"""Shape coefficients of SMPL; all are zero, the average body."""


def write_npz(path: Path, blocks: Iterable[Poses], count: int, rate: float) -> None:
    """Write poses with little of them in memory at a time.

    Args:
        path: file to write.
        blocks: the poses, in order.
        count: how many poses the blocks hold together.
        rate: frames per second.

    Raises:
        OSError: it cannot be written.
    """
    frames, times, held, filling, places = [], [], [], [], []
    with zipfile.ZipFile(path, "w") as archive:
        with archive.open("poses.npy", "w", force_zip64=True) as member:
            header = {"descr": "<f4", "fortran_order": False, "shape": (count, 72)}
            np.lib.format.write_array_header_1_0(member, header)
            for block in blocks:
                member.write(_vectors(block).tobytes())
                frames.append(block.frames)
                times.append(block.time_s)
                held.append(held_sensors(block.status))
                flags = np.array([status_bits(text)[0] for text in block.status])
                filling.append((flags & FILLING_WINDOW).astype(bool))
                places.append(_places(block))
        arrays: dict[str, NDArray[Any]] = {
            "trans": np.concatenate(places),
            "betas": np.zeros(BETAS),
            "gender": np.array("neutral"),
            "mocap_framerate": np.array(float(rate)),
            "frame": np.concatenate(frames),
            "time_s": np.concatenate(times),
            "held": np.concatenate(held),
            "filling": np.concatenate(filling),
        }
        for key, values in arrays.items():
            with archive.open(f"{key}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, values, allow_pickle=False)


def _vectors(block: Poses) -> NDArray[np.float32]:
    """Axis-angle vectors (T, 72), the pelvis against AMASS's world with Z up."""
    rotations = block.rotations.copy()
    rotations[:, 0] = Z_UP_TO_T.T @ rotations[:, 0]
    return matrix_to_rotvec(rotations).reshape(len(rotations), 72).astype("<f4")


def _places(block: Poses) -> NDArray[np.float32]:
    """Places of the pelvis (T, 3), metres, Z up; zeros where nothing is known."""
    if block.translation is None:
        return np.zeros((len(block.frames), 3), "<f4")
    return (block.translation @ Z_UP_TO_T).astype("<f4")


class NpzSink(Sink):
    """Writes poses to a file that appears when the sink closes.

    Until then they are in a CSV file beside it, `walk.part.csv` for `walk.npz`: however a run ends, there is
    a file of poses that everything reads, and no more than a second of them is in memory.
    """

    def __init__(
        self, path: str | Path, rate: float = 60.0, translation: bool = False, *, overwrite: bool = True
    ) -> None:
        """Open the CSV file.

        Args:
            path: file to write.
            rate: frames per second.
            translation: whether the poses have a translation.
            overwrite: whether it may take the place of a file; that of another run's CSV file it never takes.

        Raises:
            EdgeposeError: it cannot be written, or poses of a run that was cut off are where they would go.
        """
        self._path, self._overwrite = Path(path), overwrite
        target = find_target(path, "poses")
        if target.stream:
            raise EdgeposeError(f"cannot write poses to {path}: an NPZ file needs a file's name")
        self._part = part_path(path)
        if os.path.lexists(self._part):
            raise EdgeposeError(
                f"{self._part} is there already, perhaps of a run that was cut off: keep its poses with "
                f"edgepose convert {self._part} --to npz --out saved, then delete it"
            )
        self._rate, self._closed, self._count = rate, False, 0
        self._csv = CsvSink(self._part, translation=translation, overwrite=False, follow=False)
        self._csv.start()

    def write(self, pose: PoseFrame) -> None:
        """Add a pose."""
        self._csv.write(pose)
        self._count += 1

    def close(self) -> None:
        """Write the file and take the other away; a second call does nothing.

        Raises:
            EdgeposeError: something could not be written; what was is in the CSV file.
        """
        if self._closed:
            return
        if not self._count:
            self.discard()
            return
        self._closed = True
        try:
            self._csv.close()
        finally:  # A full disk may have room for this one, which is smaller.
            self._finish()

    def discard(self) -> None:
        """As `close`."""
        if self._count:
            self.close()
            return
        self._closed = True
        self._csv.discard()

    def _finish(self) -> None:
        try:
            with self._part.open("rb") as file:
                count = sum(piece.count(b"\n") for piece in iter(lambda: file.read(1 << 20), b"")) - 1
        except OSError as error:
            raise EdgeposeError(
                f"cannot write poses to {self._path}: {self._part}, which has them, is gone: "
                f"{error.strerror or error}"
            ) from error
        if count > 0:
            try:
                replace_file(
                    self._path,
                    lambda path: write_npz(path, read_blocks(self._part), count, self._rate),
                    "poses",
                    overwrite=self._overwrite,
                )
            except EdgeposeError as error:
                raise EdgeposeError(f"{error}; all poses are in {self._part}") from error
        self._part.unlink()
