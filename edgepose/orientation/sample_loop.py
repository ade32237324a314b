"""The loop over single samples that all filters share, from and to arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edgepose.orientation.arrays import columns
from edgepose.orientation.types import OrientationResult

Quat = tuple[float, float, float, float]


class FilterState(NamedTuple):
    """What a filter knows beside the orientation; see `OrientationResult`.

    Attributes:
        bias: (3,) of the gyroscope, rad/s.
        bias_sigma: (3,) its standard deviation, rad/s.
        rest: the sensor is at rest.
        disturbed: the magnetic field is not the usual one.
    """

    bias: NDArray[np.float64]
    bias_sigma: NDArray[np.float64]
    rest: bool
    disturbed: bool


class SensorFilter(Protocol):
    """Orients one sensor's samples."""

    @property
    def state(self) -> FilterState:
        """The state; another object whenever it has changed."""

    def take(
        self, time_s: float, gyr: Sequence[float], acc: Sequence[float], mag: Sequence[float]
    ) -> tuple[Quat, int]:
        """Return the orientation of the next sample and its events; see `OrientationFilter.take`."""


def orient_arrays(
    filter: SensorFilter, time_s: ArrayLike, gyr: ArrayLike, acc: ArrayLike, mag: ArrayLike | None
) -> OrientationResult:
    """Pass samples to a filter one by one; arguments and errors as of `OrientationFilter.update`."""
    quats, flags, state_index = [], [], []
    states = [filter.state]
    for sample in zip(*columns(time_s, gyr, acc, mag), strict=True):
        quat, events = filter.take(*sample)
        if filter.state is not states[-1]:
            states.append(filter.state)
        quats.append(quat)
        flags.append(events)
        state_index.append(len(states) - 1)
    bias, sigma, rest, disturbed = (np.array(column)[state_index] for column in zip(*states, strict=True))
    return OrientationResult(
        np.array(quats).reshape(-1, 4), bias, sigma, rest, disturbed, np.array(flags, np.uint8)
    )
