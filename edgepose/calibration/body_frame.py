"""Body frame T in the inertial frame I, from the direction that the wearer faces (DIP eq. 6)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from edgepose import rotations as rot
from edgepose.calibration.checks import tilt_deg
from edgepose.errors import CalibrationError
from edgepose.placements import PLACEMENTS
from edgepose.rotations import Array
from edgepose.utils.similar_names import choices

FRAME_TILT_LIMIT_DEG = 20.0

_UP = np.array([0.0, 0.0, 1.0])


def check_body_frame(text: str) -> str:
    """Return `text` if it is `head`, `SENSOR:AXIS` or `heading:DEG`.

    Raises:
        CalibrationError: it is none of these.
    """
    name, _, value = text.partition(":")
    axis_given = (
        name in PLACEMENTS and len(value.lstrip("+-")) == 1 and value[-1] in "xyz" and len(value) <= 2
    )
    if text != "head" and not axis_given and (name != "heading" or _finite(value) is None):
        hint = "" if name in (*PLACEMENTS, "heading") else f"; {choices(name, PLACEMENTS, 'sensors are')}"
        raise CalibrationError(
            f"body frame {text!r} is none of: head, heading:DEG, SENSOR:AXIS "
            f"(such as heading:90, pelvis:-z){hint}"
        )
    return text


def _finite(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def body_from_inertial(orientation: Array, body_frame: str, names: Sequence[str] = PLACEMENTS) -> Array:
    """Return R_TI (3, 3) of a wearer who holds the calibration pose.

    Args:
        orientation: (N, 4) mean quaternions of the hold, sensor to inertial, headings reset.
        body_frame: `head`: the head sensor's axes lie along T (DIP eq. 6). `SENSOR:AXIS`: the horizontal
            direction of that axis of that sensor is forward, gravity shows which way is up. `heading:DEG`:
            the wearer faces this angle from X of I towards Y.
        names: of the sensors.

    Raises:
        CalibrationError: the way in which the named sensor is worn rules the method out, or there is none.
    """
    name, _, value = check_body_frame(body_frame).partition(":")
    if name != "heading" and name not in names:
        raise CalibrationError(f"body frame {body_frame}: this rig has no {name} sensor; name another one")
    if name == "head":
        return _frame_of_head(rot.quat_to_matrix(orientation[list(names).index(name)]))
    if name == "heading":
        angle = math.radians(float(value))
        return _frame_facing(np.array([math.cos(angle), math.sin(angle), 0.0]))
    axis = rot.quat_to_matrix(orientation[list(names).index(name)])[:, "xyz".index(value[-1])]
    forward = -axis if value[0] == "-" else axis
    from_vertical = min(tilt_deg(forward), 180.0 - tilt_deg(forward))
    if from_vertical < FRAME_TILT_LIMIT_DEG:
        raise CalibrationError(
            f"body frame {body_frame}: this axis is {from_vertical:.0f} deg from vertical; "
            "name an axis that points to the wearer's front, or with - to the back"
        )
    return _frame_facing(forward)


def _frame_of_head(r_is: Array) -> Array:
    tilt = tilt_deg(r_is[:, 1])
    if tilt > FRAME_TILT_LIMIT_DEG:
        raise CalibrationError(
            f"body frame head: the head sensor's Y axis points {tilt:.0f} deg from up; "
            "wear it with X to the left, Y up, Z forward, or choose another --body-frame"
        )
    return r_is.T


def _frame_facing(forward: Array) -> Array:
    """Return R_TI (3, 3) of a wearer who faces the horizontal part of a direction in I."""
    ahead = np.array([forward[0], forward[1], 0.0]) / math.hypot(forward[0], forward[1])
    return np.stack([np.cross(_UP, ahead), _UP, ahead])  # left, up, forward in I
