"""Output to a figure in the browser, shown by a separate process that cannot delay the run."""

from __future__ import annotations

import socket
import subprocess
import sys
from importlib.util import find_spec

from edgepose.errors import EdgeposeError
from edgepose.pose import PoseFrame
from edgepose.sinks.base import Sink, SinkContext
from edgepose.sinks.udp import UdpSink

STOP_S = 5.0
"""Longest time to wait for the viewer to exit, seconds."""


class ViewSink(Sink):
    """Starts `edgepose view` and sends it each pose as a datagram; the viewer shows the newest one."""

    live = True

    def __init__(self, height_m: float) -> None:
        """Store the settings; `start` starts the viewer.

        Args:
            height_m: stature of the figure, metres.

        Raises:
            EdgeposeError: a package that the viewer needs is not installed.
        """
        if find_spec("viser") is None:
            raise EdgeposeError("the viewer needs viser: install it with pip install 'edgepose[view]'")
        self._height_m = height_m
        self._viewer: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start the viewer, which prints the address of its page on standard error."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        command = [sys.executable, "-m", "edgepose", "view", "--udp", f"127.0.0.1:{port}", "--with-parent"]
        self._viewer = subprocess.Popen(
            [*command, "--height", str(self._height_m)], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL
        )
        self._datagrams = UdpSink("127.0.0.1", port, "binary")

    def write(self, pose: PoseFrame) -> None:
        """Send a pose, even if the viewer has been closed."""
        self._datagrams.write(pose)

    def close(self) -> None:
        """Stop the viewer; a second call does nothing."""
        if self._viewer is None:
            return
        self._datagrams.close()
        self._viewer.terminate()
        try:
            self._viewer.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self._viewer.kill()
            self._viewer.wait()


def open_sink(target: bool, context: SinkContext) -> Sink:
    """Open a `ViewSink`."""
    return ViewSink(context.height)
