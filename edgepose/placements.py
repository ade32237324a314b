"""Placements of the six sensors and of those that a rig may have besides, in the order used everywhere."""

from __future__ import annotations

PLACEMENTS = ("left_forearm", "right_forearm", "left_lower_leg", "right_lower_leg", "head", "pelvis")
"""Placement names; index i of any (6, ...) array is the sensor at PLACEMENTS[i]."""

BONES = (18, 19, 4, 5, 15, 0)
"""SMPL joint whose segment carries the sensor, in the order of PLACEMENTS."""

ROOT = PLACEMENTS.index("pelvis")
"""Index of the root sensor."""

LACKING = frozenset(PLACEMENTS) - {PLACEMENTS[ROOT]}
"""Those of the six sensors that a rig may lack, at a price in accuracy."""

SITES = {
    **dict(zip(PLACEMENTS, BONES, strict=True)),
    "chest": 9, "left_shoulder": 13, "right_shoulder": 14, "left_upper_arm": 16, "right_upper_arm": 17,
    "left_hand": 20, "right_hand": 21, "left_upper_leg": 1, "right_upper_leg": 2, "left_foot": 7,
    "right_foot": 8,
}  # fmt: skip
"""Names of all segments that can carry a sensor, and the SMPL joints that move them."""

SENSORS = tuple(SITES)
"""Names of all segments that can carry a sensor, PLACEMENTS first; `ImuSample.sensor` is an index here."""

ADDED = SENSORS[len(PLACEMENTS) :]
"""Segments whose sensors no network needs: they replace its prediction for their own bone."""
