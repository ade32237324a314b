"""Where the six sensors sit, in the one order that the whole program uses."""

from __future__ import annotations

PLACEMENTS = ("left_forearm", "right_forearm", "left_lower_leg", "right_lower_leg", "head", "pelvis")
"""Placement names; index i of any (6, ...) array is the sensor at PLACEMENTS[i]."""

BONES = (18, 19, 4, 5, 15, 0)
"""SMPL joint whose bone carries the sensor, in the order of PLACEMENTS."""

ROOT = PLACEMENTS.index("pelvis")
"""Index of the root sensor."""
