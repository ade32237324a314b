"""Orientation of the samples of all sensors, the filter step of the pipeline."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from edgepose.imu import ImuSample, Vector3
from edgepose.orientation.arrays import NO_FIELD
from edgepose.orientation.filter import OrientationFilter
from edgepose.orientation.sample_loop import FilterState, SensorFilter
from edgepose.orientation.settings import FilterSettings
from edgepose.orientation.types import Event
from edgepose.orientation.vqf_filter import VqfFilter

KINDS: dict[str, type[OrientationFilter] | type[VqfFilter]] = {"kalman": OrientationFilter, "vqf": VqfFilter}
"""Filters by their names on the command line."""


class SensorStatus(NamedTuple):
    """State of a sensor's filter.

    Attributes:
        rest: the sensor is at rest.
        disturbed: the magnetic field is not the usual one.
        bias: of the gyroscope, sensor frame, deg/s.
        events: number of samples with each event since the start; events that never occurred are missing.
    """

    rest: bool
    disturbed: bool
    bias: Vector3
    events: dict[Event, int]


class OrientationEstimator:
    """Adds orientations to samples, with one filter per sensor."""

    def __init__(
        self, kind: str = "kalman", magnetometer: bool = True, settings: FilterSettings | None = None
    ) -> None:
        """Create the estimator.

        Args:
            kind: one of KINDS.
            magnetometer: use magnetic fields, where available.
            settings: of the filters.

        Raises:
            EdgeposeError: a package that the kind needs is not installed.
        """
        self._class, self._settings = KINDS[kind], settings
        # The first filter is made now, so that imports and their errors happen before the first sample.
        self._spare: list[SensorFilter] = [self._class(settings)]
        self._magnetometer = magnetometer
        self._filters: dict[int, SensorFilter] = {}
        self._events: defaultdict[int, Counter[int]] = defaultdict(Counter)
        self._fields: dict[int, Vector3] = {}  # from samples without rate and force

    def orient(self, samples: list[ImuSample]) -> list[ImuSample]:
        """Return the samples in the same order; those with rate and force get the filter's orientation.

        It replaces the device's own orientation, which samples without a rate keep. A field in a sample
        without a rate counts for the sensor's next one.
        """
        result = list(samples)
        for index, sample in enumerate(samples):
            sensor, time_s, _, acc, gyr, mag, *_ = sample
            if gyr is None or acc is None:
                if mag is not None:
                    self._fields[sensor] = mag
                continue
            if self._fields:
                mag = mag or self._fields.get(sensor)
                self._fields.pop(sensor, None)
            if not self._magnetometer:
                mag = None
            filter = self._filters.get(sensor) or self._new_filter(sensor)
            quat, events = filter.take(time_s, gyr, acc, NO_FIELD if mag is None else mag)
            if events:
                self._events[sensor][events] += 1
            result[index] = sample._replace(quat=quat)
        return result

    def _new_filter(self, sensor: int) -> SensorFilter:
        filter = self._spare.pop() if self._spare else self._class(self._settings)
        self._filters[sensor] = filter
        return filter

    def status(self) -> dict[int, SensorStatus]:
        """Return the state of each sensor that has been oriented."""
        return {
            sensor: _status(filter.state, self._events[sensor].items())
            for sensor, filter in sorted(self._filters.items())
        }


def _status(state: FilterState, events: Iterable[tuple[int, int]]) -> SensorStatus:
    x, y, z = np.rad2deg(state.bias).tolist()
    return SensorStatus(bool(state.rest), bool(state.disturbed), (x, y, z), _by_event(events))


def _by_event(counts: Iterable[tuple[int, int]]) -> dict[Event, int]:
    """Convert counts by combination of events to counts by event."""
    result: Counter[Event] = Counter()
    for flags, count in counts:
        result.update({event: count for event in Event if event & flags})
    return dict(result)
