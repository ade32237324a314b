"""Output in the VMC protocol (Virtual Motion Capture, OSC over UDP), which programs for VRM avatars read.

Version 2.0 of https://protocol.vmc.info; docs/reference/outputs.md describes the messages.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np

from edgepose.pose import PoseFrame, pelvis_position
from edgepose.rotations import matrix_to_quat, quat_near
from edgepose.sinks.base import Sink, SinkContext
from edgepose.sinks.osc import TO_UNITY, osc_bundle, osc_string
from edgepose.sinks.udp import DatagramSink
from edgepose.skeleton import JOINTS, Body, default_body
from edgepose.utils.sockets import Address

BONES = {
    "Hips": "pelvis",
    "LeftUpperLeg": "left_hip",
    "RightUpperLeg": "right_hip",
    "Spine": "spine1",
    "LeftLowerLeg": "left_knee",
    "RightLowerLeg": "right_knee",
    "Chest": "spine2",
    "LeftFoot": "left_ankle",
    "RightFoot": "right_ankle",
    "LeftToes": "left_foot",
    "RightToes": "right_foot",
    "Neck": "neck",
    "LeftShoulder": "left_collar",
    "RightShoulder": "right_collar",
    "Head": "head",
    "LeftUpperArm": "left_shoulder",
    "RightUpperArm": "right_shoulder",
    "LeftLowerArm": "left_elbow",
    "RightLowerArm": "right_elbow",
    "LeftHand": "left_wrist",
    "RightHand": "right_wrist",
}
"""Bones of VRM's humanoid and the joints that move them.

spine3 would be UpperChest, which an avatar may lack. Instead, Chest gets the rotations of spine2 and spine3
combined, so that head and arms point the same way on every avatar.
"""

_INDEX = [JOINTS.index(joint) for joint in BONES.values()]
_CHEST, _UPPER_CHEST = JOINTS.index("spine2"), JOINTS.index("spine3")
_ON_UPPER_CHEST = [JOINTS.index(name) for name in ("neck", "left_collar", "right_collar")]

_BONE_HEADS = [osc_string("/VMC/Ext/Bone/Pos") + osc_string(",sfffffff") + osc_string(bone) for bone in BONES]
_ROOT = osc_string("/VMC/Ext/Root/Pos") + osc_string(",sfffffff") + osc_string("root")
_OK = osc_string("/VMC/Ext/OK") + osc_string(",i") + struct.pack(">i", 1)
_TIME = osc_string("/VMC/Ext/T") + osc_string(",f")
_HALF = (len(BONES) + 1) // 2
"""Bones in the first datagram: with all of them it would not fit into an Ethernet frame."""


class VmcSink(DatagramSink):
    """Sends each pose as two bundles to one address; see `DatagramSink`."""

    NAME = "osc"

    def __init__(self, host: str, port: int, body: Body | None = None, cast: str = "") -> None:
        """Resolve the host name.

        Args:
            host: name or address.
            port: UDP port.
            body: body whose bone lengths are sent; None for the default body.
            cast: see `DatagramSink`.
        """
        offsets = (body or default_body()).offsets.copy()
        self._offsets = offsets.copy()
        offsets[_ON_UPPER_CHEST] += offsets[_UPPER_CHEST]
        self._positions = offsets[_INDEX] * TO_UNITY
        self._start_s: float | None = None
        self._quats = np.zeros((len(BONES), 4))  # of the pose before
        super().__init__(host, port, cast)

    def encode(self, pose: PoseFrame) -> Sequence[bytes]:
        """Return the two bundles of a pose."""
        if self._start_s is None:
            self._start_s = pose.time_s
        rotations = pose.rotations.copy()
        rotations[_CHEST] = rotations[_CHEST] @ rotations[_UPPER_CHEST]
        # Receivers that smooth or interpolate the numbers would turn a bone round where signs change.
        self._quats = quat_near(matrix_to_quat(rotations[_INDEX]), self._quats)
        w, x, y, z = self._quats.T
        positions = self._positions.copy()
        # The root stands on the floor below the pelvis, so that an avatar whose receiver keeps its own bone
        # positions walks, too.
        x_m, height_m, z_m = pelvis_position(pose, self._offsets) * TO_UNITY + 0.0  # no negative zeros
        root = _ROOT + struct.pack(">7f", x_m, 0, z_m, 0, 0, 0, 1)
        positions[0] = 0.0, height_m, 0.0
        numbers = np.column_stack([positions, x, -y, -z, w]).astype(">f4").tobytes()
        bones = [head + numbers[28 * i : 28 * i + 28] for i, head in enumerate(_BONE_HEADS)]
        # Relative, because single precision cannot hold fractions of a second of Unix time.
        time_s = _TIME + struct.pack(">f", pose.time_s - self._start_s)
        return osc_bundle([_OK, time_s, root, *bones[:_HALF]]), osc_bundle([time_s, *bones[_HALF:]])


def open_sink(target: Address, context: SinkContext) -> Sink:
    """Open a `VmcSink` to an address."""
    return VmcSink(target.host, target.port, context.body, target.cast)
