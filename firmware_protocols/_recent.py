"""Memory for a bounded number of sensors: noise or a hostile sender can make up any number of ids."""

from __future__ import annotations

from typing import TypeVar

MAX_SENSORS = 256
"""Number of sensors that are remembered."""

K = TypeVar("K")
V = TypeVar("V")


class BoundedDict(dict[K, V]):
    """A dict that keeps the MAX_SENSORS most recently set keys."""

    def __setitem__(self, key: K, value: V) -> None:
        """Set a value; with many keys, also make this key the most recent one."""
        if len(self) > MAX_SENSORS // 2:
            self.pop(key, None)
        super().__setitem__(key, value)
        if len(self) > MAX_SENSORS:
            del self[next(iter(self))]
