"""Results of `edgepose evaluate`: tables for people as they come, or one JSON document at the end."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from edgepose.cli.options.json_result import show_json
from edgepose.cli.terminal.messages import show


class Results:
    """What was measured so far."""

    def __init__(self, as_json: bool) -> None:
        """Start without results; `as_json` keeps them for `end`."""
        self._as_json = as_json
        parts = ("tables", "contacts", "heat_maps", "reliability")
        self._values: dict[str, list[Mapping[str, Any]]] = {part: [] for part in parts}

    def show(self, text: str) -> None:
        """Show a text for people."""
        if not self._as_json:
            show(text)

    def add(self, part: str, /, **values: Any) -> None:
        """Keep a result for scripts.

        Args:
            part: key of the document whose list gets the result.
            **values: the result; docs/reference/scripts.md describes the keys.
        """
        self._values[part].append(values)

    def end(self) -> None:
        """Write the document, if it is wanted."""
        if self._as_json:
            show_json("evaluate", self._values)
