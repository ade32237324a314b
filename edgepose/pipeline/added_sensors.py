"""The stage after the network in which sensors besides the six replace its prediction for their bones.

A bone's correction is the rotation from its prediction to its measurement, in the bone's own frame, or none
while its sensor is silent. When a sensor falls silent or comes back, the change of its correction is added to
the pose and then taken back at a limited rate, so that no bone jumps. Otherwise bones are as measured.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.imu import AddedFrame
from edgepose.placements import SITES
from edgepose.pose import PoseFrame
from edgepose.skeleton import JOINTS, PARENTS, global_rotations, local_from_global

Array = NDArray[np.float64]

RATE = math.radians(45.0)
"""Rate at which a bone moves from its prediction to its measurement, or back, rad/s."""

_FOLLOWING = frozenset(
    JOINTS.index(name)
    for name in ("neck", "left_collar", "right_collar", "left_foot", "right_foot", "left_hand", "right_hand")
)
"""Joints without a sensor that keep their rotation relative to a corrected parent; others keep theirs in T.

`tools/bench_rigs.py` measures which is nearer to the truth.
"""

_CHEST = SITES["chest"]
_SPINE = {JOINTS.index("spine1"): 1.0 / 3.0, JOINTS.index("spine2"): 2.0 / 3.0}
"""Shares of the chest's correction that the bones between pelvis and chest get."""


class AddedSensorStage:
    """Measured bones of one wearer, besides those of the six sensors.

    Attributes:
        names: of the sensors.
    """

    def __init__(self, names: Sequence[str]) -> None:
        """Start without a pose.

        Args:
            names: of the sensors, in the order of `AddedFrame`.
        """
        self.names = names
        self._joints = [SITES[name] for name in names]
        self._live = np.zeros(len(names), bool)
        self._shown = np.tile(np.eye(3), (len(names), 1, 1))  # corrections of the last pose
        self._rest = self._shown.copy()  # what is still to be taken back
        self._last_s: float | None = None

    def correct(self, pose: PoseFrame, measured: AddedFrame) -> PoseFrame:
        """Return a pose with the measured bones, and with the names of held sensors.

        Args:
            pose: as predicted.
            measured: of the same frame, calibrated.
        """
        assert measured.bones is not None
        bones = global_rotations(pose.rotations)
        live = ~measured.held & np.isfinite(measured.bones).all(axis=(1, 2))
        predicted = bones[self._joints]
        wanted = np.where(live[:, None, None], rot.transpose(predicted) @ measured.bones, np.eye(3))
        corrections = self._without_jumps(pose.time_s, wanted, live)
        corrected = _with_corrections(bones, dict(zip(self._joints, corrections, strict=True)))
        std = pose.std.copy()
        std[[joint for joint, is_live in zip(self._joints, live, strict=True) if is_live]] = 0.0
        held = [name for name, is_held in zip(self.names, measured.held, strict=True) if is_held]
        return pose._replace(
            rotations=local_from_global(corrected).astype(pose.rotations.dtype),
            std=std,
            held=pose.held.union(held),
        )

    def _without_jumps(self, time_s: float, wanted: Array, live: NDArray[np.bool_]) -> Array:
        """Return the corrections (A, 3, 3) to show, which reach the wanted ones at a limited rate."""
        if self._last_s is None:
            self._live, self._shown = live, wanted
        changed = live != self._live
        self._rest[changed] = rot.transpose(wanted[changed]) @ self._shown[changed]
        angles = rot.geodesic_angle(self._rest, np.eye(3))
        if angles.any():
            step = RATE * (0.0 if self._last_s is None else max(time_s - self._last_s, 0.0))
            left = np.maximum(angles - step, 0.0) / np.maximum(angles, 1e-9)
            self._rest = rot.rotvec_to_matrix(rot.matrix_to_rotvec(self._rest) * left[:, None])
            wanted = wanted @ self._rest
        self._live, self._shown, self._last_s = live, wanted, time_s
        return wanted


def _with_corrections(bones: Array, corrections: Mapping[int, Array]) -> Array:
    """Return global rotations (24, 3, 3) with corrections by joint, and with what follows from them."""
    result = bones.copy()
    for joint, correction in corrections.items():
        result[joint] = bones[joint] @ correction
    for joint, parent in enumerate(PARENTS):
        if joint in _FOLLOWING and joint not in corrections:
            result[joint] = result[parent] @ bones[parent].T @ bones[joint]
    if _CHEST in corrections:
        vector = rot.matrix_to_rotvec(corrections[_CHEST])
        for joint, share in _SPINE.items():
            result[joint] = bones[joint] @ rot.rotvec_to_matrix(share * vector)
    return result
