"""Sensor mountings in words such as "x up, z back": the directions of the axes in the held pose."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from edgepose import rotations as rot
from edgepose.calibration.sensor_to_segment import Calibration, held_bone
from edgepose.rotations import Array

WRONG_DEG = 60.0
"""A sensor rotated by more against its stated mounting is mounted differently; straps give about 30."""

_AXES = (("left", "right"), ("up", "down"), ("forward", "back"))


def mounting(calibration: Calibration) -> dict[str, str]:
    """Describe each sensor's mounting in the held pose: the body directions nearest to its X and Z axes."""

    def nearest(direction: Array) -> str:
        i = int(np.argmax(np.abs(direction)))
        return _AXES[i][int(direction[i] < 0)]

    return {name: f"x {nearest(r[:, 0])}, z {nearest(r[:, 2])}" for name, r in _mounted(calibration).items()}


def rotation_of(words: str) -> Array:
    """Return R_TS (3, 3) of a sensor mounted as `words` say, in the form that `mounting` returns."""
    x, z = (_direction(part.split()[1]) for part in words.split(", "))
    return np.stack([x, np.cross(z, x), z], axis=-1)


def mounting_warnings(calibration: Calibration, stated: Mapping[str, str | None], source: str) -> list[str]:
    """Return one line for each sensor, or swapped pair, whose mounting differs from the stated one.

    Args:
        calibration: of a hold.
        stated: mounting of sensors by name; None if not stated.
        source: name of the file that states it, for the message.
    """
    measured, found = _mounted(calibration), mounting(calibration)
    wanted = {name: rotation_of(words) for name, words in stated.items() if words is not None}

    def fits(sensor: str, placement: str) -> bool:
        r = wanted.get(placement)
        return r is None or bool(np.degrees(rot.geodesic_angle(measured[sensor], r)) < WRONG_DEG)

    wrong = [name for name in measured if not fits(name, name)]
    lines = []
    while wrong:
        name = wrong.pop(0)
        twin = next((other for other in wrong if fits(name, other) and fits(other, name)), None)
        if twin is not None:
            wrong.remove(twin)
            lines.append(f"{name} and {twin} look swapped: each is mounted as {source} says for the other")
            continue
        # Whether the axis that should point up points down.
        upside_down = measured[name][1] @ wanted[name][1] < -0.5
        lines.append(
            f"{name} is mounted {found[name]}{' (upside down)' if upside_down else ''}, but {source} says "
            f"{stated[name]}; check that no two sensors are swapped and that it is the right way round"
        )
    return lines


def _mounted(calibration: Calibration) -> dict[str, Array]:
    """R_TS (3, 3) of each sensor in the held pose."""
    return {
        name: held_bone(calibration.pose, name) @ rot.quat_to_matrix(sensor.bone_from_sensor)
        for name, sensor in calibration.sensors.items()
    }


def _direction(word: str) -> Array:
    i = next(i for i, pair in enumerate(_AXES) if word in pair)
    return np.eye(3)[i] * (1.0 - 2.0 * _AXES[i].index(word))
