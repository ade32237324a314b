"""The unit of length of a skeleton, judged by the size of the body."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError

from .rest_pose import RestPose
from .skeleton_roles import Roles

Array = NDArray[np.float64]

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048, "cmu": 0.0254 / 0.45}
"""Units of length in metres. CMU's lengths are inches times 0.45, and the BVH conversions kept them."""

STATURES_M = (1.0, 2.3)
"""Plausible statures."""
_USUAL_M = (1.35, 2.1)

_STATURE = 1.2
"""Stature over the height of the head's joint above the ankles."""


def metres(rest: RestPose, roles: Roles, unit: str | float | None = None) -> float:
    """Return the metres in one unit of length of a skeleton.

    Args:
        rest: its rest pose.
        roles: its joints.
        unit: a key of `UNITS`, or metres, if known.

    Raises:
        EdgeposeError: no unit, or more than one, gives a plausible stature.
    """
    ankles = rest.positions[[roles.left.foot, roles.right.foot], 1].mean()
    stature = _STATURE * float(rest.positions[roles.head, 1] - ankles)
    if unit is not None:
        value = UNITS[unit] if isinstance(unit, str) else unit
        if not STATURES_M[0] <= value * stature <= STATURES_M[1]:
            raise EdgeposeError(
                f"a stature of about {value * stature:.3g} m is not plausible; check the unit that is given"
            )
        return value
    for least, most in (_USUAL_M, STATURES_M):
        fits = [name for name, value in UNITS.items() if least <= value * stature <= most]
        if len(fits) == 1:
            return UNITS[fits[0]]
    why = f"{' and '.join(fits)} are possible" if fits else f"that is no person in {', '.join(UNITS)}"
    raise EdgeposeError(
        f"the unit of length is not clear: the body is about {stature:.3g} tall, {why}; give `unit` in "
        "--mapping FILE.toml"
    )


def leg_length(rest: RestPose, roles: Roles) -> float:
    """Return the length of thigh and shank, mean of both sides, in the unit of the rest pose."""
    lengths = [
        np.linalg.norm(rest.positions[end] - rest.positions[start])
        for limb, (start, end) in roles.limbs.items()
        if limb in (1, 2, 4, 5)
    ]
    return float(np.sum(lengths) / 2)
