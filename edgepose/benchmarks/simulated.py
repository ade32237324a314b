"""Simulated sensors for measurements of speed."""

from __future__ import annotations

from math import cos, sin

import numpy as np

from edgepose.calibration import GRAVITY, Calibration
from edgepose.placements import PLACEMENTS
from firmware_protocols.registry import PROTOCOLS
from firmware_protocols.sample import Sample

SENSOR_HZ = 100
"""Samples a second of each sensor."""


def packet(sensor: int, number: int, time_s: float) -> bytes:
    """Return the native packet with a number that a sensor sends at a time, seconds."""
    half = 0.3 * sin(2.0 * time_s)
    turn = (cos(half), 0.6 * sin(half), 0.0, 0.8 * sin(half))
    force, rate, field = (
        (0.1 * sensor, 0.2, GRAVITY),
        (0.36 * cos(2.0 * time_s), 0.0, 0.0),
        (20.0, 0.0, -40.0),
    )
    data: bytes = PROTOCOLS["native"].encode(
        Sample(sensor, 1_000_000 + int(1e6 * time_s), turn, force, rate, field), number
    )
    return data


def calibration() -> Calibration:
    """Return the calibration of sensors aligned with their bones in the T-pose."""
    none = np.tile([1.0, 0.0, 0.0, 0.0], (len(PLACEMENTS), 1))
    up = np.array([0.5, -0.5, -0.5, -0.5])  # T's Y is I's Z
    zero = np.zeros(len(PLACEMENTS))
    return Calibration(up, zero, none, zero, "t-pose", "heading:0", "", {})
