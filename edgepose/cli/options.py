"""Flags that several commands share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

Command = TypeVar("Command", bound=Callable[..., Any])


def source_options(command: Command) -> Command:
    """Adds the flags that say where samples come from: --port, --baud, --file, --realtime, --protocol."""
    flags = [
        click.option(
            "--port",
            metavar="PORT",
            help="Serial port that the sensors send to, such as /dev/ttyUSB0 or COM3.",
        ),
        click.option(
            "--baud",
            type=click.IntRange(1),
            default=115200,
            show_default=True,
            help="Bits per second of the port.",
        ),
        click.option(
            "--file",
            "path",
            type=click.Path(path_type=Path),
            help="Recording (.csv, .npz) or raw serial capture (.bin, .raw) to read instead of a port.",
        ),
        click.option(
            "--realtime", is_flag=True, help="Replay --file at its own pace instead of as fast as possible."
        ),
        click.option(
            "--protocol",
            type=click.Choice(["auto", "native"]),
            default="auto",
            show_default=True,
            help="Wire format of a port or a raw capture.",
        ),
    ]
    for flag in reversed(flags):
        command = flag(command)
    return command


def check_source(port: str | None, path: Path | None) -> None:
    """Raises click.UsageError unless exactly one source is given."""
    if (port is None) == (path is None):
        raise click.UsageError("give one source: --port PORT or --file PATH")
