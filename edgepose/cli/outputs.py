"""Flags of `edgepose run` that say where poses go, and the sinks they ask for."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from edgepose.errors import EdgeposeError
from edgepose.output_targets import check_output, identity, is_null, is_stream, part_path

if TYPE_CHECKING:
    from edgepose.sinks import Sink
    from edgepose.sinks.udp import Destination


class OutputFlags(NamedTuple):
    """Where poses go: one field a flag; those that are None or false are not asked for."""

    csv: str | None
    rotations: str
    std: bool
    npz: str | None
    bvh: str | None
    udp: Destination | None
    osc: tuple[str, int] | None
    tcp: tuple[str, int] | None
    view: bool
    height: float
    overwrite: bool

    @property
    def any(self) -> bool:
        """Whether there is an output at all."""
        named = (self.csv, self.npz, self.bvh, self.udp, self.osc, self.tcp)
        return self.view or any(output is not None for output in named)

    @property
    def files(self) -> dict[str, str | None]:
        """The files that are written, by flag."""
        # While a run goes on, poses for an NPZ file are in a CSV file beside it.
        growing = None if self.npz is None or is_stream(self.npz) else str(part_path(self.npz))
        return {"--csv": self.csv, "--npz": self.npz, "--bvh": self.bvh, "--npz (while it grows)": growing}

    def check(self) -> None:
        """Make sure that no file is lost by what is asked for.

        Raises:
            EdgeposeError: one is there already, or cannot be written.
        """
        for name, ending in ((self.csv, ".csv"), (self.npz, ".npz"), (self.bvh, ".bvh")):
            if name is not None:
                check_output(name, "poses", (ending,), self.overwrite)

    def open(
        self, stack: ExitStack, rate: float = 60.0, stopped: Callable[[], bool] = lambda: False
    ) -> list[Sink]:
        """The sinks, which the stack closes.

        Args:
            stack: closes them.
            rate: of the poses, per second.
            stopped: whether the run is to end: then a reader that takes nothing is not waited for.

        Raises:
            EdgeposeError: a file or address cannot be written to.
        """
        from edgepose.sinks.files import bvh_sink, csv_sink, npz_sink
        from edgepose.sinks.tcp import TcpSink
        from edgepose.sinks.udp import UdpSink
        from edgepose.sinks.view import ViewSink, check_viewer
        from edgepose.sinks.vmc import VmcSink
        from edgepose.skeleton import default_body

        self.check()
        if self.view:
            check_viewer()
        body = default_body(self.height)
        sinks: list[Sink] = []

        def add(sink: Sink) -> None:
            sinks.append(stack.enter_context(sink))

        # Addresses first: a wrong one is told before anybody is waited for who reads a pipe.
        if self.udp is not None:
            add(UdpSink(*self.udp))
        if self.osc is not None:
            add(VmcSink(*self.osc, body))
        if self.tcp is not None:
            add(TcpSink(*self.tcp))
        if self.npz is not None:
            add(npz_sink(self.npz, rate, overwrite=self.overwrite, stopped=stopped))
        if self.bvh is not None:
            add(bvh_sink(self.bvh, rate, body, overwrite=self.overwrite, stopped=stopped))
        if self.csv is not None:
            add(csv_sink(self.csv, self.rotations, self.std, overwrite=self.overwrite, stopped=stopped))
        for sink in sinks:
            sink.start()
        if self.view:
            add(ViewSink(self.height))
        return sinks

    def remarks(self, sinks: list[Sink]) -> list[str]:
        """What there is to say of the sinks at the end."""
        from edgepose.sinks.tcp import TcpSink
        from edgepose.sinks.udp import UdpSink
        from edgepose.sinks.view import ViewSink
        from edgepose.sinks.vmc import VmcSink

        remarks = []
        for sink in sinks:
            # Of the viewer it does not matter: it may have been closed.
            if isinstance(sink, (UdpSink, VmcSink)) and not isinstance(sink, ViewSink) and sink.unsent:
                name, address = ("osc", self.osc) if isinstance(sink, VmcSink) else ("udp", self.udp)
                where = "" if address is None else f"{address[0]}:{address[1]}"
                remarks.append(
                    f"{name}      {sink.unsent} datagrams did not arrive; is anything listening at {where}?"
                )
            if isinstance(sink, TcpSink) and sink.missed:
                remarks.append(f"tcp      {sink.missed} poses were missed by viewers that read too slowly")
        return remarks


def check_files(outputs: Mapping[str, str | Path | None], inputs: Mapping[str, Path | None]) -> None:
    """Raises click.UsageError where a file to write, by flag, is one to read, or two flags name one file."""
    written: dict[object, str] = {}
    for flag, output in outputs.items():
        if output is None:
            continue
        for name, given in inputs.items():
            if given is not None and _is_same_file(Path(output), given):
                raise click.UsageError(f"{flag} would overwrite {given}, which is {name}; name another file")
        other = written.setdefault(identity(output), flag)
        if other != flag and not is_null(output):
            raise click.UsageError(f"{other} and {flag} name the same file, {output}; name two")


def _is_same_file(output: Path, given: Path) -> bool:
    try:
        return given.samefile(output)
    except OSError:  # there is no such file yet
        return False


def _destination(ctx: click.Context, param: click.Parameter, value: str | None) -> Destination | None:
    from edgepose.sinks.udp import parse_destination

    try:
        return None if value is None else parse_destination(value)
    except EdgeposeError as error:
        raise click.BadParameter(str(error)) from None


def address(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[str, int] | None:
    """Host and port of a flag HOST:PORT, as click's callback."""
    from edgepose.sinks.udp import parse_address

    try:
        if value is not None and "," in value:
            raise EdgeposeError(f"{value!r} is more than HOST:PORT")
        return None if value is None else parse_address(value)
    except EdgeposeError as error:
        raise click.BadParameter(str(error)) from None


overwrite_option = click.option("--overwrite", is_flag=True, help="Replace files that are there already.")
"""The flag --overwrite."""


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
            "--npz", metavar="FILE", help="Write poses as NPZ with the keys of AMASS when the run ends."
        ),
        click.option("--bvh", metavar="FILE", help="Write poses as BVH, for Blender and the like."),
        click.option(
            "--udp",
            callback=_destination,
            metavar="HOST:PORT[,format=json|binary]",
            help="Send each pose as a datagram.",
        ),
        click.option(
            "--osc",
            callback=address,
            metavar="HOST:PORT",
            help="Send each pose by the VMC protocol, for VRM avatars; they listen at port 39539 as a rule.",
        ),
        click.option(
            "--tcp",
            callback=address,
            metavar="HOST:PORT",
            help="Wait here for viewers that read poses as text, as TransPose's does at port 8888.",
        ),
        click.option("--view", is_flag=True, help="Show a figure in the browser, see `edgepose view`."),
        click.option(
            "--height",
            type=float,
            default=1.75,
            show_default=True,
            help="The wearer's stature, for the bones of --bvh, --osc and --view, metres.",
        ),
        overwrite_option,
    ]

    @functools.wraps(command)
    def with_outputs(**words: Any) -> Any:
        outputs = OutputFlags(*(words.pop(name) for name in OutputFlags._fields))
        return command(outputs=outputs, **words)

    for flag in reversed(flags):
        with_outputs = flag(with_outputs)
    return with_outputs
