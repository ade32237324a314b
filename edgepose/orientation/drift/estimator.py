"""Heading errors of a rig from the evidence of its sensors, whether they drift or not.

Assumptions:
- Either all gyroscopes of a rig are good, or all may be poor. Both are followed side by side, and weighted by
  how well they foresee what is measured: an odd posture that lasts does not turn the sensors of a good rig.
- Standing, sitting and walking straight show headings. Lying, turning on the spot and bones that are level or
  upside down show none.
- A wearer who stands still with all bones as in the straight pose has also turned them as in that pose. A
  hanging forearm is among them: without one, sitting looks the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from edgepose.orientation.drift.evidence import Array, Block, Flags
from edgepose.orientation.drift.headings import Gyroscopes, Habit, HeadingFilter
from edgepose.orientation.drift.rest import STILL, Rests

GOOD = Gyroscopes(math.radians(0.1 / 60.0), 0.0005, math.radians(0.01))
POOR = Gyroscopes(math.radians(6.0 / 60.0), 0.003, math.radians(0.05))
"""Gyroscopes that drift by about a degree, and by a hundred degrees, in twenty minutes."""

HABITS = ((30.0, 1.0), (600.0, 2.0))
"""Times for which habits last, seconds, and their sizes as factors of `Role.habit`."""
ODDS = -6.0
"""Logarithm of the odds of poor gyroscopes before anything is known: a rig is left alone in case of doubt."""

UPRIGHT_PELVIS = math.cos(math.radians(41.0))
"""Lower bound of the pelvis' cosine to the vertical while the wearer stands, sits or walks."""
STRAIGHT_ON = math.radians(30.0)
"""Turning rate of the pelvis from which on the wearer does not face one way, rad/s."""
_SPREAD = 0.1
"""Largest spread of a heading in a block, see `Block`."""
_SIGMA = math.radians(3.0)
"""Standard deviation of a heading beside the habit, rad."""
_POSE_TILT = math.cos(math.radians(12.0))
"""Lower bound of the bones' cosines to the vertical in the recognised straight pose."""
_POSE_S = 1.5
"""Time after which it is recognised, seconds."""
_REZERO_SIGMA = math.radians(3.0)
"""Standard deviation of a heading in the pose of a re-zero, rad."""


class Role(NamedTuple):
    """The meaning of the heading of a bone.

    Attributes:
        habit: standard deviation of the heading against the pelvis, rad.
        tilt: angle to the straight pose from which on the heading shows nothing, rad.
        pose: standard deviation of the heading in the recognised straight pose, rad.
    """

    habit: float
    tilt: float
    pose: float


ROLES = {
    "forearm": Role(math.radians(30.0), math.radians(72.0), math.radians(12.0)),
    "lower_leg": Role(math.radians(8.0), math.radians(60.0), math.radians(6.0)),
    "head": Role(math.radians(15.0), math.radians(60.0), math.radians(8.0)),
    "pelvis": Role(0.0, 0.0, 0.0),
}
"""Roles by the end of the placement's name."""


class DriftEstimator:
    """Estimates the heading errors of a rig, block by block."""

    def __init__(self, placements: Sequence[str], root: int, odds: float = ODDS) -> None:
        """Start after a calibration.

        Args:
            placements: names of the sensors.
            root: index of the pelvis.
            odds: logarithm of the odds that the rig drifts, before anything is measured.
        """
        self._odds = odds
        self._roles = [next(role for end, role in ROLES.items() if name.endswith(end)) for name in placements]
        self._root = root
        self._forearms = np.array([name.endswith("forearm") for name in placements])
        habits = np.array([role.habit for role in self._roles])
        lasting = [Habit(seconds, factor * habits) for seconds, factor in HABITS]
        self._good, self._poor = (HeadingFilter(each, lasting, root) for each in (GOOD, POOR))
        self._filters = self._good, self._poor
        self._rests = [Rests() for _ in placements]
        self._turning = True
        self._posed_s = 0.0

    @property
    def drifts(self) -> float:
        """Probability that the rig drifts."""
        gain = self._poor.log_likelihood - self._good.log_likelihood
        return 1.0 / (1.0 + math.exp(min(-self._odds - gain, 700.0)))

    @property
    def error(self) -> Array:
        """(S,) heading errors, rad."""
        return self._good.error + self.drifts * (self._poor.error - self._good.error)

    @property
    def bias(self) -> Array:
        """(S,) rates at which they grow, rad/s."""
        return self._good.bias + self.drifts * (self._poor.bias - self._good.bias)

    def update(self, block: Block) -> None:
        """Take a block of frames."""
        for each in self._filters:
            each.predict(block.seconds, block.turned)
        self._take_rests(block)
        turning = abs(block.turned[self._root]) > STRAIGHT_ON * block.seconds
        upright = block.upright[self._root] > UPRIGHT_PELVIS and not block.held[self._root]
        if upright and not turning and not self._turning:
            self._take_headings(block)
        self._turning = turning
        self._take_pose(block)

    def pass_over(self, seconds: float) -> None:
        """Let the errors grow for a time in which nothing was measured, seconds."""
        for each in self._filters:
            each.predict(seconds, np.zeros(len(self._roles)))

    def rezero(self, headings: Array, errors: Array, held: Flags) -> None:
        """Learn from a re-zero.

        Args:
            headings: (S,) headings of the bones against the pelvis that it revealed, as measured, rad.
            errors: (S,) heading errors from now on, rad.
            held: (S,) sensors that revealed nothing, such as those that the rig lacks.
        """
        for each in self._filters:
            for i in self._others(held):
                each.heading(i, headings[i], _REZERO_SIGMA, habit=False)
            each.rezero(errors)

    def _others(self, held: Flags) -> list[int]:
        """Return the sensors except the pelvis' and the held ones."""
        return [i for i in range(len(self._roles)) if i != self._root and not held[i]]

    def _take_rests(self, block: Block) -> None:
        for i, rests in enumerate(self._rests):
            moved = math.inf if block.held[i] else float(block.moved[i])
            found = rests.update(block.seconds, float(block.turned[i]), moved)
            if found is not None:
                for each in self._filters:
                    each.at_rest(i, *found)

    def _take_headings(self, block: Block) -> None:
        for i in self._others(block.held):
            if block.upright[i] > math.cos(self._roles[i].tilt) and block.spread[i] < _SPREAD:
                for each in self._filters:
                    each.heading(i, float(block.heading[i]), _SIGMA)

    def _take_pose(self, block: Block) -> None:
        """Take the straight pose, once each time it is held."""
        posed = block.held | ((block.upright > _POSE_TILT) & (block.moved < 2.0 * STILL))
        known = not block.held[self._root] and bool(np.any(self._forearms & ~block.held))
        other = not (known and posed.all())
        before, self._posed_s = self._posed_s, 0.0 if other else self._posed_s + block.seconds
        if before < _POSE_S <= self._posed_s:
            for i in self._others(block.held):
                for each in self._filters:
                    each.heading(i, float(block.heading[i]), self._roles[i].pose, habit=False)
