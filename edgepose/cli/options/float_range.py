"""Numbers in a range, as values of flags."""

from __future__ import annotations

import math
from typing import Any

import click


class FloatRange(click.FloatRange):
    """Number in a range; NaN, which click's own range lets through, is refused."""

    name = "float"

    def __init__(self, low: float, high: float | None = None, unit: str = "", min_open: bool = False) -> None:
        """Store the range.

        Args:
            low: lowest number.
            high: highest number, if there is one.
            unit: unit of the numbers, for messages; empty where they are mistaken for no other.
            min_open: the lowest number is outside.
        """
        super().__init__(low, high, min_open)
        self._unit = unit

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number.

        Raises:
            click.BadParameter: it is no number, or outside of the range.
        """
        try:
            number = float(super().convert(value, param, ctx))
        except click.BadParameter as error:
            if not self._unit or "in the range" not in error.message:
                raise
            self.fail(f"{error.message.removesuffix('.')} {self._unit}.", param, ctx)
        if math.isnan(number):
            self.fail(f"{value!r} is not a number.", param, ctx)
        return number
