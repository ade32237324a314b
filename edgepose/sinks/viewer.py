"""Output to a figure in the browser, shown by a separate process that cannot delay the run."""

from __future__ import annotations

import logging
import socket
import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from threading import Thread
from typing import IO

from edgepose.errors import EdgeposeError
from edgepose.pose import PoseFrame
from edgepose.sinks.base import Sink, SinkContext
from edgepose.sinks.udp import UdpSink
from edgepose.skeleton import Body
from edgepose.utils.sockets import check_page

_log = logging.getLogger(__name__)

STOP_S = 5.0
"""Longest time to wait for the viewer to exit, seconds."""


class ViewSink(Sink):
    """Starts `edgepose view` and sends it each pose as a datagram; the viewer shows the newest one."""

    live = True

    def __init__(
        self,
        body: Body,
        wearer: str = "",
        page_port: int | None = None,
        press: Callable[[str], None] | None = None,
    ) -> None:
        """Store the settings; `start` starts the viewer.

        Args:
            body: body of the figure, whose height and leg length the viewer gets.
            wearer: name before the viewer's messages.
            page_port: TCP port of the page; None for the next one that is free.
            press: called with the key of each button that is pressed on the page; None shows no buttons.

        Raises:
            EdgeposeError: a package that the viewer needs is not installed, or the port is taken.
        """
        if find_spec("viser") is None:
            raise EdgeposeError("the viewer needs viser: install it with pip install 'edgepose[view]'")
        if page_port is not None:
            check_page("127.0.0.1", page_port)
        self._body, self._wearer, self._page_port, self._press = body, wearer, page_port, press
        self._viewer: subprocess.Popen[str] | None = None

    def start(self) -> None:
        """Start the viewer; its messages, such as the address of its page, are logged."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        command = [sys.executable, "-m", "edgepose", "view", "--udp", f"127.0.0.1:{port}", "--with-parent"]
        size = ["--height", str(self._body.height_m), "--leg-length", str(self._body.leg_length_m)]
        if self._page_port is not None:
            size += ["--page-port", str(self._page_port)]
        # Buttons come back through a pipe, which no other program can write to.
        buttons = [] if self._press is None else ["--buttons"]
        self._viewer = subprocess.Popen(
            [*command, *size, *buttons],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL if self._press is None else subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self._viewer.stderr is not None
        Thread(target=_log_lines, args=(self._viewer.stderr, self._wearer), daemon=True).start()
        if self._press is not None:
            assert self._viewer.stdout is not None
            Thread(target=_press_keys, args=(self._viewer.stdout, self._press), daemon=True).start()
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


def _press_keys(lines: IO[str], press: Callable[[str], None]) -> None:
    with lines:
        for line in lines:
            press(line.rstrip())


def open_sink(target: bool, context: SinkContext) -> Sink:
    """Open a `ViewSink`."""
    return ViewSink(context.body, context.wearer, context.page_port, context.press)
