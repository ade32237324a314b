"""Orientation of the samples of all sensors, the filter step of the pipeline."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from edgepose.imu import ImuSample, Vector3
from edgepose.orientation.arrays import NO_FIELD
from edgepose.orientation.filter import OrientationFilter
from edgepose.orientation.settings import FilterSettings
from edgepose.orientation.types import Event, OrientationResult
from edgepose.orientation.vqf_filter import VqfFilter


class SensorFilter(Protocol):
    """Orients one sensor's samples."""

    def update(
        self, time_s: ArrayLike, gyr: ArrayLike, acc: ArrayLike, mag: ArrayLike | None = None
    ) -> OrientationResult:
        """See `OrientationFilter.update`."""


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
        self._last: dict[int, OrientationResult] = {}
        self._events: defaultdict[int, Counter[int]] = defaultdict(Counter)
        self._fields: dict[int, Vector3] = {}  # from samples without rate and force

    def orient(self, samples: list[ImuSample]) -> list[ImuSample]:
        """Return the samples in the same order; those with rate and force get the filter's orientation.

        It replaces the device's own orientation, which samples without a rate keep. A field in a sample
        without a rate counts for the sensor's next one.
        """
        indices: defaultdict[int, list[int]] = defaultdict(list)
        fields: list[Vector3 | None] = [sample.mag for sample in samples]
        for index, sample in enumerate(samples):
            if sample.gyr is None or sample.acc is None:
                if sample.mag is not None:
                    self._fields[sample.sensor] = sample.mag
                continue
            waiting = self._fields.pop(sample.sensor, None)
            fields[index] = sample.mag or waiting
            indices[sample.sensor].append(index)
        result = list(samples)
        for sensor, rows in indices.items():
            quats = self._orient_sensor(
                sensor, [samples[index] for index in rows], [fields[index] for index in rows]
            )
            for index, (w, x, y, z) in zip(rows, quats, strict=True):
                result[index] = samples[index]._replace(quat=(w, x, y, z))
        return result

    def _orient_sensor(
        self, sensor: int, samples: Sequence[ImuSample], fields: Sequence[Vector3 | None]
    ) -> list[list[float]]:
        filter = self._filters.get(sensor)
        if filter is None:
            filter = self._filters[sensor] = self._spare.pop() if self._spare else self._class(self._settings)
        with_field = self._magnetometer and any(field is not None for field in fields)
        oriented = filter.update(
            [sample.time_s for sample in samples],
            np.array([sample.gyr for sample in samples], float),
            np.array([sample.acc for sample in samples], float),
            [NO_FIELD if field is None else field for field in fields] if with_field else None,
        )
        self._last[sensor] = oriented
        self._events[sensor].update(flag for flag in oriented.flagged.tolist() if flag)
        quats: list[list[float]] = oriented.quat.tolist()
        return quats

    def status(self) -> dict[int, SensorStatus]:
        """Return the state of each sensor that has been oriented."""
        return {
            sensor: SensorStatus(
                bool(last.rest[-1]),
                bool(last.disturbed[-1]),
                tuple(np.rad2deg(last.bias[-1]).tolist()),
                _by_event(self._events[sensor].items()),
            )
            for sensor, last in sorted(self._last.items())
        }


def _by_event(counts: Iterable[tuple[int, int]]) -> dict[Event, int]:
    """Convert counts by combination of events to counts by event."""
    result: Counter[Event] = Counter()
    for flags, count in counts:
        result.update({event: count for event in Event if event & flags})
    return dict(result)
