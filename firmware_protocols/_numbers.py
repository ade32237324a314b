"""Checks and rounding of numbers from and for the wire."""

from __future__ import annotations

from collections.abc import Iterable
from math import isfinite

from firmware_protocols.sample import Vector3

LARGEST = 1e7
"""Upper bound of every quantity of a body-worn sensor, SI units (uT); larger values would overflow later."""


def plausible(values: Iterable[float]) -> bool:
    """Return whether no value is NaN and their magnitudes add up to LARGEST at most."""
    return sum(map(abs, values)) <= LARGEST  # NaN compares false


def vector(values: tuple[float, ...], scale: float = 1.0) -> Vector3 | None:
    """Return a vector times a scale; None if it is not plausible."""
    x, y, z = values
    x, y, z = x * scale, y * scale, z * scale
    return (x, y, z) if abs(x) + abs(y) + abs(z) <= LARGEST else None


def number(value: float) -> float | None:
    """Return a number; None if it is not plausible."""
    return value if -LARGEST <= value <= LARGEST else None


def int16(value: float) -> int:
    """Return the nearest integer, clamped to the range of int16.

    Raises:
        ValueError: NaN or infinity.
    """
    if not isfinite(value):
        raise ValueError(f"cannot send {value}")
    return max(-32768, min(32767, round(value)))
