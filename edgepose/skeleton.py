"""The body model: SMPL's 24 joints, a default body from a wearer's height, forward kinematics.

Body frame T is SMPL's: X to the wearer's left, Y up, Z forward. In the zero pose (T-pose) every bone frame
equals T.
"""

from __future__ import annotations

import json
from functools import cache
from importlib import resources
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edgepose.errors import EdgeposeError
from edgepose.placements import PLACEMENTS

Array = NDArray[np.float64]

JOINTS = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle",
    "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head",
    "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
    "left_hand", "right_hand",
)  # fmt: skip
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)

PREDICTED = (1, 2, 3, 4, 5, 6, 9, 12, 13, 14, 15, 16, 17, 18, 19)
"""Joints predicted by the network (DIP 3.4); joint 0 is measured, feet, toes, wrists, hands are at rest."""

UNOBSERVED = (1, 2, 3, 6, 9, 12, 13, 14, 16, 17)
"""Predicted joints whose segments carry no sensor."""

TIPS = {10: (0, 0, 0.06), 11: (0, 0, 0.06), 15: (0, 0.18, 0), 22: (0.08, 0, 0), 23: (-0.08, 0, 0)}
"""End points of the bones without a joint at their end: joint, and tip in its frame, metres."""


def global_rotations(local: ArrayLike) -> Array:
    """Return the global joint rotations R_TB (..., 24, 3, 3) of a posed body.

    Args:
        local: (..., 24, 3, 3) rotation of each joint relative to its parent; joint 0 relative to T.
    """
    local = np.asarray(local, float)
    rotations = np.empty_like(local)
    rotations[..., 0, :, :] = local[..., 0, :, :]
    for j, parent in enumerate(PARENTS[1:], start=1):
        rotations[..., j, :, :] = rotations[..., parent, :, :] @ local[..., j, :, :]
    return rotations


def forward_kinematics(
    local: ArrayLike, offsets: ArrayLike, translation: ArrayLike | None = None
) -> tuple[Array, Array]:
    """Compute the global joint rotations and positions of a posed body.

    Args:
        local: (..., 24, 3, 3) rotation of each joint relative to its parent; joint 0 relative to T.
        offsets: (24, 3) joint position minus its parent's in the zero pose, metres; row 0 the pelvis itself.
        translation: (..., 3) added to all positions, metres.

    Returns:
        (..., 24, 3, 3) global rotations R_TB and (..., 24, 3) positions in T, metres.
    """
    rotations, offsets = global_rotations(local), np.asarray(offsets, float)
    positions = np.empty(rotations.shape[:-1])
    positions[..., 0, :] = offsets[0] if translation is None else offsets[0] + np.asarray(translation, float)
    for j, parent in enumerate(PARENTS[1:], start=1):
        positions[..., j, :] = positions[..., parent, :] + rotations[..., parent, :, :] @ offsets[j]
    return rotations, positions


def local_from_global(rotations: ArrayLike) -> Array:
    """Return the local rotations (..., 24, 3, 3) for global ones: the inverse of `global_rotations`."""
    rotations = np.asarray(rotations, float)
    local = np.swapaxes(rotations[..., list(PARENTS), :, :], -1, -2) @ rotations
    local[..., 0, :, :] = rotations[..., 0, :, :]
    return local


def grounded_pelvis_position(local: ArrayLike, offsets: ArrayLike) -> Array:
    """Return the pelvis position of a body whose lowest joint is on the ground, above the origin of T.

    This is where all outputs show a body if nothing estimates its position.

    Args:
        local: (..., 24, 3, 3) rotation of each joint relative to its parent; joint 0 relative to T.
        offsets: (24, 3) joint position minus its parent's in the zero pose, metres.

    Returns:
        (..., 3) position, metres.
    """
    heights = forward_kinematics(local, offsets)[1][..., 1]
    position = np.zeros((*heights.shape[:-1], 3))
    position[..., 1] = heights[..., 0] - heights.min(axis=-1)
    return position


def standing_pelvis_position(offsets: ArrayLike) -> Array:
    """Return the pelvis position (3,) above ground of a body standing straight, metres; offsets (24, 3)."""
    return grounded_pelvis_position(np.tile(np.eye(3), (len(JOINTS), 1, 1)), offsets)


# --- the default body ------------------------------------------------------------------------------------

MIN_HEIGHT, MAX_HEIGHT = 0.8, 2.5
"""Range of statures that `default_body` accepts, metres; others are mistakes, mostly centimetres."""

MIN_LEG_LENGTH, MAX_LEG_LENGTH = 0.3, 1.5
"""Range of the lengths of legs, which encloses those of all statures, metres."""

DEFAULT_HEIGHT = 1.75
"""Stature of a wearer whose height is unknown, metres."""


MOST_LEG_CHANGE = 0.15
"""Largest share by which `with_leg_length` changes legs; people of one stature differ by less."""

