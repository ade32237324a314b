"""Poses of the body: one at an instant, and all of a file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose.placements import PLACEMENTS
from edgepose.skeleton import JOINTS

Array = NDArray[np.float64]


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
        translation: (3,) place of the pelvis in T, metres, where something estimates it.
    """

    index: int  # type: ignore[assignment]  # hides tuple.index, which nobody wants here
    time_s: float
    status: str
    rotations: NDArray[np.float32]
    std: NDArray[np.float32]
    translation: NDArray[np.float64] | None = None


FILLING_WINDOW = 1
"""Bit of a status' flags: the network has seen fewer frames than its window holds."""


@lru_cache(maxsize=256)
def status_bits(status: str) -> tuple[int, int]:
    """Flags and held sensors (bit i: PLACEMENTS[i]) of a status text; what it does not know it leaves out."""
    flags = held = 0
    for part in status.split("; "):
        if part == "filling window":
            flags |= FILLING_WINDOW
        elif part.startswith("held "):
            names = set(part.split()[1:])
            held |= sum(1 << i for i, name in enumerate(PLACEMENTS) if name in names)
    return flags, held


def status_text(flags: int, held: int) -> str:
    """Inverse of `status_bits`."""
    names = [name for i, name in enumerate(PLACEMENTS) if held >> i & 1]
    parts = [" ".join(["held", *names])] if names else []
    if flags & FILLING_WINDOW:
        parts.append("filling window")
    return "; ".join(parts) or "ok"


def held_sensors(status: Sequence[str]) -> NDArray[np.bool_]:
    """Whether each sensor is held, (T, 6) in the order of PLACEMENTS, of T status texts."""
    masks = np.array([status_bits(text)[1] for text in status], int)
    return (masks[:, None] >> np.arange(len(PLACEMENTS)) & 1).astype(bool)


def longest_holds(held: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Most poses in a row (6,) in which each sensor is held, of `held` (T, 6)."""
    edges = np.diff(np.pad(held.astype(int), ((1, 1), (0, 0))), axis=0).T
    return np.array([np.max(np.flatnonzero(e < 0) - np.flatnonzero(e > 0), initial=0) for e in edges])


class Poses(NamedTuple):
    """Poses of one file.

    Attributes:
        frames: (T,) numbers of the frames, rising.
        time_s: (T,) on the source's clock, seconds.
        status: T texts, see `PoseFrame`.
        rotations: (T, 24, 3, 3) local rotations, joint 0 against T.
        translation: (T, 3) place of the pelvis in T, metres, if the file has it.
    """

    frames: NDArray[np.int64]
    time_s: Array
    status: list[str]
    rotations: Array
    translation: Array | None

    @property
    def frame_time(self) -> float:
        """Seconds from a frame to the next; 1/60 where there is but one."""
        steps = np.diff(self.frames)
        # The median, because time leaps where all sensors were silent for long.
        return float(np.median(np.diff(self.time_s) / steps)) if len(steps) else 1.0 / 60.0

    @property
    def rate(self) -> float:
        """Frames per second; 60 where there is but one frame."""
        return tidy_rate(self.frame_time)

    def pose_frames(self) -> Iterator[PoseFrame]:
        """The poses one by one, as a sink takes them; files hold no standard deviations of joints here."""
        unknown = np.full(len(JOINTS), np.nan, np.float32)
        for i, (frame, time_s) in enumerate(zip(self.frames.tolist(), self.time_s.tolist(), strict=True)):
            where = None if self.translation is None else self.translation[i]
            yield PoseFrame(frame, time_s, self.status[i], self.rotations[i], unknown, where)


def tidy_rate(frame_time: float) -> float:
    """Frames per second of a frame time in seconds that was printed with few digits: .0083333 is 120 Hz."""
    rate = 1.0 / frame_time
    whole = round(rate)
    return float(whole) if abs(rate - whole) < 1e-4 * rate else rate
