"""Writes poses as NPZ with the keys of AMASS; the arrays are in docs/reference/outputs.md."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgepose.formats.poses.reading import Poses
from edgepose.pose import held_sensors
from edgepose.rotations import Z_UP_TO_T, matrix_to_rotvec

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
                held.append(held_sensors(block.held))
                filling.append(np.array(block.warming_up, bool))
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
