"""Evidence on headings in half a second of frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


class Block(NamedTuple):
    """A summary of frames of S sensors.

    Attributes:
        seconds: length.
        turned: (S,) angle about the vertical by which each sensor turned, as measured, rad.
        moved: (S,) largest angle between the first and another orientation, rad.
        heading: (S,) mean heading of each bone against the pelvis; 0 in the straight pose, rad.
        spread: (S,) 0 if this heading did not change, 1 if it took all values.
        upright: (S,) mean cosine between a bone's vertical of the straight pose and the vertical.
        held: (S,) whether the sensor was silent in a frame.
    """

    seconds: float
    turned: Array
    moved: Array
    heading: Array
    spread: Array
    upright: Array
    held: Flags


def block_of(
    seconds: float, orientation: Array, bones: Array, held: Sequence[Flags], straight: Array, root: int
) -> Block:
    """Summarise frames.

    Args:
        seconds: from the first frame to the last.
        orientation: (N, S, 4) quaternions of the sensors, to an inertial frame with Z up.
        bones: (N - 1, S, 3, 3) R_TB of all frames except the first, which was the last of the previous block.
        held: N times (S,) which sensors were silent.
        straight: (S, 3, 3) R_TB in the straight pose.
        root: index of the pelvis.
    """
    steps = rot.quat_multiply(orientation[1:], rot.quat_conjugate(orientation[:-1]))
    turned = 2.0 * np.sum(np.arctan2(steps[..., 3] * np.sign(steps[..., 0]), np.abs(steps[..., 0])), axis=0)
    same = np.abs(np.sum(orientation * orientation[0], axis=-1)).min(axis=0)
    from_straight = bones @ rot.transpose(straight)
    heading = rot.yaw_of_matrix(from_straight)
    mean = np.exp(1j * (heading - heading[:, root : root + 1])).mean(axis=0)
    return Block(
        seconds,
        turned,
        2.0 * np.arccos(np.minimum(same, 1.0)),
        np.angle(mean),
        1.0 - np.abs(mean),
        from_straight[..., 1, 1].mean(axis=0),
        np.any(held, axis=0),
    )
