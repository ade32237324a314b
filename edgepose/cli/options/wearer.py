"""Flags of one wearer of `edgepose run`, or TOML files (`--rig`) with the same names for several wearers."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from edgepose.cli.conflicts import check_lines, check_pages
from edgepose.cli.options.gathered import usage_errors
from edgepose.cli.options.inputs import inputs_argument, with_first
from edgepose.cli.options.outputs import address, output_options
from edgepose.cli.options.source import calibrated_filter_options, source_options
from edgepose.config import WearerConfig
from edgepose.errors import ConfigError


def _required_without_rig(ctx: click.Context, param: click.Parameter, value: Path | None) -> Path | None:
    if value is None and not ctx.params.get("rig_files"):
        raise click.MissingParameter(ctx=ctx, param=param)
    return value


@click.command()
@source_options
@calibrated_filter_options
@click.option(
    "--calibration",
    callback=_required_without_rig,
    type=click.Path(path_type=Path),
    help="Calibration file written by `edgepose calibrate`.  [required]",
)
@output_options
@click.option(
    "--no-place",
    is_flag=True,
    help="Do not follow the wearer through the room: the pelvis stays above one point of the ground.",
)
@click.option(
    "--no-drift-correction",
    is_flag=True,
    help="Leave the headings of sensors without a common north as they are, while they drift.",
)
@click.option(
    "--control",
    callback=address,
    metavar="HOST:PORT",
    help="Listen here for the datagrams `rezero` and `origin` or the OSC messages /edgepose/rezero and "
    "/edgepose/origin; live sources only.",
)
def _flags(**values: Any) -> WearerConfig:
    with usage_errors():
        return WearerConfig(**values)


_KEYS = {param.opts[0].removeprefix("--"): param for param in _flags.params}


def wearer_options(command: click.Command) -> click.Command:
    """Add a wearer's flags, --rig and IN.

    The command gets them as `wearers: list[WearerConfig]`, and IN as `inputs: tuple[Path, ...]`. With IN
    there is one wearer, whose file is the first of them.
    """
    rig_option = click.Option(
        ["--rig", "rig_files"],
        multiple=True,
        is_eager=True,
        metavar="FILE",
        type=click.Path(path_type=Path),
        help="TOML file whose keys are the flags of one wearer; repeat it for several wearers, who share the "
        "network. See docs/guide/sensors.md in the repository.",
    )
    run = command.callback
    assert run is not None

    @functools.wraps(run)
    def with_wearers(rig_files: tuple[Path, ...], inputs: tuple[Path, ...], **values: Any) -> Any:
        wearer_values = {str(param.name): values.pop(str(param.name)) for param in _flags.params}
        if inputs and rig_files:
            raise click.UsageError("give either recordings as IN or a source with --rig, not both")
        wearer_values = with_first(inputs, wearer_values)
        if not rig_files:
            assert _flags.callback is not None
            return run(wearers=[_flags.callback(**wearer_values)], inputs=inputs, **values)
        ctx = click.get_current_context()
        for name, param in _KEYS.items():
            if ctx.get_parameter_source(str(param.name)) is ParameterSource.COMMANDLINE:
                raise click.UsageError(f"--{name} belongs to a wearer: with --rig, put {name} into the file")
        return run(wearers=read_rigs(rig_files), inputs=(), **values)

    command.callback = with_wearers
    command.params = [inputs_argument(), *_flags.params, rig_option, *command.params]
    return command


def read_rigs(paths: Sequence[Path]) -> list[WearerConfig]:
    """Read the wearers from rig files.

    Raises:
        ConfigError: a file cannot be read, a key or value in it is not valid, or two wearers have the same
            name or line.
    """
    wearers = [WearerConfig.from_toml(path) for path in paths]
    repeated = [name for name, count in Counter(wearer.name for wearer in wearers).items() if count > 1]
    if repeated:
        raise ConfigError(
            f"{', '.join(map(str, paths))}: two wearers have the name {repeated[0]}; give each its own"
        )
    if len(wearers) > 1:
        check_lines(wearers)
        check_pages(wearers)
    return wearers
