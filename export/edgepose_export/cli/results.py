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
        kinds = ("tables", "contacts", "heat_maps", "reliability")
        self._values: dict[str, list[Mapping[str, Any]]] = {kind: [] for kind in kinds}

    def show(self, text: str) -> None:
        """Show a text for people."""
        if not self._as_json:
            show(text)

    def add(self, kind: str, **values: Any) -> None:
        """Keep a result for scripts; docs/reference/scripts.md describes the kinds and their keys."""
        self._values[kind].append(values)

    def end(self) -> None:
        """Write the document, if it is wanted."""
        if self._as_json:
            show_json("evaluate", self._values)
