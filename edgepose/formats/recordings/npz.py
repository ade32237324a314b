"""Recordings as NPZ, one array per quantity of a sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import nan
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import FileFormatError
from edgepose.formats.recordings.base import QUANTITIES, ReadOptions, RecordingFormat, SampleTable, shorten
from edgepose.imu import Recording
from edgepose.utils.safe_npz import BROKEN, open_npz

Array = NDArray[np.float64]


def write_npz(path: Path | str, recording: Recording) -> None:
    """Write a recording as NPZ, quantities as float32.

    Times are one array `t` if all sensors share them, otherwise `<placement>_t`. `sparse` names the arrays in
    which a row of NaN means not measured.
    """
    arrays: dict[str, NDArray[Any]] = {}
    times = [data.time_s for data in recording.sensors.values()]
    shared = all(np.array_equal(times[0], other) for other in times[1:])
    if shared:
        arrays["t"] = times[0]
    for placement, data in recording.sensors.items():
        if not shared:
            arrays[f"{placement}_t"] = data.time_s
        for name, values in zip(QUANTITIES, data[1:], strict=True):
            if values is not None:
                arrays[f"{placement}_{name}"] = values.astype(np.float32)
    arrays["sparse"] = np.array([key for key, values in arrays.items() if np.isnan(values).any()], dtype=str)
    arrays["metadata"] = np.array([f"{key}: {value}" for key, value in recording.metadata.items()], dtype=str)
    # An open file, because numpy might add .npz to a name.
    with Path(path).open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def read_npz(path: Path, options: ReadOptions) -> Recording:
    """Read an NPZ file."""
    try:
        arrays = _load_arrays(path, options.names)
    except BROKEN as error:
        raise FileFormatError(
            f"{path}: not a complete NPZ file ({error}); a truncated one cannot be read: copy it again"
        ) from None
    sparse = set(_lines_of(path, arrays, "sparse"))
    metadata = {}
    for line in _lines_of(path, arrays, "metadata"):
        key, _, value = line.partition(":")
        metadata[key.strip()] = value.strip()
    table = SampleTable(str(path), options.salvage, options.names)
    for placement in options.names:
        if any(f"{placement}_{name}" in arrays for name in QUANTITIES):
            _add_arrays(path, table, placement, arrays, sparse)
    return Recording(table.sensors(), metadata, table.damage())


def _load_arrays(path: Path, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Load the arrays of an NPZ file that belong to a recording."""
    result = {}
    with open_npz(path) as archive:
        for key in archive.files:
            placement, _, name = key.rpartition("_")
            is_sensor = name in QUANTITIES or (name == "t" and placement)
            if is_sensor and placement not in names:
                raise FileFormatError(
                    f"{path}: {shorten(key)} has an unknown sensor; the names are {', '.join(names)}"
                )
            if is_sensor or key in ("t", "sparse", "metadata"):
                result[key] = archive[key]
    return result


def _lines_of(path: Path, arrays: Mapping[str, NDArray[Any]], key: str) -> list[str]:
    lines = arrays.get(key, np.array([], dtype=str))
    if lines.ndim != 1 or lines.dtype.kind != "U":
        raise FileFormatError(f"{path}: {key!r} is not an array of strings")
    return [str(line) for line in lines]


def _add_arrays(
    path: Path, table: SampleTable, placement: str, arrays: Mapping[str, NDArray[Any]], sparse: set[str]
) -> None:
    key = f"{placement}_t" if f"{placement}_t" in arrays else "t"
    if key not in arrays:
        raise FileFormatError(
            f"{path}: has no times of {placement}; they must be in an array 't' or '{placement}_t'"
        )
    columns = [_numbers(path, arrays, key, (arrays[key].size,))[:, None]]
    n = len(columns[0])
    empty = np.zeros(n, dtype=int)
    for name, size in QUANTITIES.items():
        key = f"{placement}_{name}"
        if key not in arrays:
            columns.append(np.full((n, size), nan))
            empty += size
            continue
        columns.append(_numbers(path, arrays, key, (n, size)))
        if key in sparse:
            empty += np.isnan(columns[-1]).sum(axis=1)
    table.add_block(placement, np.arange(n), np.hstack(columns), empty)


def _numbers(path: Path, arrays: Mapping[str, NDArray[Any]], key: str, shape: tuple[int, ...]) -> Array:
    array = arrays[key]
    if array.dtype.kind not in "fiu" or array.shape != shape:
        raise FileFormatError(f"{path}: {key!r} is {array.dtype} {array.shape}, not numbers {shape}")
    return array.astype(np.float64)


FORMAT = RecordingFormat((".npz",), read_npz)
