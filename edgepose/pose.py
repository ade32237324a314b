"""Poses of the body: a single pose, and a sequence from a file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence, Set
from functools import lru_cache
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose.placements import ADDED, PLACEMENTS, SITES
from edgepose.skeleton import JOINTS, grounded_pelvis_position

Array = NDArray[np.float64]

CONTACTS = (
    "left_ankle", "right_ankle", "left_foot", "right_foot", "pelvis", "left_wrist", "right_wrist",
)  # fmt: skip
"""Joints whose contacts are estimated, in the order of all arrays; "foot" is the base of the toes."""

RATES = (1.0, 1000.0)
"""Lowest and highest rate of poses that can be asked for, Hz."""

LONGEST_GAP_S = 1.0
"""Longest time between two poses that another rate fills, seconds: beyond it all sensors were silent."""

_ORDER = {name: i for i, name in enumerate(SITES)}


class PoseFrame(NamedTuple):
    """A pose of SMPL's 24 joints.

    Attributes:
        index: frame number, that of the pose's `ImuFrame`.
        time_s: time of the frame on the source's clock, seconds (live: Unix time).
        rotations: (24, 3, 3) rotation of each joint relative to its parent, joint 0 relative to body frame T.
        std: (24,) standard deviation of each joint, predicted by the network, radians; 0 for joints that are
            measured or fixed.
        translation: (3,) position of the pelvis in T, metres, if it is estimated.
        held: placements or sites of sensors without new data, whose last values were repeated.
        warming_up: the network has seen fewer frames than its window holds.
        contacts: (7,) probabilities that the joints `CONTACTS` rest on something, if they are estimated.
    """

    index: int  # type: ignore[assignment]  # hides tuple.index, which is not needed here
    time_s: float
    rotations: NDArray[np.float32]
    std: NDArray[np.float32]
    translation: NDArray[np.float64] | None = None
    held: frozenset[str] = frozenset()
    warming_up: bool = False
    contacts: NDArray[np.float32] | None = None

    @property
    def status(self) -> str:
        """`held` and `warming_up` as text, see `format_status`."""
        return format_status(self.held, self.warming_up)


_HELD, _WARMING_UP, _OK = "held", "filling window", "ok"
_LONGEST = 1000  # characters that are parsed; a status with all sites is shorter


@lru_cache(maxsize=256)
def format_status(held: frozenset[str], warming_up: bool) -> str:
    """Format a pose's `held` and `warming_up` as text.

    The text is "ok", or "held NAME [NAME ...]" and "filling window" joined by "; ". Names are in the order of
    SITES, after any unknown ones.
    """
    names = sorted(held, key=lambda name: (_ORDER.get(name, -1), name))
    parts = [" ".join([_HELD, *names])] if names else []
    parts += [_WARMING_UP] if warming_up else []
    return "; ".join(parts) or _OK


@lru_cache(maxsize=256)
def parse_status(text: str) -> tuple[frozenset[str], bool]:
    """Parse a text of `format_status` to `held` and `warming_up`, ignoring unknown parts."""
    parts = text[:_LONGEST].split("; ")
    held = [name for part in parts if part.startswith(_HELD + " ") for name in part.split()[1:]]
    return frozenset(held), _WARMING_UP in parts


def held_sensors(held: Sequence[Set[str]], names: Sequence[str] = PLACEMENTS) -> NDArray[np.bool_]:
    """Return whether each of N sensors is held, (T, N), from the `held` of T poses."""
    flags = [[name in silent for name in names] for silent in held]
    return np.array(flags, bool).reshape(-1, len(names))


def held_bits(held: Set[str]) -> int:
    """Return the `held` of a pose as a number with bit i for PLACEMENTS[i]; other sensors have none."""
    return sum(1 << PLACEMENTS.index(name) for name in held if name in PLACEMENTS)


def known_sensors(held: Sequence[Set[str]]) -> list[str]:
    """Return the sensors of which poses tell something: the six, and others that were ever held."""
    return [*PLACEMENTS, *(name for name in ADDED if any(name in silent for silent in held))]


def longest_holds(held: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the longest run of poses (N,) in which each sensor is held, from `held` (T, N)."""
    edges = np.diff(np.pad(held.astype(int), ((1, 1), (0, 0))), axis=0).T
    return np.array([np.max(np.flatnonzero(e < 0) - np.flatnonzero(e > 0), initial=0) for e in edges])


