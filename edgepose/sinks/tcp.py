"""Output as text over TCP, in the format of the Unity viewer of TransPose and its successors."""

from __future__ import annotations

import socket
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError
from edgepose.pose import PoseFrame
from edgepose.sinks.base import Sink, SinkContext
from edgepose.sinks.shared_numbers import rotvecs
from edgepose.skeleton import Body, default_body, standing_pelvis_position
from edgepose.utils.sockets import failure_text, resolve

CLIENTS = 16
"""Largest number of viewers at a time; further ones are rejected."""

SEND_BUFFER = 16_384
"""Bytes that the system buffers for a slow viewer, about 20 poses; few, so that it sees the newest ones."""

_TEXT = ",".join(["%g"] * 72) + "#%g,%g,%g$"


def encode(pose: PoseFrame, standing: NDArray[np.float64]) -> bytes:
    """Encode a pose: 72 axis-angle numbers, SMPL order, radians, "#", translation, metres, "$".

    As TransPose's, the translation is 0 where a body that stands straight begins, and where it is unknown.

    Args:
        pose: the pose.
        standing: (3,) position of the pelvis of that body, metres.
    """
    moved = np.zeros(3) if pose.translation is None else pose.translation - standing
    return (_TEXT % (*rotvecs(pose).ravel().tolist(), *moved.tolist())).encode()


@dataclass
class _Viewer:
    """A connection, and the unsent rest of a pose."""

    socket: socket.socket
    rest: bytes = b""


class TcpSink(Sink):
    """Listens for viewers and sends them each pose.

    A run does not wait for viewers. A slow viewer misses poses, which are counted in `missed`, but never gets
    a partial one.
    """

    live = True

    def __init__(self, host: str, port: int, body: Body | None = None) -> None:
        """Listen on an address of this machine.

        Args:
            host: name or address.
            port: TCP port.
            body: the wearer's body; None for the default body.

        Raises:
            EdgeposeError: the address is not this machine's, or another program listens on it.
        """
        self.missed = 0
        self._standing = standing_pelvis_position((body or default_body()).offsets)
        self._viewers: list[_Viewer] = []
        try:
            family, address = resolve(host, port, socket.SOCK_STREAM)
            self._server = socket.create_server(address[:2], family=family, backlog=CLIENTS)
        except (OSError, UnicodeError) as error:
            reason = failure_text(error, host)
            raise EdgeposeError(f"cannot listen for viewers at {host} port {port}: {reason}") from error
        # Connections inherit it.
        self._server.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        self._server.setblocking(False)

    def write(self, pose: PoseFrame) -> None:
        """Send a pose to the connected viewers."""
        self._accept()
        if self._viewers:
            text = encode(pose, self._standing)
            self._viewers = [viewer for viewer in self._viewers if self._offer(viewer, text)]

    def close(self) -> None:
        """Close all connections."""
        for viewer in self._viewers:
            viewer.socket.close()
        self._viewers = []
        self._server.close()

    def _accept(self) -> None:
        try:
            connection, _ = self._server.accept()
        except OSError:  # no connection is waiting, or it has been closed already
            return
        if len(self._viewers) == CLIENTS:
            connection.close()
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._viewers.append(_Viewer(connection))

    def summary_lines(self) -> list[str]:
        """Return a line with the number of missed poses, if any."""
        return (
            [f"tcp      {self.missed} poses were missed by viewers that read too slowly"]
            if self.missed
            else []
        )

    def _offer(self, viewer: _Viewer, text: bytes) -> bool:
        """Send the rest of an earlier pose, then the text; return False if the viewer has disconnected."""
        try:
            while viewer.rest or text:
                if not viewer.rest:
                    viewer.rest, text = text, b""
                viewer.rest = viewer.rest[viewer.socket.send(viewer.rest) :]
        except BlockingIOError:
            self.missed += bool(text)
        except OSError:
            viewer.socket.close()
            return False
        return True


def open_sink(target: tuple[str, int], context: SinkContext) -> Sink:
    """Open a `TcpSink` on a host and port."""
    return TcpSink(*target, context.body)
