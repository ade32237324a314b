"""Options that are given twice."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import click


def refuse_repeats(command: click.Command, ctx: click.Context, arguments: Sequence[str]) -> None:
    """Check that no option is given twice of which only one value would count.

    Args:
        command: the command.
        ctx: its context.
        arguments: those of the command.

    Raises:
        click.UsageError: one is, or the arguments cannot be parsed.
    """
    _, _, given = command.make_parser(ctx).parse_args(list(arguments))
    for parameter, count in Counter(given).items():
        if not isinstance(parameter, click.Option) or parameter.is_flag or parameter.count:
            continue
        if count > 1 and not parameter.multiple:
            raise click.UsageError(f"{parameter.opts[0]} is given {count} times, but only once counts", ctx)