_KNEES_AND_ANKLES = [JOINTS.index(f"{side}_{j}") for side in ("left", "right") for j in ("knee", "ankle")]
_TRUNK = [JOINTS.index(name) for name in ("spine1", "spine2", "spine3", "neck", "head")]
_LOWER_LEGS = [i for i, name in enumerate(PLACEMENTS) if name.endswith("lower_leg")]


class Body(NamedTuple):
    """Bone lengths of one wearer and the points on the skin where virtual sensors sit, metres."""

    offsets: Array
    """(24, 3) joint position minus its parent's in the zero pose, axes of T; row 0, the pelvis, is zero."""
    sensors: Array
    """(6, 3) sensor position minus the segment's joint's, in the segment's frame, in order of PLACEMENTS."""
    height_m: float
    """Stature, crown to sole, metres."""

    @property
    def leg_length_m(self) -> float:
        """Length of thigh and shank, hip joint to ankle, mean of both sides, metres."""
        return float(np.linalg.norm(self.offsets[_KNEES_AND_ANKLES], axis=1).sum() / 2.0)


@cache
def _table() -> dict[str, Any]:
    text = resources.files("edgepose").joinpath("body.json").read_text(encoding="utf-8")
    table: dict[str, Any] = json.loads(text)
    return table


def default_body(
    height_m: float = DEFAULT_HEIGHT, sex: str = "neutral", leg_length_m: float | None = None
) -> Body:
    """Return an average body for a stature.

    Interpolated linearly between the statures of `body.json`, scaled in proportion beyond them.

    Args:
        height_m: stature, metres.
        sex: "neutral", "male" or "female".
        leg_length_m: length of thigh and shank, metres, see `with_leg_length`; None for the average.

    Raises:
        EdgeposeError: an impossible stature or leg length, or an unknown sex.
    """
    table = _table()
    if sex not in table["sexes"]:
        raise EdgeposeError(f"unknown sex {sex!r}: use one of {', '.join(table['sexes'])}")
    if not MIN_HEIGHT <= height_m <= MAX_HEIGHT:  # also true of NaN
        limits = f"{MIN_HEIGHT} and {MAX_HEIGHT} m"
        raise EdgeposeError(
            f"height {height_m:g} m is not between {limits}: give the wearer's height in metres"
        )
    statures = np.array(table["statures"], float)
    clipped_m = float(np.clip(height_m, statures[0], statures[-1]))
    i = int(np.clip(np.searchsorted(statures, clipped_m) - 1, 0, len(statures) - 2))
    t = (clipped_m - statures[i]) / (statures[i + 1] - statures[i])

    def at(rows: Any) -> Array:
        low, high = np.array(rows[i], float), np.array(rows[i + 1], float)
        blend: Array = ((1 - t) * low + t * high) * (height_m / clipped_m)
        return blend

    rows = table["sexes"][sex]
    body = Body(at(rows["offsets"]), at(rows["sensors"]), float(height_m))
    return body if leg_length_m is None else with_leg_length(body, leg_length_m)


def check_measures(height_m: float | None, leg_length_m: float | None) -> None:
    """Check measures of a body, of which those that are None are not known yet.

    Raises:
        EdgeposeError: no body has them.
    """
    if height_m is not None:
        default_body(height_m, leg_length_m=leg_length_m)
    elif leg_length_m is not None and not MIN_LEG_LENGTH <= leg_length_m <= MAX_LEG_LENGTH:
        raise EdgeposeError(
            f"leg length {leg_length_m:g} m is not between {MIN_LEG_LENGTH} and {MAX_LEG_LENGTH} m: give the "
            "length of thigh and shank in metres"
        )


def with_leg_length(body: Body, leg_length_m: float) -> Body:
    """Return a body of the same stature with other legs: what these gain in height, the trunk loses.

    Args:
        body: the body to change.
        leg_length_m: length of thigh and shank, hip joint to ankle, metres.

    Raises:
        EdgeposeError: the legs would differ from the body's by more than `MOST_LEG_CHANGE`.
    """
    ratio = leg_length_m / body.leg_length_m
    if not abs(ratio - 1.0) <= MOST_LEG_CHANGE:  # also true of NaN
        low, high = ((1.0 + change) * body.leg_length_m for change in (-MOST_LEG_CHANGE, MOST_LEG_CHANGE))
        raise EdgeposeError(
            f"leg length {leg_length_m:g} m does not fit a height of {body.height_m:g} m, for which it is "
            f"{low:.2f} to {high:.2f} m: measure from the hip joint to the ankle, in metres, and give the "
            "height as well"
        )
    offsets, sensors = body.offsets.copy(), body.sensors.copy()
    offsets[_KNEES_AND_ANKLES] *= ratio
    sensors[_LOWER_LEGS] *= ratio
    gained_m = standing_pelvis_position(offsets)[1] - standing_pelvis_position(body.offsets)[1]
    offsets[_TRUNK, 1] *= 1.0 - gained_m / offsets[_TRUNK, 1].sum()
    return Body(offsets, sensors, body.height_m)
