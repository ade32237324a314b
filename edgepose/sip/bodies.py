"""Bodies from height, weight and shape words, and the positions of sensors on them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from importlib import resources
from typing import Any

import numpy as np

from edgepose.errors import EdgeposeError
from edgepose.placements import PLACEMENTS, SITES
from edgepose.sip.kinematics import SensorPoints
from edgepose.skeleton import PARENTS, Body, default_body

WORDS = {
    "long-legged": ("long-legged", 1.0), "short-legged": ("long-legged", -1.0),
    "long-armed": ("long-armed", 1.0), "short-armed": ("long-armed", -1.0),
    "long-necked": ("long-necked", 1.0), "short-necked": ("long-necked", -1.0),
    "broad-shouldered": ("broad-shouldered", 1.0), "narrow-shouldered": ("broad-shouldered", -1.0),
    "broad-hipped": ("broad-hipped", 1.0), "narrow-hipped": ("broad-hipped", -1.0),
    "muscular": ("muscular", 1.0), "slender": ("muscular", -1.0),
}  # fmt: skip
"""Words for a body's shape: the change in `shapes.json` and its sign."""

BMI_RANGE = (14.0, 50.0)
"""Plausible body mass indices, kg/m^2; values outside are mistakes, mostly pounds instead of kilograms."""


@cache
def _shapes() -> dict[str, Any]:
    text = resources.files("edgepose.sip").joinpath("shapes.json").read_text(encoding="utf-8")
    shapes: dict[str, Any] = json.loads(text)
    return shapes


def shaped_body(
    height_m: float = 1.75,
    sex: str = "neutral",
    weight_kg: float | None = None,
    words: Sequence[str] = (),
) -> Body:
    """Return an average body changed by weight and words (SIP-BW, SIP 5.1).

    Args:
        height_m: stature, metres; weight and words do not change it.
        sex: "neutral", "male" or "female".
        weight_kg: None means the average for the stature.
        words: of WORDS; a repeated word counts twice.

    Raises:
        EdgeposeError: an implausible stature or weight, or an unknown sex or word.
    """
    body, shapes = default_body(height_m, sex), _shapes()
    changes: list[tuple[dict[str, Any], float]] = []
    if weight_kg is not None:
        bmi = weight_kg / height_m**2
        if not BMI_RANGE[0] <= bmi <= BMI_RANGE[1]:  # also true of NaN
            raise EdgeposeError(
                f"{weight_kg:g} kg at {height_m:g} m: give the wearer's weight in kilograms, without sensors"
            )
        average = shapes["weights"][sex]
        changes.append((average, bmi - average["bmi"]))
    for word in words:
        if word not in WORDS:
            raise EdgeposeError(f"unknown word {word!r} for a shape: use some of {', '.join(WORDS)}")
        name, sign = WORDS[word]
        changes.append((shapes["words"][name], sign))
    offsets, sensors = body.offsets.copy(), body.sensors.copy()
    for change, amount in changes:
        share = amount * height_m / shapes["stature"]
        offsets += share * np.array(change["offsets"])
        sensors += share * np.array(change["sensors"])
    return Body(offsets, sensors, body.height_m)


def scaled(body: Body, scale: float) -> Body:
    """Scale all lengths of a body (by 1.1 for SIP-110)."""
    return Body(scale * body.offsets, scale * body.sensors, scale * body.height_m)


def sensor_points(body: Body, names: Sequence[str]) -> SensorPoints:
    """Return the sensors' points on a body, by bone.

    The six placements have points on the skin; other sensors are assumed in the middle of their bone.
    """
    offsets = body.offsets.copy()
    offsets[0] = 0.0
    points = [
        body.sensors[PLACEMENTS.index(name)] if name in PLACEMENTS else offsets[_next(SITES[name])] / 2.0
        for name in names
    ]
    return SensorPoints(offsets, np.array([SITES[name] for name in names]), np.array(points))


def _next(joint: int) -> int:
    """Return the joint at the far end of a bone; for the chest, the one towards the neck."""
    return PARENTS.index(joint)
