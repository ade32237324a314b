"""Where a body touches something, and how fast it moves: the labels of the networks' heads for the place."""

from __future__ import annotations

CONTACTS = (
    "left_ankle", "right_ankle", "left_foot", "right_foot", "pelvis", "left_wrist", "right_wrist",
)  # fmt: skip
"""Joints whose contacts are labelled, in the order of all arrays; "foot" is the base of the toes."""

PLACE = len(CONTACTS) + 3
"""Numbers of a frame: one contact for each of these joints, and the velocity of the pelvis."""
