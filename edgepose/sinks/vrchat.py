"""Output as OSC trackers of VRChat: positions and rotations of up to eight trackers and the head.

https://docs.vrchat.com/docs/osc-trackers; docs/reference/outputs.md describes the messages.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edgepose.pose import PoseFrame, pelvis_position
from edgepose.rotations import matrix_to_euler_zxy, transpose
from edgepose.sinks.base import Sink, SinkContext
from edgepose.sinks.osc import TO_UNITY, osc_bundle, osc_string
from edgepose.sinks.udp import DatagramSink
from edgepose.skeleton import JOINTS, Body, default_body, forward_kinematics
from edgepose.utils.sockets import Destination

Array = NDArray[np.float64]

TRACKERS = {
    "1": ("pelvis", "pelvis"),
    "2": ("left_ankle", "left_ankle"),
    "3": ("right_ankle", "right_ankle"),
    "4": ("left_knee", "left_hip"),
    "5": ("right_knee", "right_hip"),
    "6": ("spine3", "spine3"),
    "7": ("left_elbow", "left_shoulder"),
    "8": ("right_elbow", "right_shoulder"),
    "head": ("head", "head"),
}
"""The joint at which each tracker is, and the joint that rotates it.

Hip, feet, knees on the thighs, chest, elbows on the upper arms. SlimeVR uses the same numbers, so that other
receivers know them, too.
"""


def unity_euler_deg(rotations: Array) -> Array:
    """Return the angles (N, 3) about x, y, z of rotations (N, 3, 3) in T as Unity takes them, degrees.

    Unity rotates about z first, then about x, then about y, all of them fixed axes.
    """
    # R = Ry Rx Rz, so its inverse is Rz Rx Ry of the opposite angles.
    z, x, y = -matrix_to_euler_zxy(transpose(rotations)).T
    # Mirrored at x, as points are by TO_UNITY.
    return np.degrees(np.stack([x, -y, -z], axis=-1)) + 0.0  # no negative zeros


class VrchatSink(DatagramSink):
    """Sends each pose as one bundle to one address; see `DatagramSink`."""

    NAME = "vrchat"

    def __init__(
        self, host: str, port: int, trackers: str = "8", cast: str = "", body: Body | None = None
    ) -> None:
        """Resolve the host name.

        Args:
            host: name or address.
            port: UDP port.
            trackers: number of trackers, the first ones of `TRACKERS`; the head is sent in any case.
            cast: see `DatagramSink`.
            body: the wearer's body; None for the default body.
        """
        self._offsets = (body or default_body()).offsets
        sent = [*list(TRACKERS)[: int(trackers)], "head"]
        places, rotators = zip(*(TRACKERS[name] for name in sent), strict=True)
        self._places, self._rotators = (
            [JOINTS.index(joint) for joint in each] for each in (places, rotators)
        )
        self._heads = [
            osc_string(f"/tracking/trackers/{name}/{what}") + osc_string(",fff")
            for name in sent
            for what in ("position", "rotation")
        ]
        super().__init__(host, port, cast)

    def encode(self, pose: PoseFrame) -> Sequence[bytes]:
        """Return the bundle of a pose."""
        where = pelvis_position(pose, self._offsets)
        rotations, positions = forward_kinematics(pose.rotations, self._offsets, where)
        numbers = np.stack(
            [positions[self._places] * TO_UNITY, unity_euler_deg(rotations[self._rotators])], axis=1
        )
        rows = numbers.reshape(-1, 3).astype(">f4")
        return (osc_bundle([head + row.tobytes() for head, row in zip(self._heads, rows, strict=True)]),)


def open_sink(target: Destination, context: SinkContext) -> Sink:
    """Open a `VrchatSink` to an address."""
    return VrchatSink(*target, body=context.body)
