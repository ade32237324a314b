"""Bodies of other sizes and proportions, and sensors that sit elsewhere on their segments."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from edgepose.placements import BONES, PLACEMENTS
from edgepose.skeleton import JOINTS, PARENTS, default_body

STATURES = (1.45, 2.0)
"""Smallest and tallest wearers, metres."""

LENGTHS = {
    "spine": 0.035,
    "neck": 0.035,
    "head": 0.06,
    "collar": 0.05,
    "shoulder": 0.06,
    "elbow": 0.04,
    "wrist": 0.04,
    "hip": 0.06,
    "knee": 0.04,
    "ankle": 0.04,
}
"""Relative standard deviations of the distances from joints to their parents among bodies of one stature, by
the last part of the joint's name ("knee" stands for both thighs). Both sides of a body are alike.
"""

LENGTHWISE, ACROSS = 0.03, 0.012
"""Standard deviations of where a sensor sits along its segment and across it, metres."""


class Shapes(NamedTuple):
    """Bodies of a batch.

    Attributes:
        levers: (B, 6, 24, 3) see `levers_of`, metres.
        scale: (B,) factor on the translation of the pelvis, which follows the length of the legs.
    """

    levers: Tensor
    scale: Tensor


def _chains() -> Tensor:
    """Return (6, 24, 24), 1 where, on the way to a sensor, a bone carries the offset of a joint."""
    result = torch.zeros(len(BONES), len(PARENTS), len(PARENTS))
    for sensor, bone in enumerate(BONES):
        while bone:
            result[sensor, PARENTS[bone], bone] = 1.0
            bone = PARENTS[bone]
    return result


_CHAINS, _SITES = _chains(), torch.nn.functional.one_hot(torch.tensor(BONES), len(PARENTS)).float()


def levers_of(offsets: Tensor, sensors: Tensor) -> Tensor:
    """Return levers (..., 6, 24, 3), metres, of bodies with offsets (..., 24, 3) and sensors (..., 6, 3).

    Summed over all bones, the rotated levers give the sensors' positions relative to the pelvis.
    """
    levers = torch.einsum("ijb,...bx->...ijx", _CHAINS, offsets)
    return levers + _SITES[..., None] * sensors[..., None, :]


_BODY = default_body()
_OFFSETS, _SENSORS = torch.tensor(_BODY.offsets).float(), torch.tensor(_BODY.sensors).float()
LEVERS = levers_of(_OFFSETS, _SENSORS)
"""Levers (6, 24, 3) of the default body."""

_KINDS = [name.rpartition("_")[2].rstrip("123") for name in JOINTS]
_FAR_ENDS = [JOINTS.index(f"{side}_{end}") for end in ("wrist", "ankle") for side in ("left", "right")]
_LEG = [JOINTS.index("left_knee"), JOINTS.index("left_ankle")]
_SHIFT = torch.full((len(PLACEMENTS), 3), ACROSS)
_SHIFT[range(len(PLACEMENTS)), [0 if name.endswith("forearm") else 1 for name in PLACEMENTS]] = LENGTHWISE


def draw_shapes(count: int, stature: float, proportions: float, generator: torch.Generator) -> Shapes:
    """Draw bodies.

    Args:
        count: number of bodies, B.
        stature: relative standard deviation of the stature, which stays within `STATURES`.
        proportions: factor on `LENGTHS`, `LENGTHWISE` and `ACROSS`.
        generator: source of the random numbers.
    """
    size, levers, legs = torch.ones(count), LEVERS, torch.ones(count)
    if stature:
        low, high = (limit / _BODY.height_m for limit in STATURES)
        size = torch.exp(stature * torch.randn(count, generator=generator)).clamp(low, high)
    if proportions:
        drawn = torch.randn(count, len(LENGTHS), generator=generator) * torch.tensor(list(LENGTHS.values()))
        factors = torch.ones(count, len(JOINTS))
        for joint, kind in enumerate(_KINDS):
            if kind in LENGTHS:
                factors[:, joint] = torch.exp(proportions * drawn[:, list(LENGTHS).index(kind)])
        sensors = _SENSORS.repeat(count, 1, 1)
        sensors[:, :-1] *= factors[:, [*_FAR_ENDS, JOINTS.index("head")], None]
        sensors += proportions * _SHIFT * torch.randn(sensors.shape, generator=generator)
        levers = levers_of(factors[..., None] * _OFFSETS, sensors)
        bones = _OFFSETS[_LEG].norm(dim=-1)
        legs = (factors[:, _LEG] * bones).sum(1) / bones.sum()
    return Shapes(size[:, None, None, None] * levers, size * legs)
