"""Poses as OpenSim's full-body models have them: orientations of bodies, and coordinates of joints.

OpenSim's ground has X forward, Y up and Z to the right. In the zero pose of its models the body is upright
with hanging arms and palms to the front, and the frames of all bodies are parallel to the ground's.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose.rotations import matrix_to_euler_zxy, rotation_about_axis
from edgepose.skeleton import JOINTS, global_rotations

Array = NDArray[np.float64]

TO_OPENSIM = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Rotation from the body frame T (X left, Y up, Z forward) to OpenSim's ground."""

_BODIES = {
    "pelvis": "pelvis",
    "torso": "spine3",
    **{
        f"{body}_{side[0]}": f"{side}_{joint}"
        for side in ("right", "left")
        for body, joint in {
            "femur": "hip",
            "tibia": "knee",
            "calcn": "ankle",
            "humerus": "shoulder",
            "radius": "elbow",
        }.items()
    },
}

BODIES = tuple(_BODIES)
"""Bodies of the models whose orientations are written."""

_SMPL_JOINTS = [JOINTS.index(name) for name in _BODIES.values()]


class Joint(NamedTuple):
    """A joint of the models: rotations about Z, X and Y, in this order, from its parent to its body.

    Attributes:
        parent: body above it; None for the ground.
        body: body below it.
        coordinates: names of its coordinates for Z, X and Y; empty for an axis that the models do not have.
        signs: 1, or -1 if a positive coordinate turns the other way.
    """

    parent: str | None
    body: str
    coordinates: tuple[str, str, str]
    signs: tuple[int, int, int]


def _side(side: str, knee: int) -> list[Joint]:
    """Return the joints of the limbs of a side, "r" or "l", given the sign of flexed knees about Z."""
    out = 1 if side == "r" else -1  # adduction and internal rotation are positive on either side

    def joint(parent: str, body: str, z: str, x: str, y: str, sign: int = 1) -> Joint:
        names = tuple(f"{name}_{side}" if name else "" for name in (z, x, y))
        return Joint(parent, f"{body}_{side}", (names[0], names[1], names[2]), (sign, out, out))

    return [
        joint("pelvis", "femur", "hip_flexion", "hip_adduction", "hip_rotation"),
        joint(f"femur_{side}", "tibia", "knee_angle", "", "", knee),
        joint(f"tibia_{side}", "calcn", "ankle_angle", "subtalar_angle", ""),
        joint("torso", "humerus", "arm_flex", "arm_add", "arm_rot"),
        joint(f"humerus_{side}", "radius", "elbow_flex", "", "pro_sup"),
    ]


def _model(knee: int) -> tuple[Joint, ...]:
    return (
        Joint(None, "pelvis", ("pelvis_tilt", "pelvis_list", "pelvis_rotation"), (1, 1, 1)),
        Joint("pelvis", "torso", ("lumbar_extension", "lumbar_bending", "lumbar_rotation"), (1, 1, 1)),
        *_side("r", knee),
        *_side("l", knee),
    )


MODELS = {"rajagopal": _model(-1), "gait2392": _model(1)}
"""Joints by family of models: Rajagopal's, in which flexed knees are positive; gait2392 and Hamner's."""

_HIPS_IN_PELVIS = {"rajagopal": (-0.056276, -0.07849, 0.0), "gait2392": (-0.0707, -0.0661, 0.0)}
"""The middle of the hip joints in the frame of the pelvis, metres, in the models as they are published."""

_BEYOND = np.radians(130.0)
"""Largest second angle of a joint, beyond the 90 degrees after which the other two jump by half a turn."""

_MOST = np.radians(270.0)
"""Largest angle of a joint other than that of the pelvis."""


def _zero_pose() -> Array:
    """Return the rotations (12, 3, 3) from the frames of `BODIES` to those of SMPL's bones."""
    frames = []
    for body in BODIES:
        side = 1.0 if body.endswith("_r") else -1.0
        hangs, palm = np.eye(3), np.eye(3)
        if body.startswith(("humerus", "radius")):
            hangs = rotation_about_axis("z", side * np.pi / 2.0)
        if body.startswith("radius"):  # the palm of an arm that hangs from the T-pose is at the thigh
            palm = rotation_about_axis("y", side * np.pi / 2.0)
        frames.append(hangs.T @ TO_OPENSIM.T @ palm)
    return np.stack(frames)


