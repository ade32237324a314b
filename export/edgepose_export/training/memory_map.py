"""Takes packed into memory-mapped files, so that training needs little memory.

A packed tape is a folder with one file of raw float32 numbers for each tensor of a tape, and `tape.json` with
all other fields, which is written last. It is made once and reused as long as the recordings do not change.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import torch

from edgepose.errors import EdgeposeError
from edgepose_export.synthesis.contacts import PLACE
from edgepose_export.training.dataset import PackedTakes, read_take, root_relative_pose

FRAME: dict[str, tuple[int, ...]] = {
    "orientation": (6, 3, 3),
    "acceleration": (6, 3),
    "relative": (24, 3, 3),
    "place": (PLACE,),
}
"""Shape of one frame in each file."""

_INDEX = "tape.json"


def packed_tape(
    paths: list[Path],
    folder: Path,
    progress: Callable[[list[Path]], Iterable[Path]] = iter,
    root: Path | None = None,
) -> PackedTakes:
    """Return the takes of some files as a tape of memory-mapped tensors.

    Args:
        paths: recordings that `edgepose synthesize` wrote.
        folder: folder of the packed tape. If it is missing or outdated, it is made, one take at a time.
        progress: wraps the list of files to report progress.
        root: the folder of the takes, see `read_take`.

    Raises:
        EdgeposeError: a recording cannot be read, or the folder cannot be written.
    """
    try:
        sources = [[str(path.resolve()), path.stat().st_size, path.stat().st_mtime_ns] for path in paths]
        about = _read_index(folder)
        if about is None or about["sources"] != sources:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / _INDEX).unlink(missing_ok=True)
            about = {"sources": sources, **_pack(paths, folder, progress, root)}
            (folder / _INDEX).write_text(json.dumps(about), encoding="utf-8")
    except OSError as error:
        raise EdgeposeError(f"{folder}: cannot pack takes there: {error.strerror or error}") from error
    return PackedTakes(
        **{name: _mapped(folder, name, sum(about["lengths"])) for name in FRAME},
        starts=torch.tensor([0, *accumulate(about["lengths"])]),
        names=about["names"],
        licenses=about["licenses"],
        sources=about["of"],
    )


def _file(folder: Path, name: str) -> Path:
    return folder / f"{name}.f32"


def _pack(
    paths: list[Path],
    folder: Path,
    progress: Callable[[list[Path]], Iterable[Path]],
    root: Path | None,
) -> dict[str, Any]:
    names, licenses, sources, lengths = [], [], [], []
    with ExitStack() as stack:
        files = {name: stack.enter_context(_file(folder, name).open("wb")) for name in FRAME}
        for path in progress(paths):
            take = read_take(path, root)
            relative = root_relative_pose(torch.from_numpy(take.pose)).numpy()
            arrays = (take.orientation, take.acceleration, relative, take.place_or_nan)
            for name, array in zip(FRAME, arrays, strict=True):
                files[name].write(np.ascontiguousarray(array, "<f4").data)
            names.append(take.name)
            licenses.append(take.license)
            sources.append(take.source)
            lengths.append(len(take.pose))
    return {"names": names, "licenses": licenses, "of": sources, "lengths": lengths}


def _read_index(folder: Path) -> dict[str, Any] | None:
    """Return the index of a packed tape; None if it is missing or incomplete."""
    try:
        about = json.loads((folder / _INDEX).read_text(encoding="utf-8"))
        frames = sum(about["lengths"])
        sizes = {name: _file(folder, name).stat().st_size for name in FRAME}
        if any(len(about[key]) != len(about["lengths"]) for key in ("names", "licenses", "of")):
            return None
    except (FileNotFoundError, ValueError, TypeError, KeyError):
        return None
    complete = all(sizes[name] == 4 * frames * np.prod(shape) for name, shape in FRAME.items())
    return about if complete else None


def _mapped(folder: Path, name: str, frames: int) -> torch.Tensor:
    if frames == 0:
        return torch.zeros(0, *FRAME[name])
    # Copy-on-write, because torch wants writable arrays; the file never changes.
    return torch.from_numpy(np.memmap(_file(folder, name), "<f4", "c", shape=(frames, *FRAME[name])))
