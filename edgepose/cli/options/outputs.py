"""Flags of `edgepose run` that say where poses go, and the sinks they ask for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import click

from edgepose.cli.options.gathered import gathered
from edgepose.config import OutputConfig, parse_host_and_port
from edgepose.errors import EdgeposeError
from edgepose.formats.poses.csv_columns import ROTATION_FORMATS
from edgepose.utils.output_targets import identity, is_null
from edgepose.utils.sockets import Destination, parse_destination


def check_files(outputs: Mapping[str, str | Path | None], inputs: Mapping[str, Path | None]) -> None:
    """Raises click.UsageError where a file to write, by flag, is one to read, or two flags name one file."""
    written: dict[object, str] = {}
    for flag, output in outputs.items():
        if output is None:
            continue
        for name, given in inputs.items():
            if given is not None and _is_same_file(Path(output), given):
                raise click.UsageError(f"{flag} would overwrite {given}, which is {name}; name another file")
        other = written.setdefault(identity(output), flag)
        if other != flag and not is_null(output):
            raise click.UsageError(f"{other} and {flag} name the same file, {output}; name two")


def _is_same_file(output: Path, given: Path) -> bool:
    try:
        return given.samefile(output)
    except OSError:  # there is no such file yet
        return False


def _destination(ctx: click.Context, param: click.Parameter, value: str | None) -> Destination | None:
    try:
        return None if value is None else parse_destination(value)
    except EdgeposeError as error:
        raise click.BadParameter(str(error)) from None


def address(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[str, int] | None:
    """Host and port of a flag HOST:PORT, as click's callback."""
    try:
        return None if value is None else parse_host_and_port(value)
    except EdgeposeError as error:
        raise click.BadParameter(str(error)) from None


def _other_sinks(ctx: click.Context, param: click.Parameter, values: tuple[str, ...]) -> dict[str, str]:
    targets: dict[str, str] = {}
    for value in values:
        name, equals, target = value.partition("=")
        if not equals or not name or name in targets:
            raise click.BadParameter(f"{value!r} is not NAME=TARGET, or its name is given twice")
        targets[name] = target
    return targets


overwrite_option = click.option("--overwrite", is_flag=True, help="Replace files that are there already.")
"""The flag --overwrite."""


def output_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Adds the flags that say where poses go; the command gets them as `outputs: OutputConfig`."""
    flags = [
        click.option("--csv", metavar="FILE", help="Write poses as CSV; - is standard output."),
        click.option(
            "--rotations",
            type=click.Choice(list(ROTATION_FORMATS)),
            default="axis-angle",
            show_default=True,
            help="Representation of rotations in the CSV.",
        ),
        click.option(
            "--std",
            is_flag=True,
            help="Add the network's standard deviation of each joint to the CSV, radians.",
        ),
        click.option(
            "--npz", metavar="FILE", help="Write poses as NPZ with the keys of AMASS when the run ends."
        ),
        click.option("--bvh", metavar="FILE", help="Write poses as BVH, for Blender and the like."),
        click.option(
            "--udp",
            callback=_destination,
            metavar="HOST:PORT[,format=json|binary]",
            help="Send each pose as a datagram.",
        ),
        click.option(
            "--osc",
            callback=address,
            metavar="HOST:PORT",
            help="Send each pose by the VMC protocol, for VRM avatars; they listen at port 39539 as a rule.",
        ),
        click.option(
            "--tcp",
            callback=address,
            metavar="HOST:PORT",
            help="Wait here for viewers that read poses as text, as TransPose's does at port 8888.",
        ),
        click.option("--view", is_flag=True, help="Show a figure in the browser, see `edgepose view`."),
        click.option(
            "--height",
            type=float,
            default=1.75,
            show_default=True,
            help="The wearer's stature, for the bones of --bvh, --osc and --view, metres.",
        ),
        overwrite_option,
        click.option(
            "--sink",
            "sinks",
            multiple=True,
            callback=_other_sinks,
            metavar="NAME=TARGET",
            help="Write to an output that an installed package adds; may be repeated.",
        ),
    ]
    return gathered(command, flags, "outputs", OutputConfig)
