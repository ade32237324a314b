"""Numbers from and for the wire."""

from __future__ import annotations

from collections.abc import Iterable
from math import isfinite

from firmware_protocols.sample import Vector3

LARGEST = 1e7
"""No quantity of a sensor on a body is larger in its SI unit (uT); what is, squares to infinity later."""


def plausible(values: Iterable[float]) -> bool:
    """If these are numbers, and none is beyond LARGEST."""
    return sum(map(abs, values)) <= LARGEST  # NaN is not, either


def vector(values: tuple[float, ...], scale: float = 1.0) -> Vector3 | None:
    """A vector times a scale; None if it is not plausible."""
    x, y, z = values
    x, y, z = x * scale, y * scale, z * scale
    return (x, y, z) if abs(x) + abs(y) + abs(z) <= LARGEST else None


def number(value: float) -> float | None:
    """A number, or None if it is not plausible."""
    return value if -LARGEST <= value <= LARGEST else None


def int16(value: float) -> int:
    """The nearest whole number, held at the ends of int16.

    Raises:
        ValueError: NaN or infinity.
    """
    if not isfinite(value):
        raise ValueError(f"cannot send {value}")
    return max(-32768, min(32767, round(value)))
