"""Memory of a bounded number of sensors: on a line or bus anybody can invent ids."""

from __future__ import annotations

from typing import TypeVar

MAX_SENSORS = 256
"""Sensors remembered at a time."""

K = TypeVar("K")
V = TypeVar("V")


class BoundedDict(dict[K, V]):
    """A dict of the MAX_SENSORS keys set last; more push out those not set for longest."""

    def __setitem__(self, key: K, value: V) -> None:
        """Set, as the latest if there are many."""
        if len(self) > MAX_SENSORS // 2:
            self.pop(key, None)
        super().__setitem__(key, value)
        if len(self) > MAX_SENSORS:
            del self[next(iter(self))]
