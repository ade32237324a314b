"""The sensors that a rig has besides the six."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edgepose.rotations import Array


@dataclass(frozen=True, eq=False)
class AddedSensors:
    """What a calibration knows of A sensors besides the six.

    Attributes:
        names: of the sensors, some of ADDED, in this order.
        heading_offset: (A,) rotation about Z from each sensor's inertial frame to the common one, rad; NaN
            while it is unknown.
        bone_from_sensor: (A, 4) quaternions of R_BS, the mounting of each sensor on its bone.
        residual_deg: (A,) RMS angle of each sensor about its mean over the hold, degrees.
    """

    names: Sequence[str]
    heading_offset: Array
    bone_from_sensor: Array
    residual_deg: Array


NO_SENSORS = AddedSensors((), np.zeros(0), np.zeros((0, 4)), np.zeros(0))
"""Those of a rig of six sensors."""
