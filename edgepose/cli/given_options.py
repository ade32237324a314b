"""Checks of a command line before the command reads it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import click


def check_given(command: click.Command, ctx: click.Context, arguments: Sequence[str]) -> None:
    """Check that no option is given twice of which only one value would count, and that no value is empty.

    An empty value comes from a variable of a shell that is not set; as the name of a file it would stand for
    the present folder.

    Args:
        command: the command.
        ctx: its context.
        arguments: those of the command.

    Raises:
        click.UsageError: an option or a value is wrong in this way, or the arguments cannot be parsed.
    """
    values, rest, given = command.make_parser(ctx).parse_args(list(arguments))
    for parameter in given:
        value = values.get(str(parameter.name))
        if "" in (value if isinstance(value, list | tuple) else [value]):
            is_option = isinstance(parameter, click.Option)
            name = parameter.opts[0] if is_option else parameter.make_metavar(ctx).strip("[].")
            raise click.UsageError(f"{name} is empty: give a value, or leave it out", ctx)
    for parameter, count in Counter(given).items():
        if not isinstance(parameter, click.Option) or parameter.is_flag or parameter.count:
            continue
        if count > 1 and not parameter.multiple:
            raise click.UsageError(f"{parameter.opts[0]} is given {count} times, but only once counts", ctx)
    if isinstance(command, click.Group) and rest:
        inner = command.get_command(ctx, rest[0])
        if inner is not None:
            check_given(inner, click.Context(inner, info_name=rest[0], parent=ctx), rest[1:])