def place_values(pose: PoseFrame, translation: bool, contacts: bool) -> list[float]:
    """Return the translation (3), metres, and the contacts (7) of a pose, each if it is asked for.

    Raises:
        ValueError: the pose lacks what is asked for.
    """
    values: list[float] = []
    if translation:
        if pose.translation is None:
            raise ValueError(f"pose {pose.index} has no translation")
        values += pose.translation.tolist()
    if contacts:
        if pose.contacts is None:
            raise ValueError(f"pose {pose.index} has no contacts")
        values += pose.contacts.tolist()
    return values


def pelvis_position(pose: PoseFrame, offsets: Array) -> Array:
    """Return the position (3,) of the pelvis in T, metres; above the origin if it is unknown.

    Args:
        pose: the pose.
        offsets: (24, 3) joint position minus its parent's in the zero pose, metres.
    """
    if pose.translation is not None:
        return pose.translation
    return grounded_pelvis_position(pose.rotations, offsets)


def pelvis_positions(poses: Sequence[PoseFrame], offsets: Array) -> Array:
    """Return the positions (T, 3) of the pelvis in T poses, see `pelvis_position`."""
    known = [pose.translation for pose in poses if pose.translation is not None]
    if len(known) == len(poses):
        return np.stack(known)
    positions = grounded_pelvis_position(np.stack([pose.rotations for pose in poses]), offsets)
    positions[[pose.translation is not None for pose in poses]] = np.reshape(known, (-1, 3))
    return positions


class PoseSequence(NamedTuple):
    """The poses of a file.

    Attributes:
        frames: (T,) frame numbers, increasing.
        time_s: (T,) times on the source's clock, seconds.
        rotations: (T, 24, 3, 3) local rotations, joint 0 relative to T.
        translation: (T, 3) position of the pelvis in T, metres, if the file has it.
        held: T sets, see `PoseFrame`.
        warming_up: T flags, see `PoseFrame`.
        about: what the file says about its origin: `model`, `calibration`, `source`, `date`, `edgepose`,
            `without` (sensors that the rig lacked).
        contacts: (T, 7) probabilities that the joints `CONTACTS` rest on something, if the file has them.
    """

    frames: NDArray[np.int64]
    time_s: Array
    rotations: Array
    translation: Array | None
    held: list[frozenset[str]]
    warming_up: list[bool]
    about: Mapping[str, str] = MappingProxyType({})
    contacts: NDArray[np.float32] | None = None

    @property
    def status(self) -> list[str]:
        """Status texts of the T poses, see `format_status`."""
        return [format_status(*state) for state in zip(self.held, self.warming_up, strict=True)]

    @property
    def frame_time(self) -> float:
        """Seconds from one frame number to the next; 1/60 if there is only one pose."""
        frames, seconds = np.diff(self.frames), np.diff(self.time_s)
        if not len(frames):
            return 1.0 / 60.0
        # The mean, because times may be rounded; without jumps, where all sensors were silent for long.
        regular = seconds <= 1.5 * np.median(seconds / frames) * frames
        return float(seconds[regular].sum() / frames[regular].sum())

    @property
    def frame_step(self) -> int:
        """Largest number of frames that divides every step from pose to pose; 1 for a single pose."""
        return max(1, int(np.gcd.reduce(np.diff(self.frames))))

    @property
    def rate(self) -> float:
        """Poses per second if none is missing; 60 if there is only one pose."""
        return tidy_rate(self.frame_time * self.frame_step)

    def pose_frames(self) -> Iterator[PoseFrame]:
        """Yield the poses one by one, as sinks take them; their `std` is NaN, because it is not kept here."""
        unknown_std = np.full(len(JOINTS), np.nan, np.float32)
        for i, (frame, time_s) in enumerate(zip(self.frames.tolist(), self.time_s.tolist(), strict=True)):
            translation = None if self.translation is None else self.translation[i]
            contacts = None if self.contacts is None else self.contacts[i]
            state = self.held[i], self.warming_up[i]
            yield PoseFrame(frame, time_s, self.rotations[i], unknown_std, translation, *state, contacts)


def tidy_rate(frame_time: float) -> float:
    """Return the rate, Hz, of a frame time, seconds, that was printed with few digits: .0083333 is 120 Hz."""
    rate = 1.0 / frame_time
    whole = round(rate)
    return float(whole) if abs(rate - whole) < 1e-4 * rate else rate
