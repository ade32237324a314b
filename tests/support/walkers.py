"""Samples of simulated wearers who stand, take some steps and stand again."""

from __future__ import annotations

import numpy as np

from edgepose import calibration as cal
from edgepose import rotations as rot
from edgepose.calibration import SensorHold
from edgepose.placements import PLACEMENTS

RATE = 60.0
WALK_S, STEPS = 3.0, 4
HEADINGS = np.radians([40.0, -100.0, 170.0, 10.0, -60.0, 130.0])
"""Rotations about Z from the common frame, in which wearers face X, to each sensor's inertial frame."""

_MOUNTED = rot.rotvec_to_matrix(np.random.default_rng(5).normal(0.0, 1.0, (6, 3)))
_R_IT = cal.body_from_inertial(np.zeros((6, 4)), "heading:0").T


def walker(
    *,
    distance_m: float = 1.4,
    turn_deg: float = 0.0,
    stand_s: tuple[float, float] = (2.0, 2.0),
    drift: float = 0.0,
    lifted_deg: float = 0.0,
) -> list[SensorHold]:
    """Return the samples of six sensors of a wearer who faces X of the common frame.

    Args:
        distance_m: distance straight ahead, metres; negative if the wearer walks backwards.
        turn_deg: turn to the left during the walk.
        stand_s: times of standing before and after the walk, seconds.
        drift: error of the left forearm's acceleration across the walk in the walk's second half, m/s^2.
        lifted_deg: angle by which the right forearm stays lifted at the end.
    """
    before, after = stand_s
    t = np.arange(round((before + WALK_S + after) * RATE)) / RATE
    share = np.clip((t - before) / WALK_S, 0.0, 1.0)
    gone = share - np.sin(2.0 * np.pi * share) / (2.0 * np.pi)  # starts and ends without a jolt
    swing = np.sin(np.pi * share) ** 2 * np.sin(STEPS * np.pi * share)
    yaw = rot.quat_about_z(np.radians(turn_deg) * gone)
    sensors = []
    for i, pose in enumerate(cal.POSES["straight"]):
        side = 1.0 if i in (0, 3) else -1.0
        angle = np.zeros_like(t)
        if i < 2:  # forearms swing
            angle = -0.4 * side * swing + (np.radians(-lifted_deg) * gone if i == 1 else 0.0)
        elif i < 4:  # heels rise behind
            angle = 0.8 * np.maximum(side * swing, 0.0)
        leant = rot.rotvec_to_matrix(np.outer(angle, [1.0, 0.0, 0.0]))
        quat = rot.quat_multiply(yaw, rot.matrix_to_quat(_R_IT @ leant @ pose @ _MOUNTED[i]))
        place = np.stack([distance_m * gone + 0.2 * np.sin(angle), 0.1 * side * swing, 0.02 * swing], axis=1)
        force = np.gradient(np.gradient(place, t, axis=0), t, axis=0)
        force[:, 2] += cal.GRAVITY
        if i == 0:
            force[:, 1] += drift * ((share > 0.5) & (share < 1.0))
        acc = rot.quat_rotate(rot.quat_conjugate(quat), force)
        turned = rot.quat_multiply(rot.quat_about_z(HEADINGS[i]), quat)
        sensors.append(SensorHold(t, turned, acc, np.full_like(acc, np.nan), PLACEMENTS[i]))
    return sensors
