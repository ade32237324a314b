"""Flags of the outputs for poses, and checks of the files that a command writes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from edgepose.cli.options.body import HEIGHT, leg_length_option
from edgepose.cli.options.float_range import FloatRange
from edgepose.cli.options.gathered import Command, gathered
from edgepose.config import OutputConfig
from edgepose.errors import EdgeposeError
from edgepose.formats.poses.csv_columns import ROTATION_FORMATS
from edgepose.pose import RATES
from edgepose.sinks.registry import SINKS, Output
from edgepose.skeleton import DEFAULT_HEIGHT
from edgepose.utils.output_targets import identity, is_null
from edgepose.utils.sockets import parse_host_and_port


def check_files(outputs: Iterable[tuple[str, str | Path | None]], inputs: Mapping[str, Path | None]) -> None:
    """Raise click.UsageError if an output is also an input, or if two flags name the same output.

    Args:
        outputs: flag and name of each file to write; None is skipped.
        inputs: files to read, by flag.
    """
    written: dict[object, str] = {}
    for flag, output in outputs:
        if output is None:
            continue
        for name, path in inputs.items():
            if path is not None and _is_same_file(Path(output), path):
                raise click.UsageError(f"{flag} would overwrite {path}, which is {name}; name another file")
        other = written.get(identity(output))
        if other is not None and not is_null(output):
            raise click.UsageError(f"{other} and {flag} name the same file, {output}; name two files")
        written[identity(output)] = flag


def _is_same_file(output: Path, path: Path) -> bool:
    try:
        return path.samefile(output)
    except OSError:  # at least one of them does not exist
        return False


def address(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[str, int] | None:
    """Parse the value HOST:PORT of a flag (a click callback)."""
    try:
        return None if value is None else parse_host_and_port(value)
    except EdgeposeError as error:
        raise click.BadParameter(str(error)) from None


def _other_sinks(ctx: click.Context, param: click.Parameter, values: tuple[str, ...]) -> dict[str, list[str]]:
    targets: dict[str, list[str]] = {}
    for value in values:
        name, equals, target = value.partition("=")
        if not equals or not name:
            raise click.BadParameter(f"{value!r} is not NAME=TARGET")
        targets.setdefault(name, []).append(target)
    return targets


overwrite_option = click.option("--overwrite", is_flag=True, help="Replace existing files.")
"""The flag --overwrite."""


rate_option = click.option(
    "--rate",
    type=FloatRange(*RATES),
    metavar="HZ",
    help="Poses per second of all outputs, interpolated.  [default: the network's, or the file's]",
)
"""The flag --rate."""

_rotations_option = click.option(
    "--rotations",
    type=click.Choice(list(ROTATION_FORMATS)),
    default="axis-angle",
    show_default=True,
    help="Representation of rotations in the CSV.",
)


def output_options(command: Command) -> Command:
    """Add the flags of all outputs; the command gets them as `outputs: OutputConfig`."""
    std_option = click.option(
        "--std",
        is_flag=True,
        help="Add the network's standard deviation of each joint to the CSV, radians.",
    )
    height_option = click.option(
        "--height",
        type=HEIGHT,
        help="The wearer's height, metres: for the length of their steps, and for the bones of --bvh, --glb, "
        f"--mot, --osc, --vrchat, --mocopi and --view.  [default: the calibration's, or {DEFAULT_HEIGHT}]",
    )
    other_sinks_option = click.option(
        "--sink",
        "sinks",
        multiple=True,
        callback=_other_sinks,
        metavar="NAME=TARGET",
        help="Write to an output that an installed package adds; repeatable.",
    )
    page_port_option = click.option(
        "--page-port",
        type=click.IntRange(1, 65535),
        help="TCP port of the page of --view.  [default: 8080, or the next one that is free]",
    )
    flags = [
        *_flags(SINKS, {"csv": [_rotations_option, std_option], "view": [page_port_option]}),
        *(rate_option, height_option, leg_length_option, overwrite_option, other_sinks_option),
    ]
    return gathered(command, flags, "outputs", OutputConfig)


def file_output_options(*more: Callable[[Command], Command]) -> Callable[[Command], Command]:
    """Return a decorator that adds the flags of the outputs to files, then `more`, then --overwrite.

    The command gets the outputs as `outputs: OutputConfig`.
    """
    files = {name: output for name, output in SINKS.items() if output.suffix}
    flags: list[Callable[[Command], Command]] = [
        *_flags(files, {"csv": [_rotations_option]}),
        *more,
        overwrite_option,
    ]
    return lambda command: gathered(command, flags, "outputs", OutputConfig)


def _flags(
    outputs: Mapping[str, Output], more: Mapping[str, Sequence[Callable[[Command], Command]]]
) -> list[Callable[[Command], Command]]:
    """Return the flags of outputs, each followed by `more` flags that are about this output alone."""
    flags: list[Callable[[Command], Command]] = []
    for name, output in outputs.items():
        flags += [_flag(name, output), *more.get(name, ())]
    return flags


def _flag(name: str, output: Output) -> Callable[[Command], Command]:
    def targets(ctx: click.Context, param: click.Parameter, values: tuple[str, ...]) -> list[Any]:
        try:
            return [output.target(value) for value in values]
        except EdgeposeError as error:
            raise click.BadParameter(str(error)) from None

    if output.metavar is None:
        return click.option(f"--{name}", is_flag=True, help=output.help)
    return click.option(
        f"--{name}", metavar=output.metavar, callback=targets, multiple=True, help=output.help
    )
