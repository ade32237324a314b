"""Output to a figure in the browser, shown by a separate process that cannot delay the run."""

from __future__ import annotations

import logging
import socket
import subprocess
import sys
from importlib.util import find_spec
from threading import Thread
from typing import IO

from edgepose.errors import EdgeposeError
from edgepose.pose import PoseFrame
from edgepose.sinks.base import Sink, SinkContext
from edgepose.sinks.udp import UdpSink
from edgepose.skeleton import Body

_log = logging.getLogger(__name__)

STOP_S = 5.0
"""Longest time to wait for the viewer to exit, seconds."""


class ViewSink(Sink):
    """Starts `edgepose view` and sends it each pose as a datagram; the viewer shows the newest one."""

    live = True

    def __init__(self, body: Body, wearer: str = "") -> None:
        """Store the settings; `start` starts the viewer.

        Args:
            body: body of the figure, whose height and leg length the viewer gets.
            wearer: name before the viewer's messages.

        Raises:
            EdgeposeError: a package that the viewer needs is not installed.
        """
        if find_spec("viser") is None:
            raise EdgeposeError("the viewer needs viser: install it with pip install 'edgepose[view]'")
        self._body, self._wearer = body, wearer
        self._viewer: subprocess.Popen[str] | None = None

    def start(self) -> None:
        """Start the viewer; its messages, such as the address of its page, are logged."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        command = [sys.executable, "-m", "edgepose", "view", "--udp", f"127.0.0.1:{port}", "--with-parent"]
        size = ["--height", str(self._body.height_m), "--leg-length", str(self._body.leg_length_m)]
        self._viewer = subprocess.Popen(
            [*command, *size],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self._viewer.stderr is not None
        Thread(target=_log_lines, args=(self._viewer.stderr, self._wearer), daemon=True).start()
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


def _log_lines(lines: IO[str], wearer: str) -> None:
    # Written by the viewer itself they would appear in the middle of the run's status line.
    with lines:
        for line in lines:
            message = line.rstrip().removeprefix("edgepose: ")
            if message != "stopped":  # by the end of the run, while it was starting
                _log.warning("%s%s", f"{wearer}: " if wearer else "", message)


def open_sink(target: bool, context: SinkContext) -> Sink:
    """Open a `ViewSink`."""
    return ViewSink(context.body, context.wearer)
