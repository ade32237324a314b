"""What the program makes: one pose of the body at one instant."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class PoseFrame(NamedTuple):
    """A pose of SMPL's 24 joints.

    Attributes:
        index: frame number, that of the `ImuFrame` it belongs to.
        time_s: time of the frame on the source's clock, seconds (live: Unix time).
        status: "ok"; or, joined by "; ", "held NAME [NAME ...]" for sensors whose last values were repeated
            and "filling window" while the network has seen fewer frames than its window holds.
        rotations: (24, 3, 3) rotation of each joint against its parent, joint 0 against the body frame T.
        std: (24,) standard deviation that the network gives for each joint, radians; 0 for measured and
            resting joints.
    """

    index: int  # type: ignore[assignment]  # hides tuple.index, which nobody wants here
    time_s: float
    status: str
    rotations: NDArray[np.float32]
    std: NDArray[np.float32]
