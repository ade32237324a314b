"""Output as the UDP stream of Sony's mocopi, for its receivers in Unity, Unreal, MotionBuilder and Blender.

Sony publishes the bones and the port, not the bytes. docs/reference/outputs.md describes them, as they are
known from other programs that read and write them.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from edgepose.pose import PoseFrame, pelvis_position
from edgepose.rotations import quat_near
from edgepose.sinks.base import Sink, SinkContext
from edgepose.sinks.shared_numbers import quats
from edgepose.sinks.udp import DatagramSink
from edgepose.skeleton import JOINTS, Body, default_body, standing_pelvis_position
from edgepose.utils.sockets import Address

Array = NDArray[np.float64]

BONES = (
    ("root", -1, "pelvis"),
    *(("torso_1", 0, ""), ("torso_2", 1, ""), ("torso_3", 2, "spine1"), ("torso_4", 3, "")),
    *(("torso_5", 4, "spine2"), ("torso_6", 5, ""), ("torso_7", 6, "spine3")),
    *(("neck_1", 7, "neck"), ("neck_2", 8, ""), ("head", 9, "head")),
    *(("l_shoulder", 7, "left_collar"), ("l_up_arm", 11, "left_shoulder")),
    *(("l_low_arm", 12, "left_elbow"), ("l_hand", 13, "left_wrist")),
    *(("r_shoulder", 7, "right_collar"), ("r_up_arm", 15, "right_shoulder")),
    *(("r_low_arm", 16, "right_elbow"), ("r_hand", 17, "right_wrist")),
    *(("l_up_leg", 0, "left_hip"), ("l_low_leg", 19, "left_knee")),
    *(("l_foot", 20, "left_ankle"), ("l_toes", 21, "left_foot")),
    *(("r_up_leg", 0, "right_hip"), ("r_low_leg", 23, "right_knee")),
    *(("r_foot", 24, "right_ankle"), ("r_toes", 25, "right_foot")),
)
"""Name, parent and joint of each bone.

Bones without a joint never rotate, and divide the way to the next one that has a joint.
"""

_MOVED = [i for i, (_, _, joint) in enumerate(BONES) if joint]
_JOINTS = [JOINTS.index(joint) for _, _, joint in BONES if joint]
_NO_ROTATION = (0.0, 0.0, 0.0, -1.0)
"""Quaternion x, y, z, w as mocopi sends it."""


def rest_positions(offsets: Array) -> Array:
    """Return the positions (27, 3) of the bones in the T-pose against their parents, metres.

    Args:
        offsets: (24, 3) joint position minus its parent's in the zero pose, metres.
    """
    positions = np.zeros((len(BONES), 3))
    positions[_MOVED] = offsets[_JOINTS]
    positions[0] = standing_pelvis_position(offsets)
    between: list[int] = []
    for i, (_, _, joint) in enumerate(BONES):
        between.append(i)
        if joint:
            positions[between] = positions[i] / len(between)
            between = []
    return positions


def _chunk(tag: bytes, *parts: bytes) -> bytes:
    content = b"".join(parts)
    return struct.pack("<I4s", len(content), tag) + content


def _transforms(tag: bytes, heads: Iterable[bytes], numbers: Array) -> bytes:
    """Return a chunk for each bone: its head, and its quaternion x, y, z, w and position, numbers (27, 7)."""
    rows = numbers.astype("<f4")
    return b"".join(
        _chunk(tag, head, _chunk(b"tran", row.tobytes())) for head, row in zip(heads, rows, strict=True)
    )


_IDS = [_chunk(b"bnid", struct.pack("<H", i)) for i in range(len(BONES))]
_PARENTS = [_chunk(b"pbid", struct.pack("<h", parent)) for _, parent, _ in BONES]


class MocopiSink(DatagramSink):
    """Sends each pose as one datagram, and the skeleton with the first one and once a second.

    The body frame T is mocopi's frame, too: X to the left, Y up, Z forward.
    """

    NAME = "mocopi"

    def __init__(
        self, host: str, port: int, body: Body | None = None, rate: float = 60.0, cast: str = ""
    ) -> None:
        """Resolve the host name.

        Args:
            host: name or address.
            port: UDP port.
            body: body whose bone lengths are sent; None for the default body.
            rate: poses per second.
            cast: see `DatagramSink`.
        """
        super().__init__(host, port, cast)
        self._offsets = (body or default_body()).offsets
        sender = bytes(4)
        if self._socket.family == socket.AF_INET:
            sender = socket.inet_aton(self._socket.getsockname()[0])
        address = struct.pack("<4H", *sender)
        self._start = _chunk(
            b"head", _chunk(b"ftyp", b"sony motion format"), _chunk(b"vrsn", b"\x01")
        ) + _chunk(b"sndf", _chunk(b"ipad", address), _chunk(b"rcvp", struct.pack("<H", port)))
        self._numbers = np.zeros((len(BONES), 7))
        self._numbers[:, :4] = _NO_ROTATION
        self._numbers[:, 4:] = rest_positions(self._offsets)
        heads = [id + parent for id, parent in zip(_IDS, _PARENTS, strict=True)]
        bones = _transforms(b"bndt", heads, self._numbers)
        self._skeleton = self._start + _chunk(b"skdf", _chunk(b"bons", bones))
        frame = _transforms(b"btdt", _IDS, self._numbers)
        bone = [("head", f"V{len(frame) // len(BONES) - 28}"), ("numbers", "<f4", 7)]
        self._bones = np.frombuffer(bytearray(frame), bone)
        self._every, self._count = max(1, round(rate)), 0
        self._start_s: float | None = None

    def encode(self, pose: PoseFrame) -> Sequence[bytes]:
        """Return the datagram of a pose, and that of the skeleton before it when it is due."""
        if self._start_s is None:
            self._start_s = pose.time_s
        moved = quats(pose)[_JOINTS][:, [1, 2, 3, 0]]
        # Against those of the pose before, so that receivers that interpolate do not turn a bone round.
        self._numbers[_MOVED, :4] = quat_near(moved, self._numbers[_MOVED, :4])
        self._numbers[0, 4:] = pelvis_position(pose, self._offsets)
        self._bones["numbers"] = self._numbers
        frame = _chunk(
            b"fram",
            _chunk(b"fnum", struct.pack("<I", pose.index & 0xFFFFFFFF)),
            _chunk(b"time", struct.pack("<f", pose.time_s - self._start_s)),
            _chunk(b"uttm", struct.pack("<d", pose.time_s)),
            _chunk(b"btrs", self._bones.tobytes()),
        )
        due = self._count % self._every == 0
        self._count += 1
        return (self._skeleton, self._start + frame) if due else (self._start + frame,)


def open_sink(target: Address, context: SinkContext) -> Sink:
    """Open a `MocopiSink` to an address."""
    return MocopiSink(target.host, target.port, context.body, context.rate, target.cast)
