"""Heading reset: how the inertial frames of sensors without a common north lie to each other (DIP 4.5)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from edgepose import rotations as rot
from edgepose.calibration.checks import check_hold
from edgepose.calibration.holds import Hold
from edgepose.errors import EdgeposeError
from edgepose.placements import PLACEMENTS, ROOT
from edgepose.rotations import Array

RESET_TILT_LIMIT_DEG = 15.0


class HeadingReset(NamedTuple):
    """Result of `heading_offsets`.

    Attributes:
        offset: (6,) turn about Z of each sensor's inertial frame to the pelvis sensor's, rad, -pi to pi.
        tilt_deg: (6,) what remains between each sensor and the pelvis sensor after that turn, degrees.
    """

    offset: Array
    tilt_deg: Array


def heading_offsets(still: Hold) -> HeadingReset:
    """Heading reset (DIP 4.5) from all six sensors lying side by side in one orientation.

    Raises:
        EdgeposeError: a sensor moved or does not lie as the pelvis sensor does; names it.
    """
    mean = check_hold(still, "leave the sensors alone and repeat the heading reset").orientation
    between = rot.quat_multiply(mean[ROOT], rot.quat_conjugate(mean))
    offset = np.arctan2(np.sin(yaw := rot.heading(between)), np.cos(yaw))
    tilt = np.degrees(
        2.0 * np.arctan2(np.hypot(between[:, 1], between[:, 2]), np.hypot(between[:, 0], between[:, 3]))
    )
    crooked = [f"{PLACEMENTS[i]} ({tilt[i]:.0f} deg)" for i in np.flatnonzero(tilt > RESET_TILT_LIMIT_DEG)]
    if crooked:
        raise EdgeposeError(
            f"not lying as the {PLACEMENTS[ROOT]} sensor does: {', '.join(crooked)}; "
            "lay all six side by side, same face up, same edge forward, and repeat the heading reset"
        )
    return HeadingReset(offset, tilt)
