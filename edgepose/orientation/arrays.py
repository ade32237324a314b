"""Conversion of sample arrays to plain numbers, for loops over single samples."""

from __future__ import annotations

from collections.abc import Sequence
from math import nan

import numpy as np
from numpy.typing import ArrayLike

NO_FIELD = (nan, nan, nan)


def columns(
    time_s: ArrayLike, gyr: ArrayLike, acc: ArrayLike, mag: ArrayLike | None
) -> tuple[list[float], list[list[float]], list[list[float]], Sequence[Sequence[float]]]:
    """Return times (N,), rates, forces and fields (N, 3) as lists; fields are NaN if `mag` is None.

    Raises:
        ValueError: the shapes do not match.
    """
    times, rates, forces = (np.asarray(a, float) for a in (time_s, gyr, acc))
    fields = None if mag is None else np.asarray(mag, float)
    vectors = [rates, forces] if fields is None else [rates, forces, fields]
    if times.ndim != 1 or any((a.size and a.shape[1:] != (3,)) or len(a) != len(times) for a in vectors):
        raise ValueError(f"times {times.shape} need rates, forces and fields of shape (N, 3)")
    return (
        times.tolist(),
        rates.tolist(),
        forces.tolist(),
        [NO_FIELD] * times.size if fields is None else fields.tolist(),
    )