_FRAMES = _zero_pose()


def body_orientations(local: Array) -> Array:
    """Return the rotations from the frames of `BODIES` to OpenSim's ground, (T, 12, 3, 3).

    Args:
        local: (T, 24, 3, 3) local rotations of SMPL's joints.
    """
    world = global_rotations(local)
    return np.asarray(TO_OPENSIM @ world[:, _SMPL_JOINTS] @ _FRAMES)


class Coordinates:
    """Converts poses to the coordinates of a model, with angles that are continuous in time."""

    def __init__(self, model: str, offsets: Array) -> None:
        """Start without a pose.

        Args:
            model: a key of `MODELS`.
            offsets: (24, 3) of the wearer's body, metres.
        """
        self._joints = MODELS[model]
        self._hips = TO_OPENSIM @ offsets[[JOINTS.index("left_hip"), JOINTS.index("right_hip")]].mean(axis=0)
        self._hips = self._hips - np.array(_HIPS_IN_PELVIS[model])
        self._before = np.zeros((len(self._joints), 3))
        self._used = np.array([bool(name) for joint in self._joints for name in joint.coordinates])

    @property
    def names(self) -> list[str]:
        """Names of the coordinates in the order of the columns."""
        named = [name for joint in self._joints for name in joint.coordinates if name]
        return [*named[:3], "pelvis_tx", "pelvis_ty", "pelvis_tz", *named[3:]]

    def add(self, local: Array, pelvis: Array) -> Array:
        """Return the coordinates of the next poses (T, n), degrees and metres.

        Args:
            local: (T, 24, 3, 3) local rotations of SMPL's joints.
            pelvis: (T, 3) position of SMPL's pelvis in T, metres.
        """
        bodies = dict(zip(BODIES, np.moveaxis(body_orientations(local), 1, 0), strict=True))
        parents = [np.eye(3) if joint.parent is None else bodies[joint.parent] for joint in self._joints]
        relative = [
            np.swapaxes(parent, -1, -2) @ bodies[joint.body]
            for parent, joint in zip(parents, self._joints, strict=True)
        ]
        angles = self._continuous(matrix_to_euler_zxy(np.stack(relative, axis=1)))
        signed = angles * np.array([joint.signs for joint in self._joints])
        degrees = np.degrees(signed).reshape(len(local), -1)[:, self._used]
        # The models' pelvis is elsewhere than SMPL's: their hip joints are where SMPL's are.
        origin = pelvis @ TO_OPENSIM.T + bodies["pelvis"] @ self._hips
        return np.concatenate([degrees[:, :3], origin, degrees[:, 3:]], axis=1)

    def _continuous(self, angles: Array) -> Array:
        """Return those of the equal angles (T, n, 3), radians, that are next to those of the pose before."""
        turned = np.stack([angles[..., 0] + np.pi, np.pi - angles[..., 1], angles[..., 2] + np.pi], axis=-1)
        for i in range(len(angles)):
            found = [_nearest(each, self._before) for each in (angles[i], turned[i])]
            far = [np.abs(each - self._before).sum(axis=-1) for each in found]
            beyond = (far[1] < far[0]) & (np.abs(found[1][:, 1]) < _BEYOND)
            angles[i] = np.where(beyond[:, None], found[1], found[0])
            # A wearer may turn round for ever; an arm that has swung round hangs as before.
            limbs = angles[i, 1:]
            limbs[limbs > _MOST] -= 2.0 * np.pi
            limbs[limbs < -_MOST] += 2.0 * np.pi
            self._before = angles[i]
        return angles


def _nearest(angles: Array, to: Array) -> Array:
    """Return angles plus the whole turns, radians, that bring them next to others."""
    return np.asarray(angles + 2.0 * np.pi * np.round((to - angles) / (2.0 * np.pi)))
