"""Groups of flags that a command gets as one configuration object."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import click

from edgepose.errors import ConfigError

Command = Callable[..., Any]


@contextmanager
def usage_errors() -> Iterator[None]:
    """Report a ConfigError as wrong use of the command."""
    try:
        yield
    except ConfigError as error:
        raise click.UsageError(str(error)) from None


def gathered(
    command: Command, flags: Sequence[Callable[[Command], Command]], name: str, config: type
) -> Command:
    """Add flags to a command, which gets their values as one argument.

    Args:
        command: the function to add flags to.
        flags: click options, in the order of the help text, each named like a field of `config`.
        name: name of the argument.
        config: dataclass of the values. Fields without a flag keep their defaults. A ConfigError that it
            raises is reported as wrong use.
    """

    @functools.wraps(command)
    def with_config(**values: Any) -> Any:
        fields = [field.name for field in dataclasses.fields(config) if field.name in values]
        with usage_errors():
            gathered_values = config(**{field: values.pop(field) for field in fields})
        return command(**{name: gathered_values}, **values)

    wrapped: Command = with_config
    for flag in reversed(flags):
        wrapped = flag(wrapped)
    return wrapped
