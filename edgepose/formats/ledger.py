"""What was left out of a file and why, in one line for the user."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class Ledger:
    """Rows of a file that are left out.

    Attributes:
        count: how many they are.
    """

    def __init__(self, name: str, unit: str = "row") -> None:
        """Start with nothing left out of a file of this name, which consists of rows or other units."""
        self.count = 0
        self._name, self._unit = name, unit
        self._first: tuple[int, str] | None = None

    def leave_out(self, row: int, problem: str) -> None:
        """Count a row of this number, which has a problem such as "has no time"."""
        self.count += 1
        if self._first is None or row < self._first[0]:
            self._first = (row, problem)

    def leave_out_unless(self, good: NDArray[np.bool_], rows: NDArray[np.int_], problem: str) -> None:
        """Count the rows (n,) of these numbers that are not good (n,)."""
        for row in rows[~good].tolist():
            self.leave_out(row, problem)

    def damage(self) -> str | None:
        """What was left out, and the first problem; None if nothing was."""
        if self._first is None:
            return None
        row, problem = self._first
        return (
            f"{self._name}: {self.count} bad {self._unit}s left out, the first: {self._unit} {row} {problem}"
        )
