"""Heading reset from motion: the flexion of segments shows which way the wearer faces.

The axis of a segment that was vertical in the straight pose leans forward when the trunk bows or a heel is
lifted behind, and back when a forearm is lifted forward. A limb's rotation about that axis would distort the
direction of its angular rate, but does not change where the axis points.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from edgepose import rotations as rot
from edgepose.calibration.heading_reset import HeadingReset, WeakMotionError
from edgepose.calibration.static_pose import Hold, check_reported, sensor_names
from edgepose.rotations import Array

MIN_LEAN_DEG = 6.0
"""Smallest lean that counts; less is swaying. A walker's pelvis leans by 8 to 10."""

SPREAD_WARNING_DEG, SPREAD_LIMIT_DEG = 30.0, 40.0
ONE_WAY = 0.4
"""Smallest surplus of lean to one side, as a share; with less, forward cannot be told from back."""


class Exercise(NamedTuple):
    """One part of the motion that `ROUTINE` asks for: the instruction, and the sensors that it moves."""

    text: str
    sensors: tuple[str, ...]


ROUTINE = (
    Exercise("Bow forward and straighten up, twice", ("head", "pelvis")),
    Exercise("Lift the LEFT forearm forward and lower it, twice", ("left_forearm",)),
    Exercise("Lift the RIGHT forearm forward and lower it, twice", ("right_forearm",)),
    Exercise("Lift the LEFT heel up behind you and put it down, twice", ("left_lower_leg",)),
    Exercise("Lift the RIGHT heel up behind you and put it down, twice", ("right_lower_leg",)),
)
_MORE = (
    Exercise("Lift the LEFT arm forward, stretched, and lower it, twice", ("left_upper_arm",)),
    Exercise("Lift the RIGHT arm forward, stretched, and lower it, twice", ("right_upper_arm",)),
    Exercise("Lift the LEFT knee in front of you and lower it, twice", ("left_upper_leg",)),
    Exercise("Lift the RIGHT knee in front of you and lower it, twice", ("right_upper_leg",)),
)

EXERCISE_S = 4.0
"""Time for each exercise, seconds."""

_BACK = tuple(
    f"{side}_{part}" for side in ("left", "right") for part in ("forearm", "upper_arm", "hand", "upper_leg")
)
"""Sensors whose segments lean back when they are lifted forward."""

_STEP_S = 0.1


def routine(names: Sequence[str]) -> list[Exercise]:
    """Return the movements that show the headings of a rig's sensors; others move along with these."""
    return [each for each in (*ROUTINE, *_MORE) if any(name in names for name in each.sensors)]


def headings_from_motion(moving: Hold, upright: Array) -> HeadingReset:
    """Reset headings from movements of a wearer who faces one way; the common frame's X axis is forward.

    Args:
        moving: samples of the movements; `ROUTINE` is best, walking works.
        upright: (N, 4) mean quaternions of the straight pose, held shortly before or after.

    Raises:
        WeakMotionError: a sensor was moved too little, in all directions, or forward as much as back.
    """
    check_reported(moving)
    lean_of = [leans(s.quat, mean) for s, mean in zip(moving, upright, strict=True)]
    forward, spread, wrong = [], [], []
    names = sensor_names(moving)
    for name, lean in zip(names, lean_of, strict=True):
        direction, spread_deg, one_way = main_direction(lean)
        reach = np.degrees(np.arcsin(min(1.0, np.percentile(np.linalg.norm(lean, axis=-1), 98))))
        if reach < MIN_LEAN_DEG:
            wrong.append(f"{name} leaned by only {reach:.0f} deg")
        elif spread_deg > SPREAD_LIMIT_DEG:
            wrong.append(f"{name} leaned in all directions ({spread_deg:.0f} deg)")
        elif one_way < ONE_WAY:
            wrong.append(f"{name} leaned forward as much as back")
        forward.append(-direction if name in _BACK else direction)
        spread.append(spread_deg)
    if wrong:
        raise WeakMotionError(
            f"no heading from this motion: {', '.join(wrong)}; face one way, bow, and lift each forearm "
            "forward and each heel behind, with clear movements"
        )
    ahead = np.array(forward)
    warnings = [
        f"the heading of {name} is only known to {spread_deg:.0f} deg: its movements went different ways"
        for name, spread_deg in zip(names, spread, strict=True)
        if spread_deg > SPREAD_WARNING_DEG
    ]
    warnings += _wrong_order(names, [s.time_s for s in moving], lean_of)
    return HeadingReset(-np.arctan2(ahead[:, 1], ahead[:, 0]), np.array(spread), warnings, names)


def leans(quat: Array, upright: Array) -> Array:
    """Return the level part (n, 2), in I, of the axis that was vertical in the straight pose."""
    vertical = rot.quat_rotate(rot.quat_conjugate(upright), [0.0, 0.0, 1.0])
    return rot.quat_rotate(quat, vertical)[:, :2]


def main_direction(lean: Array) -> tuple[Array, float, float]:
    """Return the main direction (2,) of lean, the spread about its line in degrees, and its surplus.

    The surplus is the share by which the lean to one side of the line exceeds that to the other. Direction
    and spread are weighted with the square of the speed, the surplus with the square of the lean.
    """
    # The mean lean is posture and hardly straight ahead; changes of the lean are movement.
    change = np.diff(lean, axis=0)
    squares, axes = np.linalg.eigh(change.T @ change)
    direction = axes[:, 1]
    size = np.linalg.norm(lean, axis=-1)
    along = float(size @ (lean @ direction) / max(size @ size, 1e-12))
    spread = np.degrees(np.arctan2(np.sqrt(max(squares[0], 0.0)), np.sqrt(max(squares[1], 1e-12))))
    return (-direction if along < 0 else direction), float(spread), abs(along)


def _wrong_order(names: Sequence[str], times: Sequence[Array], leans: Sequence[Array]) -> list[str]:
    """Warn of sensors that moved when `ROUTINE` asked for another one's movement.

    That only shows if the limbs moved one after the other; in walking they move together.
    """
    if any(name in names for exercise in _MORE for name in exercise.sensors):
        return []  # arms and legs move in two exercises each
    active = {}
    for name, time_s, lean in zip(names, times, leans, strict=True):
        size = np.linalg.norm(lean, axis=-1)
        active[name] = np.unique(np.floor(time_s[size > 0.5 * size.max()] / _STEP_S))
    exercises = [exercise.sensors[0] for exercise in ROUTINE if len(exercise.sensors) == 1]
    limbs = [name for name in exercises if name in names]
    for i, name in enumerate(limbs):
        for other in limbs[:i]:
            both = np.intersect1d(active[name], active[other]).size
            if both > 0.1 * min(active[name].size, active[other].size):
                return []
    found = sorted(limbs, key=lambda name: float(np.median(active[name])))
    return [
        f"the sensor labelled {name} moved when {expected} should have: are sensors swapped?"
        for name, expected in zip(found, limbs, strict=True)
        if name != expected
    ]
