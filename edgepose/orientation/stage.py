"""Orients samples by a filter, or lets them pass: a station of the walk from samples to frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edgepose.imu import ImuSample
from edgepose.placements import PLACEMENTS

if TYPE_CHECKING:
    from edgepose.orientation.estimator import OrientationEstimator


class OrientationStage:
    """Turns samples into oriented ones as --filter and --no-mag ask for."""

    def __init__(self, filter: str, magnetometer: bool) -> None:
        """No sample has come.

        Args:
            filter: one of FILTERS.
            magnetometer: use magnetometers, where there are any.
        """
        self._filter, self._magnetometer = filter, magnetometer
        self._with_north: set[int] = set()
        self._made: set[int] = set()  # sensors that have been oriented
        self._orienter: OrientationEstimator | None = None
        if filter != "none":
            from edgepose.orientation.estimator import OrientationEstimator

            self._orienter = OrientationEstimator(filter, magnetometer)

    @property
    def passes(self) -> bool:
        """Whether samples pass as they are."""
        return self._orienter is None

    def fresh(self) -> OrientationStage:
        """The same, with no sample seen, for another recording."""
        return OrientationStage(self._filter, self._magnetometer)

    @property
    def north(self) -> bool:
        """Whether all sensors have a heading that counts from north, as far as the samples have shown.

        What devices with a filter of their own do is not known here: it is taken for granted.
        """
        return self._orienter is None or (self._magnetometer and len(self._with_north) == len(PLACEMENTS))

    @property
    def mixed(self) -> bool:
        """Whether some sensors have sent a magnetic field and others none, all being wanted."""
        return self._magnetometer and 0 < len(self._with_north) < len(PLACEMENTS)

    def summary_lines(self) -> list[str]:
        """What happened to the samples of each sensor, for the end of a run."""
        status = {} if self._orienter is None else self._orienter.status()
        return [
            f"filter   {PLACEMENTS[sensor]}: "
            + ", ".join(
                f"{count} {str(event.name).lower().replace('_', ' ')}" for event, count in own.events.items()
            )
            for sensor, own in status.items()
            if own.events
        ]

    def __call__(self, samples: list[ImuSample]) -> list[ImuSample]:
        """The samples, oriented; without those of oriented sensors that cannot be."""
        if self._orienter is None:
            return samples
        if len(self._with_north) < len(PLACEMENTS):
            self._with_north.update(sample.sensor for sample in samples if sample.mag is not None)
        oriented = self._orienter.orient(samples)
        self._made.update(sample.sensor for sample in oriented if sample.quat is not None)
        # What only brought a field, or lost its rate on the way, has no orientation to give.
        return [
            sample
            for sample in oriented
            if sample.quat is not None or (sample.acc is not None and sample.sensor not in self._made)
        ]
