"""Where sensors sit on a wearer's body."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from edgepose.offline.kinematics import SensorPoints
from edgepose.placements import PLACEMENTS, SITES
from edgepose.skeleton import PARENTS, Body


def sensor_points(body: Body, names: Sequence[str], scale: float = 1.0) -> SensorPoints:
    """Sensors by bone on a body, all lengths times `scale` (SIP-110 is 1.1).

    The six placements have points on the skin; others are taken to sit in the middle of their bone.
    """
    offsets = body.offsets.copy()
    offsets[0] = 0.0
    points = [
        body.sensors[PLACEMENTS.index(name)] if name in PLACEMENTS else offsets[_next(SITES[name])] / 2.0
        for name in names
    ]
    return SensorPoints(scale * offsets, np.array([SITES[name] for name in names]), scale * np.array(points))


def _next(joint: int) -> int:
    """The joint at the far end of a bone; of the chest, towards the neck."""
    children = [child for child, parent in enumerate(PARENTS) if parent == joint]
    return children[0]
