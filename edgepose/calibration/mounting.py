"""How sensors sit on the wearer, in words such as "x up, z back": where their axes point in the held pose."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from edgepose import rotations as rot
from edgepose.calibration.sensor_to_segment import POSES, Calibration
from edgepose.placements import PLACEMENTS
from edgepose.rotations import Array

WRONG_DEG = 60.0
"""A sensor that is turned by more against what is said of it sits otherwise; straps give about 30."""

_AXES = (("left", "right"), ("up", "down"), ("forward", "back"))


def mounting(calibration: Calibration) -> list[str]:
    """How each sensor sat in the held pose, for a person: the body directions nearest to its X and Z axes."""

    def nearest(direction: Array) -> str:
        i = int(np.argmax(np.abs(direction)))
        return _AXES[i][int(direction[i] < 0)]

    return [f"x {nearest(r[:, 0])}, z {nearest(r[:, 2])}" for r in _sits(calibration)]


def rotation_of(words: str) -> Array:
    """R_TS (3, 3) of a sensor that sits as `words` say, which are of the form that `mounting` gives."""
    x, z = (_direction(part.split()[1]) for part in words.split(", "))
    return np.stack([x, np.cross(z, x), z], axis=-1)


def mounting_warnings(calibration: Calibration, said: Mapping[str, str | None], where: str) -> list[str]:
    """One line for each sensor, or two that are swapped, that sits otherwise than is said.

    Args:
        calibration: of a hold.
        said: how each placement's sensor sits, in the order of PLACEMENTS; None where nothing is said.
        where: who says it, for the message.
    """
    sits, found = _sits(calibration), mounting(calibration)
    wanted = [None if words is None else rotation_of(words) for words in said.values()]

    def fits(sensor: int, place: int) -> bool:
        r = wanted[place]
        return r is None or bool(np.degrees(rot.geodesic_angle(sits[sensor], r)) < WRONG_DEG)

    wrong = [i for i in range(len(PLACEMENTS)) if not fits(i, i)]
    lines = []
    while wrong:
        i = wrong.pop(0)
        name = PLACEMENTS[i]
        twin = next((j for j in wrong if fits(i, j) and fits(j, i)), None)
        if twin is not None:
            wrong.remove(twin)
            lines.append(
                f"{name} and {PLACEMENTS[twin]} look swapped: each sits as {where} says of the other"
            )
            continue
        r = wanted[i]
        assert r is not None, "nothing was said of it, so it cannot be wrong"
        # Where the axis that should point up points now.
        upside_down = sits[i][1] @ r[1] < -0.5
        lines.append(
            f"{name} sits {found[i]}{' (upside down)' if upside_down else ''}, and {where} says "
            f"{said[name]}; check that no two sensors are swapped and that it is the right way round"
        )
    return lines


def _sits(calibration: Calibration) -> Array:
    """R_TS (6, 3, 3) in the held pose."""
    return POSES[calibration.pose] @ rot.quat_to_matrix(calibration.bone_from_sensor)


def _direction(word: str) -> Array:
    i = next(i for i, pair in enumerate(_AXES) if word in pair)
    return np.eye(3)[i] * (1.0 - 2.0 * _AXES[i].index(word))
