"""Joint angles and steps from poses: flexion of joints, lean of the trunk, bouts of walking.

Angles, in degrees, are between directions of bones, so they do not depend on the path of a joint. In the zero
pose (T-pose) legs, elbows and trunk are at 0 and the shoulders at 90.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose.placements import PLACEMENTS
from edgepose.rotations import transpose
from edgepose.skeleton import JOINTS, forward_kinematics, global_rotations

Array = NDArray[np.float64]

ANGLES = {
    "hip flexion": "thigh to the front of the pelvis",
    "hip abduction": "thigh to the side of the pelvis",
    "knee flexion": "shank to the back of the thigh",
    "shoulder elevation": "upper arm from hanging down along the chest",
    "elbow flexion": "forearm from the line of the upper arm",
    "trunk flexion": "chest to the front of the pelvis",
    "trunk side bend": "chest to the left of the pelvis",
    "trunk rotation": "chest turned to the left of the pelvis",
    "trunk lean": "chest from upright",
}
"""Angles and their descriptions; those of limbs exist for either side."""

_SENSORS = {"hip": "lower_leg", "knee": "lower_leg", "shoulder": "forearm", "elbow": "forearm"}

LIMBS = tuple(name for name in ANGLES if not name.startswith("trunk"))


def _axis(joint: str, x: float, y: float, z: float, local: Array) -> tuple[Array, Array, Array]:
    """Return the components (T,), in the parent's frame, of a direction that is fixed in a joint's frame."""
    rotated = local[:, JOINTS.index(joint)] @ np.array([x, y, z])
    return rotated[:, 0], rotated[:, 1], rotated[:, 2]


def joint_angles(local: Array) -> dict[str, Array]:
    """Compute the angles (T,) of `ANGLES`, degrees, from local rotations (T, 24, 3, 3).

    The keys of limbs have the form "left hip flexion".
    """
    world = global_rotations(local)
    chest = world[:, JOINTS.index("spine3")]
    result = {}
    for side, out in (("left", 1.0), ("right", -1.0)):
        x, y, z = _axis(f"{side}_hip", 0.0, -1.0, 0.0, local)
        result[f"{side} hip flexion"] = np.arctan2(z, -y)
        result[f"{side} hip abduction"] = np.arcsin(np.clip(out * x, -1.0, 1.0))
        x, y, z = _axis(f"{side}_knee", 0.0, -1.0, 0.0, local)
        result[f"{side} knee flexion"] = np.arctan2(-z, -y)
        arm = transpose(chest) @ world[:, JOINTS.index(f"{side}_shoulder")] @ np.array([out, 0.0, 0.0])
        result[f"{side} shoulder elevation"] = np.arccos(np.clip(-arm[:, 1], -1.0, 1.0))
        x, y, z = _axis(f"{side}_elbow", out, 0.0, 0.0, local)
        result[f"{side} elbow flexion"] = np.arctan2(np.hypot(y, z), out * x)
    relative = transpose(world[:, 0]) @ chest
    up, front = relative[..., 1], relative[..., 2]
    result["trunk flexion"] = np.arctan2(up[:, 2], up[:, 1])
    result["trunk side bend"] = np.arcsin(np.clip(up[:, 0], -1.0, 1.0))
    result["trunk rotation"] = np.arctan2(front[:, 0], front[:, 2])
    result["trunk lean"] = np.arccos(np.clip(chest[:, 1, 1], -1.0, 1.0))
    return {name: np.degrees(values) for name, values in result.items()}


def held_angles(held: NDArray[np.bool_]) -> dict[str, NDArray[np.bool_]]:
    """Return for each angle of `joint_angles` in which poses (T,) it was not measured, given `held` (T, 6).

    An angle needs the pelvis and the sensor at the end of its limb; those of the trunk need the head.
    """
    columns = dict(zip(PLACEMENTS, held.T, strict=True))
    result = {}
    for name in ANGLES:
        if name in LIMBS:
            for side in ("left", "right"):
                sensor = f"{side}_{_SENSORS[name.split()[0]]}"
                result[f"{side} {name}"] = columns[sensor] | columns["pelvis"]
        else:
            result[name] = columns["head"] | columns["pelvis"]
    return result


# --- steps --------------------------------------------------------------------------------------------------

STEP_M = 0.15
"""A foot that moves this much to the front, relative to the other one, has made a step."""

FASTEST_STEP_S, SLOWEST_STEP_S = 0.25, 1.2
"""Shortest and longest time between steps of a bout of walking, seconds; a longer pause ends it."""

LEAST_STEPS = 6
"""Smallest number of steps of a bout of walking."""


class WalkingBout(NamedTuple):
    """Consecutive steps without a pause.

    Attributes:
        frames: (N,) indices of the poses in which a foot was furthest to the front, about when it touches the
            ground.
        left: (N,) whether it was the left foot.
    """

    frames: NDArray[np.int64]
    left: NDArray[np.bool_]


def walking_bouts(local: Array, offsets: Array, rate: float) -> list[WalkingBout]:
    """Find bouts of walking or running.

    Args:
        local: (T, 24, 3, 3) local rotations.
        offsets: (24, 3) joint position minus its parent's in the zero pose, metres.
        rate: frames per second.
    """
    from scipy.signal import find_peaks

    world, joints = forward_kinematics(local, offsets)
    forward = world[:, 0, :, 2] * [1.0, 0.0, 1.0]  # level
    forward /= np.maximum(np.linalg.norm(forward, axis=1, keepdims=True), 1e-9)
    between = joints[:, JOINTS.index("left_ankle")] - joints[:, JOINTS.index("right_ankle")]
    lead = np.sum(between * forward, axis=1)  # of the left foot over the right one
    least = max(1, round(FASTEST_STEP_S * rate))
    left, right = (find_peaks(s * lead, prominence=STEP_M, distance=least)[0] for s in (1.0, -1.0))
    frames = np.concatenate([left, right])
    order = np.argsort(frames)
    frames, is_left = frames[order], (np.arange(len(frames)) < len(left))[order]
    # A bout ends where the feet do not alternate, or after a pause.
    pause = (np.diff(frames) > SLOWEST_STEP_S * rate) | (is_left[1:] == is_left[:-1])
    starts = np.concatenate([[0], np.flatnonzero(pause) + 1, [len(frames)]])
    return [WalkingBout(frames[a:b], is_left[a:b]) for a, b in pairwise(starts) if b - a >= LEAST_STEPS]
