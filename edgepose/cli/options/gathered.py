"""Groups of flags that a command gets as one configuration."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import click

from edgepose.errors import ConfigError

Command = Callable[..., Any]


def gathered(
    command: Command, flags: Sequence[Callable[[Command], Command]], name: str, config: type
) -> Command:
    """A command with more flags, in this order, whose values it gets as one argument.

    Args:
        command: function under the flags.
        flags: click options named as the fields of `config`.
        name: of the argument.
        config: dataclass of the values; its ConfigError is wrong use of the flags.
    """

    @functools.wraps(command)
    def with_config(**words: Any) -> Any:
        own = {each.name: words.pop(each.name) for each in dataclasses.fields(config)}
        try:
            value = config(**own)
        except ConfigError as error:
            raise click.UsageError(str(error)) from None
        return command(**{name: value}, **words)

    wrapped: Command = with_config
    for flag in reversed(flags):
        wrapped = flag(wrapped)
    return wrapped
