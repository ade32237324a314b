"""Poses as text over TCP, as the Unity viewer of TransPose and its successors reads them."""

from __future__ import annotations

import socket
from dataclasses import dataclass

from edgepose.errors import EdgeposeError
from edgepose.pose import PoseFrame
from edgepose.rotations import matrix_to_rotvec
from edgepose.sinks.base import Sink, SinkContext
from edgepose.utils.sockets import resolve

CLIENTS = 16
"""Viewers at a time; more are turned away."""

SEND_BUFFER = 16_384
"""Bytes that the system holds back for a slow viewer, about 20 poses: it should see the newest ones."""

_TEXT = ",".join(["%g"] * 72) + "#%g,%g,%g$"


def encode(pose: PoseFrame) -> bytes:
    """72 axis-angle numbers in SMPL order, radians, "#", the pelvis' place, metres (0 if unknown), "$"."""
    where = (0.0, 0.0, 0.0) if pose.translation is None else tuple(pose.translation)
    return (_TEXT % (*matrix_to_rotvec(pose.rotations).ravel().tolist(), *where)).encode()


@dataclass
class _Viewer:
    """A connection, and what of a pose it has not taken yet."""

    socket: socket.socket
    rest: bytes = b""


class TcpSink(Sink):
    """Waits for viewers and sends them each pose.

    A run goes on whether or not any come, go or read: one that is slow misses poses, which are counted in
    `missed`, but gets none in part.
    """

    def __init__(self, host: str, port: int) -> None:
        """Listen at an address of this machine.

        Raises:
            EdgeposeError: it is not one, or another program listens there.
        """
        self.missed = 0
        self._viewers: list[_Viewer] = []
        try:
            family, address = resolve(host, port, socket.SOCK_STREAM)
            self._server = socket.create_server(address[:2], family=family, backlog=CLIENTS)
        except (OSError, UnicodeError) as error:
            raise EdgeposeError(f"cannot listen for viewers at {host} port {port}: {error}") from error
        self._server.setsockopt(
            socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER
        )  # its connections inherit it
        self._server.setblocking(False)

    def write(self, pose: PoseFrame) -> None:
        """Send a pose to the viewers that are there."""
        self._accept()
        if self._viewers:
            text = encode(pose)
            self._viewers = [viewer for viewer in self._viewers if self._offer(viewer, text)]

    def close(self) -> None:
        """Hang up."""
        for viewer in self._viewers:
            viewer.socket.close()
        self._viewers = []
        self._server.close()

    def _accept(self) -> None:
        try:
            connection, _ = self._server.accept()
        except OSError:  # Nobody, or somebody who has left again.
            return
        if len(self._viewers) == CLIENTS:
            connection.close()
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._viewers.append(_Viewer(connection))

    def summary_lines(self) -> list[str]:
        """How many poses viewers missed."""
        return (
            [f"tcp      {self.missed} poses were missed by viewers that read too slowly"]
            if self.missed
            else []
        )

    def _offer(self, viewer: _Viewer, text: bytes) -> bool:
        """Send what was begun, then the text if all of that has left; False where nobody is there."""
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
    """A `TcpSink` at a host and port."""
    return TcpSink(*target)
