"""Flags of one wearer of `edgepose run`, or TOML files (`--rig`) with the same names for several."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from edgepose.cli.conflicts import check_lines
from edgepose.cli.options.outputs import address, output_options
from edgepose.cli.options.source import filter_options, source_options
from edgepose.config import WearerConfig
from edgepose.errors import ConfigError


def _needed(ctx: click.Context, param: click.Parameter, value: Path | None) -> Path | None:
    if value is None and not ctx.params.get("rigs"):
        raise click.MissingParameter(ctx=ctx, param=param)
    return value


@click.command()
@source_options
@filter_options
@click.option(
    "--calibration",
    callback=_needed,
    type=click.Path(path_type=Path),
    help="Calibration that `edgepose calibrate` wrote.  [required]",
)
@output_options
@click.option(
    "--control",
    callback=address,
    metavar="HOST:PORT",
    help="Listen here for datagrams `rezero` and OSC messages /edgepose/rezero; live only.",
)
def _flags(**words: Any) -> WearerConfig:
    try:
        return WearerConfig(**words)
    except ConfigError as error:
        raise click.UsageError(str(error)) from None


_KEYS = {param.opts[0].removeprefix("--"): param for param in _flags.params}


def rig_options(command: click.Command) -> click.Command:
    """Adds a wearer's flags and --rig; the command gets them as `rigs: list[WearerConfig]`."""
    several = click.Option(
        ["--rig", "rigs"],
        multiple=True,
        is_eager=True,
        metavar="FILE",
        type=click.Path(path_type=Path),
        help="TOML file with the flags of one wearer, as names; several times for several wearers, who share "
        "the network. See docs/guide/sensors.md.",
    )
    run = command.callback
    assert run is not None

    @functools.wraps(run)
    def with_rigs(rigs: tuple[Path, ...], **words: Any) -> Any:
        own = {str(param.name): words.pop(str(param.name)) for param in _flags.params}
        if not rigs:
            assert _flags.callback is not None
            return run(rigs=[_flags.callback(**own)], **words)
        ctx = click.get_current_context()
        for name, param in _KEYS.items():
            if ctx.get_parameter_source(str(param.name)) is ParameterSource.COMMANDLINE:
                raise click.UsageError(f"--{name} belongs to a wearer: with --rig, put {name} into the file")
        return run(rigs=read_rigs(rigs), **words)

    command.callback = with_rigs
    command.params = [*_flags.params, several, *command.params]
    return command


def read_rigs(paths: Sequence[Path]) -> list[WearerConfig]:
    """The wearers of some TOML files.

    Raises:
        ConfigError: a file cannot be read, a key or value in it is not valid, or two wearers have one name or
            line.
    """
    rigs = [WearerConfig.from_toml(path) for path in paths]
    twice = [name for name, count in Counter(rig.name for rig in rigs).items() if count > 1]
    if twice:
        raise ConfigError(
            f"{', '.join(map(str, paths))}: two of them have the name {twice[0]}; give each its own"
        )
    if len(rigs) > 1:
        check_lines(rigs)
    return rigs
