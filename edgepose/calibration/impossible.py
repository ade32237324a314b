"""Detection of bones that stay in orientations which no body can take."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np

from edgepose.placements import PLACEMENTS, ROOT
from edgepose.rotations import Array

IMPOSSIBLE_S = 3.0
"""Time in an impossible orientation before a bone is reported: sensors may be knocked for a moment."""

BACKWARD_S = 4.0
"""Time for which a forearm must point back, less that for which it points forward, before it is reported.

In 38 minutes of motion capture (sport, dance, work) no take got beyond 0.5 s.
"""

_MOST_DEG: Mapping[str, tuple[float, float]] = {
    "head": (120.0, 140.0),
    "left_lower_leg": (165.0, 130.0),
    "right_lower_leg": (165.0, 130.0),
}
"""Largest possible angles between a bone's Y (along the body) and X (to the left) and those of the pelvis.

A head nods and turns by about 120 with the whole back, a knee bends to 155, legs cross at 100.
"""

_BACKWARD = 0.6  # cosine between a forearm and the pelvis' backward direction
_UPRIGHT = math.cos(math.radians(30.0))  # the arms of a wearer who leans back hang behind the trunk

_TURNED = (
    "turned against the pelvis as no body can turn; check that the calibration is of this wearer and rig and "
    "that no sensor has moved, or calibrate again"
)
_BENT = (
    "bent backwards as no arm bends; check that left and right are not exchanged and that no sensor has "
    "moved, or calibrate again"
)


class ImpossibleBones:
    """Adds up the time for which bones are impossible, and reports each bone once."""

    def __init__(self) -> None:
        """Start with no time."""
        self._turned_s = dict.fromkeys(_MOST_DEG, 0.0)
        self._bent_s = dict.fromkeys(PLACEMENTS[:2], 0.0)

    def update(self, bones: Array, held: Iterable[bool], passed_s: float) -> dict[str, str]:
        """Return by placement what is wrong with the bones that have now been impossible for too long.

        Args:
            bones: (6, 3, 3) R_TB, in the order of PLACEMENTS.
            held: (6,) the sensors that sent nothing new, whose bones are ignored.
            passed_s: time since the last call, seconds.
        """
        silent = {name for name, is_held in zip(PLACEMENTS, held, strict=True) if is_held}
        wrong = set(impossible_bones(bones)) - silent
        reported = {}
        for name, since_s in self._turned_s.items():
            self._turned_s[name] = since_s + passed_s if name in wrong else min(since_s, 0.0)
            if self._turned_s[name] > IMPOSSIBLE_S:
                self._turned_s[name] = -math.inf
                reported[name] = _TURNED
        forward = np.zeros(2) if {*PLACEMENTS[:2], "pelvis"} & silent else forearms_forward(bones)
        for (name, bent_s), share in zip(self._bent_s.items(), forward, strict=True):
            sign = float(share < -_BACKWARD) - float(share > _BACKWARD)
            if bent_s >= 0.0:  # not reported yet
                self._bent_s[name] = max(bent_s + sign * passed_s, 0.0)
            if self._bent_s[name] > BACKWARD_S:
                self._bent_s[name] = -math.inf
                reported[name] = _BENT
        return reported


def impossible_bones(bones: Array) -> list[str]:
    """Return the names of bones in orientations that no body can take.

    Args:
        bones: (6, 3, 3) R_TB, in the order of PLACEMENTS.
    """
    pelvis = bones[ROOT]
    # Cosines between the axes of a bone and those of the pelvis.
    x, y = (np.einsum("sa,a->s", bones[:, :, axis], pelvis[:, axis]) for axis in (0, 1))
    result = []
    for name, (along, across) in _MOST_DEG.items():
        i = PLACEMENTS.index(name)
        if y[i] < math.cos(math.radians(along)) or x[i] < math.cos(math.radians(across)):
            result.append(name)
    return result


def forearms_forward(bones: Array) -> Array:
    """Return the cosines (2,) between left and right forearm and the pelvis' forward direction.

    Zero unless the pelvis is upright.

    Args:
        bones: (6, 3, 3) R_TB, in the order of PLACEMENTS.
    """
    pelvis = bones[ROOT]
    if pelvis[1, 1] < _UPRIGHT:
        return np.zeros(2)
    along = np.stack([bones[0, :, 0], -bones[1, :, 0]])  # in the zero pose, the arms point to the sides
    return np.asarray(along @ pelvis[:, 2])
