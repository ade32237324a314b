"""The argument IN: recordings to work on one after the other, instead of a source."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import click

from edgepose.sources import LINES

_SOURCES = ("file", *LINES)

_ARGUMENT: dict[str, Any] = {
    "nargs": -1,
    "metavar": "[IN]...",
    "type": click.Path(path_type=Path, allow_dash=True),
}


def inputs_argument() -> click.Argument:
    """Return the argument, which the command gets as `inputs: tuple[Path, ...]`."""
    return click.Argument(["inputs"], **_ARGUMENT)


def with_first(inputs: tuple[Path, ...], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of the flags of a source, which is the first input if there are inputs.

    Raises:
        click.UsageError: inputs and a source are given, or an input is not read at once from a file.
    """
    if not inputs:
        return dict(values)
    if flags := [name for name in _SOURCES if values[name] is not None]:
        raise click.UsageError(f"give either recordings as IN or a source with --{flags[0]}, not both")
    if values["realtime"]:
        raise click.UsageError("--realtime is for one --file; leave it out with recordings named as IN")
    if any(str(path) == "-" for path in inputs):
        raise click.UsageError("- is standard input, which is one recording: use --file -")
    return {**values, "file": inputs[0]}


def check_jobs(jobs: int, inputs: tuple[Path, ...]) -> None:
    """Raise click.UsageError if several processes are asked for although there are no inputs."""
    if jobs > 1 and not inputs:
        raise click.UsageError("--jobs is for recordings named as IN; one source is one process")


def recordings_or_source(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the argument to a command with `source_options`, whose source is then the first of the inputs."""

    @functools.wraps(command)
    def with_inputs(inputs: tuple[Path, ...], **values: Any) -> Any:
        return command(inputs=inputs, **with_first(inputs, values))

    return click.argument("inputs", **_ARGUMENT)(with_inputs)
