"""The straight pose (N-pose), in which wearers are calibrated."""

from __future__ import annotations

import numpy as np

from edgepose import rotations as rot

from .motion import Array


def straight_pose() -> Array:
    """Return global rotations (24, 3, 3) of the straight pose: the zero pose with hanging arms."""
    pose = np.tile(np.eye(3), (24, 1, 1))
    pose[[16, 18, 20, 22]] = rot.rotation_about_axis("z", -np.pi / 2)
    pose[[17, 19, 21, 23]] = rot.rotation_about_axis("z", np.pi / 2)
    return pose
