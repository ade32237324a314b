"""Flags of `edgepose run` that say where poses go, and the sinks they ask for."""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from edgepose.errors import EdgeposeError

if TYPE_CHECKING:
    from edgepose.sinks import Sink
    from edgepose.sinks.udp import Destination


class OutputFlags(NamedTuple):
    """Where poses go: one field a flag; those that are None or false are not asked for."""

    csv: str | None
    rotations: str
    std: bool
    udp: Destination | None

    @property
    def any(self) -> bool:
        """Whether there is an output at all."""
        return self.csv is not None or self.udp is not None

    @property
    def files(self) -> dict[str, str]:
        """The files that will be written, by flag."""
        return {} if self.csv in (None, "-") else {"--csv": str(self.csv)}

    def open(self, stack: ExitStack) -> list[Sink]:
        """The sinks, which the stack closes.

        Raises:
            EdgeposeError: a file or address cannot be written to.
        """
        from edgepose.sinks.csv_file import CsvSink
        from edgepose.sinks.udp import UdpSink

        sinks: list[Sink] = []
        if self.csv is not None:
            sinks.append(stack.enter_context(CsvSink(self.csv, self.rotations, self.std)))
        if self.udp is not None:
            sinks.append(stack.enter_context(UdpSink(*self.udp)))
        return sinks

    def remarks(self, sinks: list[Sink]) -> list[str]:
        """What there is to say of the sinks at the end."""
        from edgepose.sinks.udp import UdpSink

        unsent = sum(sink.unsent for sink in sinks if isinstance(sink, UdpSink))
        if not unsent or self.udp is None:
            return []
        where = f"{self.udp.host}:{self.udp.port}"
        return [f"udp      {unsent} datagrams did not arrive; is anything listening at {where}?"]


def _destination(ctx: click.Context, param: click.Parameter, value: str | None) -> Destination | None:
    from edgepose.sinks.udp import parse_destination

    try:
        return None if value is None else parse_destination(value)
    except EdgeposeError as error:
        raise click.BadParameter(str(error)) from None


def output_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Adds the flags that say where poses go; the command gets them as `outputs: OutputFlags`."""
    flags = [
        click.option("--csv", metavar="FILE", help="Write poses as CSV; - is standard output."),
        click.option(
            "--rotations",
            type=click.Choice(["axis-angle", "quat", "matrix", "euler"]),
            default="axis-angle",
            show_default=True,
            help="Representation of rotations in the CSV.",
        ),
        click.option(
            "--std",
            is_flag=True,
            help="Add the network's standard deviation of each joint to the CSV, radians.",
        ),
        click.option(
            "--udp",
            callback=_destination,
            metavar="HOST:PORT[,format=json|binary]",
            help="Send each pose as a datagram.",
        ),
    ]

    @functools.wraps(command)
    def with_outputs(**words: Any) -> Any:
        outputs = OutputFlags(*(words.pop(name) for name in OutputFlags._fields))
        return command(outputs=outputs, **words)

    for flag in reversed(flags):
        with_outputs = flag(with_outputs)
    return with_outputs
