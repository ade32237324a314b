"""Checks of the times of a recording: their unit, their resolution, and that its sensors share them."""

from __future__ import annotations

import numpy as np

from edgepose.errors import FileFormatError
from edgepose.imu import Recording
from edgepose.rotations import Array

SLOWEST_HZ = 2.0
"""Sensors that report more slowly cannot be used."""

FASTEST_HZ = 4000.0

_FEWEST = 20  # samples of a sensor, so that its times can be judged
_COARSEST_HZ = 20.0  # of different times
_UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}


def check_times(recording: Recording, name: str) -> None:
    """Check that the times of a recording are seconds, and fine enough to tell its samples apart.

    Args:
        recording: as read.
        name: of the file, for the message.

    Raises:
        FileFormatError: they are not; the message says what they may be.
    """
    for sensor, data in recording.sensors.items():
        if len(data.time_s) >= _FEWEST:
            _check_resolution(data.time_s, sensor, name)
            _check_unit(data.time_s, sensor, name)


def find_clocks_apart(recording: Recording, name: str) -> str | None:
    """Return a message if a sensor starts after another has ended; None if all share some time.

    Args:
        recording: as read.
        name: of the file, for the message.
    """
    times = {sensor: data.time_s for sensor, data in recording.sensors.items() if len(data.time_s) >= _FEWEST}
    if not times:
        return None
    first = min(times, key=lambda sensor: times[sensor][-1])
    last = max(times, key=lambda sensor: times[sensor][0])
    end_s, start_s = times[first][-1], times[last][0]
    if start_s <= end_s:
        return None
    return (
        f"{name}: {last} starts at {start_s:.1f} s, after the end of {first} at {end_s:.1f} s; if their "
        "clocks differ, synchronise the sensors and record again"
    )


def _check_resolution(time_s: Array, sensor: str, name: str) -> None:
    different = len(np.unique(time_s))
    span_s = float(time_s[-1] - time_s[0])
    if 3 * different < len(time_s) and different <= 1 + _COARSEST_HZ * span_s:
        raise FileFormatError(
            f"{name}: {len(time_s)} samples of {sensor} share {different} times; write time_s with more "
            "digits, at least to the millisecond"
        )


def _check_unit(time_s: Array, sensor: str, name: str) -> None:
    steps = np.diff(time_s)
    step = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    if not step or 1.0 / step > SLOWEST_HZ:
        return
    for unit, seconds in _UNITS.items():
        if SLOWEST_HZ * 5 < 1.0 / (step * seconds) < FASTEST_HZ:
            raise FileFormatError(
                f"{name}: the samples of {sensor} are {step:g} s apart; time_s seems to be in {unit}: "
                f"multiply it by {seconds:g}"
            )
