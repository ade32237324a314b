"""`edgepose view`: show poses as a figure in the browser."""

from __future__ import annotations

import os
from contextlib import ExitStack, closing
from typing import TYPE_CHECKING

import click

from edgepose.cli.options.body import HEIGHT, leg_length_option
from edgepose.cli.options.outputs import address
from edgepose.cli.terminal.messages import say, show
from edgepose.cli.terminal.stop_signal import StopSignal
from edgepose.utils.sockets import address_text, bound_socket

if TYPE_CHECKING:
    from edgepose.skeleton import Body
    from edgepose.viewer.viewer import Viewer


PAGE_PORT = 8080
"""Port of the page without --page-port."""


@click.command()
@click.argument("poses", required=False, metavar="[POSES]")
@click.option(
    "--udp",
    callback=address,
    metavar="HOST:PORT",
    help="Show poses that `edgepose run --udp` sends here, as they arrive.",
)
@click.option(
    "--reference", metavar="FILE", help="File of poses to compare those of POSES with, on one clock."
)
@click.option(
    "--host",
    default="127.0.0.1",
    show_default=True,
    help="Address of the page; 0.0.0.0 makes it visible to other machines.",
)
@click.option(
    "--page-port",
    type=click.IntRange(1, 65535),
    help="TCP port of the page.  [default: 8080]",
)
@click.option("--height", type=HEIGHT, default=1.75, show_default=True, help="Height of the figure, metres.")
@leg_length_option
@click.option("--buttons", is_flag=True, hidden=True, help="Write the keys of pressed buttons to stdout.")
@click.option(
    "--with-parent", is_flag=True, hidden=True, help="Exit when the program that started this one exits."
)
def view(
    poses: str | None,
    udp: tuple[str, int] | None,
    reference: str | None,
    host: str,
    page_port: int | None,
    height: float,
    leg_length: float | None,
    buttons: bool,
    with_parent: bool,
) -> None:
    """Show poses as a 3-D figure in the browser until Ctrl-C: those of a file (CSV, BVH, or NPZ with the keys
    of AMASS) with a timeline, or those that arrive over UDP.

    The command needs `pip install 'edgepose[view]'`. Beside the figure the page shows, for each sensor, new
    values per second, the longest gap, and whether its last values are being repeated.

    \b
    Examples:
      edgepose view poses.csv
      edgepose view poses.csv --reference truth.npz
      edgepose view --udp 127.0.0.1:9000
      edgepose view --udp 0.0.0.0:9000 --host 0.0.0.0
    """
    if (poses is None) == (udp is None):
        both = "" if poses is None else ", not both"
        raise click.UsageError(f"give a file of POSES, or --udp HOST:PORT{both}")
    if reference is not None and poses is None:
        raise click.UsageError("--reference needs a file of POSES")

    from edgepose.formats.poses.registry import read_poses
    from edgepose.skeleton import default_body

    body = default_body(height, leg_length_m=leg_length)
    parent = os.getppid()
    with ExitStack() as stack:
        stop = stack.enter_context(StopSignal())
        if udp is not None:
            receiver = stack.enter_context(bound_socket(*udp))
            viewer = stack.enter_context(closing(_open(host, page_port, body, with_parent)))
            if buttons:
                viewer.add_buttons(show)
            viewer.follow(receiver, lambda: stop.asked or (with_parent and os.getppid() != parent))
        else:
            sequence = read_poses(str(poses))
            reference_sequence = None if reference is None else read_poses(reference)
            viewer = stack.enter_context(closing(_open(host, page_port, body)))
            viewer.play(sequence, reference_sequence, lambda: stop.asked)


def _open(host: str, port: int | None, body: Body, for_run: bool = False) -> Viewer:
    """Open the page; for `edgepose run` without --page-port on the next port that is free."""
    from edgepose.viewer.viewer import Viewer

    viewer = Viewer(host, port or PAGE_PORT, body, next_free=for_run and port is None)
    page = address_text({"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host), viewer.port)
    say(f"open http://{page} in a browser" + ("" if for_run else "; Ctrl-C ends the view"))
    return viewer
