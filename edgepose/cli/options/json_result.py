"""The flag --json, and the document that it writes to standard output; see docs/reference/scripts.md."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from edgepose.cli.terminal.messages import show
from edgepose.utils.output_targets import identity, is_null

if TYPE_CHECKING:
    from edgepose.config import OutputConfig

json_option = click.option(
    "--json",
    "as_json",
    is_flag=True,
    help="Write the result to standard output as one JSON document, for scripts; messages stay on standard "
    "error. See docs/reference/scripts.md in the repository.",
)
"""The flag --json; the command gets it as `as_json: bool`."""


def check_standard_output(outputs: OutputConfig) -> None:
    """Raise click.UsageError if poses go to standard output, too."""
    from edgepose.sinks.registry import target_texts

    for name, target in target_texts(outputs.targets):
        if target and identity(target) == identity("-") and not is_null(target):
            raise click.UsageError(f"--{name} and --json both write to standard output; name a file")


def show_json(command: str, result: Mapping[str, Any]) -> None:
    """Write the result of a command as one JSON document.

    Args:
        command: name of the command.
        result: its result. Numbers that are not finite become null, files their names, tuples lists.
    """
    show(json.dumps({"command": command, **_plain(result)}, indent=2, allow_nan=False))


def _plain(value: Any) -> Any:
    """Return a value as JSON has it."""
    if hasattr(value, "_asdict"):  # a named tuple
        return _plain(value._asdict())
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):  # an array or number of numpy
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path | Exception) else value
