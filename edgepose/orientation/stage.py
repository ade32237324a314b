"""Pipeline stage that orients samples by a filter, or passes them on unchanged."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from edgepose.imu import ImuSample
from edgepose.placements import PLACEMENTS, SENSORS

if TYPE_CHECKING:
    from edgepose.orientation.estimator import OrientationEstimator


class OrientationStage:
    """Orients samples as --filter and --no-mag ask for.

    Attributes:
        names: sensors of the rig.
    """

    def __init__(self, filter: str, magnetometer: bool, names: Sequence[str] = PLACEMENTS) -> None:
        """Create the stage.

        Args:
            filter: one of FILTERS.
            magnetometer: use magnetometers, where available.
            names: sensors of the rig.
        """
        self.names = names
        self._filter, self._magnetometer = filter, magnetometer
        self._with_north: set[int] = set()
        self._oriented: set[int] = set()
        self._orienter: OrientationEstimator | None = None
        if filter != "none":
            from edgepose.orientation.estimator import OrientationEstimator

            self._orienter = OrientationEstimator(filter, magnetometer)

    @property
    def passes(self) -> bool:
        """Whether samples pass unchanged."""
        return self._orienter is None

    def fresh(self) -> OrientationStage:
        """Return a new stage with the same settings, for another recording."""
        return OrientationStage(self._filter, self._magnetometer, self.names)

    @property
    def north(self) -> bool:
        """Whether all sensors' headings count from north, as far as the samples have shown.

        For devices with a filter of their own that is unknown and assumed.
        """
        return self._orienter is None or (self._magnetometer and not self._fieldless)

    @property
    def mixed(self) -> bool:
        """Whether magnetometers are used and only some sensors have sent a magnetic field."""
        return self._magnetometer and 0 < len(self._fieldless) < len(self.names)

    @property
    def without_field(self) -> list[str]:
        """The sensors that have not sent a magnetic field, although one is to be used."""
        if self._orienter is None or not self._magnetometer:
            return []
        return self._fieldless

    @property
    def _fieldless(self) -> list[str]:
        return [name for name in self.names if SENSORS.index(name) not in self._with_north]

    def summary_lines(self) -> list[str]:
        """Return one line per sensor with its events, for the end of a run."""
        status = {} if self._orienter is None else self._orienter.status()
        return [
            f"filter   {SENSORS[sensor]}: "
            + ", ".join(
                f"{count} {str(event.name).lower().replace('_', ' ')}"
                for event, count in sensor_status.events.items()
            )
            for sensor, sensor_status in status.items()
            if sensor_status.events
        ]

    def __call__(self, samples: list[ImuSample]) -> list[ImuSample]:
        """Return the samples, oriented; leave out those without orientation from oriented sensors."""
        if self._orienter is None:
            return samples
        if self._fieldless:
            self._with_north.update(sample.sensor for sample in samples if sample.mag is not None)
        oriented = self._orienter.orient(samples)
        self._oriented.update(sample.sensor for sample in oriented if sample.quat is not None)
        # Samples with only a field, or without a rate, get no orientation.
        return [
            sample
            for sample in oriented
            if sample.quat is not None or (sample.acc is not None and sample.sensor not in self._oriented)
        ]
