"""Sensor mountings in words such as "x up, z back": the directions of the axes in the held pose."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from edgepose import rotations as rot
from edgepose.calibration.sensor_to_segment import POSES, Calibration
from edgepose.placements import PLACEMENTS
from edgepose.rotations import Array

WRONG_DEG = 60.0
"""A sensor rotated by more against its stated mounting is mounted differently; straps give about 30."""

_AXES = (("left", "right"), ("up", "down"), ("forward", "back"))


def mounting(calibration: Calibration) -> list[str]:
    """Describe each sensor's mounting in the held pose: the body directions nearest to its X and Z axes."""

    def nearest(direction: Array) -> str:
        i = int(np.argmax(np.abs(direction)))
        return _AXES[i][int(direction[i] < 0)]

    return [f"x {nearest(r[:, 0])}, z {nearest(r[:, 2])}" for r in _mounted(calibration)]


def rotation_of(words: str) -> Array:
    """Return R_TS (3, 3) of a sensor mounted as `words` say, in the form that `mounting` returns."""
    x, z = (_direction(part.split()[1]) for part in words.split(", "))
    return np.stack([x, np.cross(z, x), z], axis=-1)


def mounting_warnings(calibration: Calibration, stated: Mapping[str, str | None], source: str) -> list[str]:
    """Return one line for each sensor, or swapped pair, whose mounting differs from the stated one.

    Args:
        calibration: of a hold.
        stated: mounting of each placement's sensor, in the order of PLACEMENTS; None if not stated.
        source: name of the file that states it, for the message.
    """
    measured, found = _mounted(calibration), mounting(calibration)
    wanted = [None if words is None else rotation_of(words) for words in stated.values()]

    def fits(sensor: int, placement: int) -> bool:
        r = wanted[placement]
        return r is None or bool(np.degrees(rot.geodesic_angle(measured[sensor], r)) < WRONG_DEG)

    wrong = [i for i in range(len(PLACEMENTS)) if not fits(i, i)]
    lines = []
    while wrong:
        i = wrong.pop(0)
        name = PLACEMENTS[i]
        twin = next((j for j in wrong if fits(i, j) and fits(j, i)), None)
        if twin is not None:
            wrong.remove(twin)
            lines.append(
                f"{name} and {PLACEMENTS[twin]} look swapped: each is mounted as {source} says for the other"
            )
            continue
        r = wanted[i]
        assert r is not None, "a mounting that is not stated cannot be wrong"
        # Whether the axis that should point up points down.
        upside_down = measured[i][1] @ r[1] < -0.5
        lines.append(
            f"{name} is mounted {found[i]}{' (upside down)' if upside_down else ''}, but {source} says "
            f"{stated[name]}; check that no two sensors are swapped and that it is the right way round"
        )
    return lines


def _mounted(calibration: Calibration) -> Array:
    """R_TS (6, 3, 3) in the held pose."""
    return POSES[calibration.pose] @ rot.quat_to_matrix(calibration.bone_from_sensor)


def _direction(word: str) -> Array:
    i = next(i for i, pair in enumerate(_AXES) if word in pair)
    return np.eye(3)[i] * (1.0 - 2.0 * _AXES[i].index(word))
