"""Groups of flags that a command gets as one configuration object."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import click

from edgepose.config import setting_names
from edgepose.errors import ConfigError

Command = Callable[..., Any]


@contextmanager
def usage_errors() -> Iterator[None]:
    """Report a ConfigError as wrong use of the command."""
    try:
        yield
    except ConfigError as error:
        raise click.UsageError(str(error)) from None


def add_flags(command: Command, flags: Sequence[Callable[[Command], Command]]) -> Command:
    """Add click options to a command, in the order of the help text."""
    for flag in reversed(flags):
        command = flag(command)
    return command


def gathered(
    command: Command, flags: Sequence[Callable[[Command], Command]], name: str, config: type
) -> Command:
    """Add flags to a command, which gets their values as one argument.

    Args:
        command: the function to add flags to.
        flags: click options, in the order of the help text. The values of those that are not named like a
            setting of `config` remain arguments of their own.
        name: name of the argument.
        config: class of the values. Settings without a flag keep their defaults. A ConfigError that it
            raises is reported as wrong use.
    """

    @functools.wraps(command)
    def with_config(**values: Any) -> Any:
        names = [name for name in setting_names(config) if name in values]
        with usage_errors():
            gathered_values = config(**{name: values.pop(name) for name in names})
        return command(**{name: gathered_values}, **values)

    return add_flags(with_config, flags)
