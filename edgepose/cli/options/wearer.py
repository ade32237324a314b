"""What `edgepose run` takes for a wearer: on the command line for one, in rig files (`--rig`) for several."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click
from click.core import ParameterSource

from edgepose.cli.conflicts import check_lines
from edgepose.cli.options.outputs import OutputFlags, address, output_options
from edgepose.cli.options.source import SourceFlags, filter_options, source_options
from edgepose.errors import EdgeposeError

FILES = ("file", "sensors", "calibration", "csv", "npz", "bvh")
"""Flags that name files, which a rig file names against its own folder; besides --protocol, which may."""


class RigFlags(NamedTuple):
    """A wearer's flags: where samples come from, what is made of them, where poses go.

    Attributes:
        name: what messages call the wearer; empty where there is one, from the command line.
        path: the rig file.
    """

    source: SourceFlags
    filter: str
    no_mag: bool
    calibration: Path
    outputs: OutputFlags
    control: tuple[str, int] | None
    name: str = ""
    path: Path | None = None


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
def _flags(**words: Any) -> RigFlags:
    rig = RigFlags(**words)
    if not rig.outputs.any:
        raise click.UsageError("give at least one output, such as --csv FILE, --udp HOST:PORT or --view")
    if rig.control is not None and not rig.source.live:
        raise click.UsageError("--control needs sensors that send, or --realtime")
    return rig


_KEYS = {param.opts[0].removeprefix("--"): param for param in _flags.params}


def rig_options(command: click.Command) -> click.Command:
    """Adds a wearer's flags and --rig; the command gets them as `rigs: list[RigFlags]`."""
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


def read_rigs(paths: Sequence[Path]) -> list[RigFlags]:
    """The wearers of some rig files.

    Raises:
        EdgeposeError: a file cannot be read, a key or value in it means nothing, or two wearers have one name
            or line.
    """
    rigs = [_read(path) for path in paths]
    twice = [name for name, count in Counter(rig.name for rig in rigs).items() if count > 1]
    if twice:
        raise EdgeposeError(
            f"{', '.join(map(str, paths))}: two of them have the name {twice[0]}; give each its own"
        )
    if len(rigs) > 1:
        check_lines(rigs)
    return rigs


def _read(path: Path) -> RigFlags:
    from edgepose.utils.text_files import read_toml

    content = read_toml(path)
    name = content.pop("name", path.stem)
    if not isinstance(name, str) or not name.isprintable() or not name.strip():
        raise EdgeposeError(f"{path}: name must be text in quotes on one line, not {name!r}")
    words = [word for key, value in content.items() for word in _words(path, key, value)]
    try:
        rig: RigFlags = _flags.invoke(_flags.make_context(str(path), words))
        return rig._replace(name=name, path=path)
    except click.MissingParameter as error:
        key = "" if error.param is None else error.param.opts[0].removeprefix("--")
        raise EdgeposeError(f"{path}: {key} is missing") from None
    except click.BadParameter as error:
        key = "" if error.param is None else error.param.opts[0].removeprefix("--")
        raise EdgeposeError(f"{path}: {key}: {error.message}") from None
    except click.UsageError as error:
        # Keys are the flags without their hyphens.
        raise EdgeposeError(f"{path}: {error.message.replace('--', '')}") from None


def _words(path: Path, key: str, value: object) -> list[str]:
    """A key and its value as the command line has them.

    Raises:
        EdgeposeError: there is no such key, or the value is of another type.
    """
    param = _KEYS.get(key)
    if not isinstance(param, click.Option):
        raise EdgeposeError(f"{path}: unknown key {key!r}; keys are name, {', '.join(_KEYS)}")
    kinds: tuple[type, ...] = (str,)
    what = "text in quotes"
    if param.is_flag:
        kinds, what = (bool,), "true or false"
    elif isinstance(param.type, type(click.INT)):
        kinds, what = (int,), "a whole number"
    elif isinstance(param.type, type(click.FLOAT)):
        kinds, what = (int, float), "a number"
    # A bool is an int to isinstance.
    if type(value) not in kinds:
        raise EdgeposeError(f"{path}: {key} must be {what}, not {value!r}")
    if isinstance(value, bool):
        return [f"--{key}"] if value else []
    if "\0" in str(value):
        raise EdgeposeError(f"{path}: {key} must be text without NUL characters, not {value!r}")
    is_file = key in FILES or (key == "protocol" and str(value).endswith(".toml"))
    return [f"--{key}={path.parent / str(value) if is_file and value != '-' else value}"]
