"""Output flags of `edgepose run`, and checks of the files that a command writes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import click

from edgepose.cli.options.gathered import gathered
from edgepose.config import OutputConfig, parse_host_and_port
from edgepose.errors import EdgeposeError
from edgepose.formats.bvh_names import BVH_NAMES
from edgepose.formats.poses.csv_columns import ROTATION_FORMATS
from edgepose.utils.output_targets import identity, is_null
from edgepose.utils.sockets import Address, Destination, parse_datagram_address, parse_destination


def check_files(outputs: Mapping[str, str | Path | None], inputs: Mapping[str, Path | None]) -> None:
    """Raise click.UsageError if an output is also an input, or if two flags name the same output.

    Args:
        outputs: files to write, by flag.
        inputs: files to read, by flag.
    """
    written: dict[object, str] = {}
    for flag, output in outputs.items():
        if output is None:
            continue
        for name, path in inputs.items():
            if path is not None and _is_same_file(Path(output), path):
                raise click.UsageError(f"{flag} would overwrite {path}, which is {name}; name another file")
        other = written.setdefault(identity(output), flag)
        if other != flag and not is_null(output):
            raise click.UsageError(f"{other} and {flag} name the same file, {output}; name two files")


def _is_same_file(output: Path, path: Path) -> bool:
    try:
        return path.samefile(output)
    except OSError:  # at least one of them does not exist
        return False


def _destination(ctx: click.Context, param: click.Parameter, value: str | None) -> Destination | None:
    try:
        return None if value is None else parse_destination(value)
    except EdgeposeError as error:
        raise click.BadParameter(str(error)) from None


def _datagram_address(ctx: click.Context, param: click.Parameter, value: str | None) -> Address | None:
    try:
        return None if value is None else parse_datagram_address(value)
    except EdgeposeError as error:
        raise click.BadParameter(str(error)) from None


def address(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[str, int] | None:
    """Parse the value HOST:PORT of a flag (a click callback)."""
    try:
        return None if value is None else parse_host_and_port(value)
    except EdgeposeError as error:
        raise click.BadParameter(str(error)) from None


def _other_sinks(ctx: click.Context, param: click.Parameter, values: tuple[str, ...]) -> dict[str, str]:
    targets: dict[str, str] = {}
    for value in values:
        name, equals, target = value.partition("=")
        if not equals or not name or name in targets:
            raise click.BadParameter(f"{value!r} is not NAME=TARGET, or repeats a name")
        targets[name] = target
    return targets


overwrite_option = click.option("--overwrite", is_flag=True, help="Replace existing files.")
"""The flag --overwrite."""


def npz_option(help: str) -> Callable[[Any], Any]:
    """Return the flag --npz with a help text."""
    return click.option(
        "--npz",
        metavar="FILE[,joints=24|52|55]",
        help=f"{help} 24 joints are SMPL's, 52 SMPL-H's, 55 SMPL-X's.",
    )


def bvh_option(help: str) -> Callable[[Any], Any]:
    """Return the flag --bvh with a help text."""
    return click.option(
        "--bvh",
        metavar="FILE[,names=SKELETON]",
        help=f"{help} Names of the joints: {', '.join(BVH_NAMES)}.",
    )


def output_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the output flags; the command gets them as `outputs: OutputConfig`."""
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
        npz_option("Write poses as NPZ with the keys of AMASS when the run ends."),
        bvh_option("Write poses as BVH, for Blender and similar programs."),
        click.option(
            "--udp",
            callback=_destination,
            metavar="HOST:PORT[,format=json|binary][,broadcast]",
            help="Send each pose as a datagram.",
        ),
        click.option(
            "--osc",
            callback=_datagram_address,
            metavar="HOST:PORT[,broadcast]",
            help="Send each pose over OSC (the VMC protocol) to programs that show VRM avatars; most of them "
            "listen on port 39539.",
        ),
        click.option(
            "--tcp",
            callback=address,
            metavar="HOST:PORT",
            help="Listen here for viewers that read poses as text, such as TransPose's on port 8888.",
        ),
        click.option("--view", is_flag=True, help="Show a figure in the browser; see `edgepose view`."),
        click.option(
            "--height",
            type=float,
            default=1.75,
            show_default=True,
            help="The wearer's height, metres, for the bones of --bvh, --osc and --view.",
        ),
        overwrite_option,
        click.option(
            "--sink",
            "sinks",
            multiple=True,
            callback=_other_sinks,
            metavar="NAME=TARGET",
            help="Write to an output that an installed package adds; repeatable.",
        ),
    ]
    return gathered(command, flags, "outputs", OutputConfig)
