"""Comparison of orientation filters on trials with ground truth."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from edgepose.benchmarks.broad import Trial, errors, read_trial, same_heading
from edgepose.benchmarks.reference_filters import ReferenceFilter, contenders
from edgepose.orientation.filter import OrientationFilter

WARM_UP = 300
"""Samples that each filter processes before it is timed, so that imports do not count."""


class Score(NamedTuple):
    """Result of a filter in a trial.

    Attributes:
        trial: name of the trial.
        disturbed: the trial has disturbances.
        filter: name of the filter.
        offline: the filter saw the whole trial.
        magnetometer: the filter used the magnetometer; if not, its heading was aligned with the true one at
            the start.
        total: error, deg.
        heading: its part about the vertical, deg.
        inclination: the rest, deg.
        us: time of one core per sample, microseconds.
    """

    trial: str
    disturbed: bool
    filter: str
    offline: bool
    magnetometer: bool
    total: float
    heading: float
    inclination: float
    us: float


def compare(files: Iterable[Path]) -> Iterator[list[Score]]:
    """Yield the scores of all filters, trial by trial.

    Raises:
        EdgeposeError: a trial cannot be read.
    """
    filters = contenders()
    for number, path in enumerate(files):
        trial = read_trial(path)
        if number == 0:
            for filter in filters:
                filter.run(_start_of(trial), True)
        yield [_score(filter, trial, mag) for mag in (True, False) for filter in filters]


def cost_us(trial: Trial, hz: float = 286.0) -> float:
    """Return the microseconds of one core that our filter takes per sample of a sensor at `hz`.

    Each sample of a trial with a lower rate is repeated.
    """
    times = max(1, round(hz / trial.rate))
    gyr, acc, mag = (np.repeat(part, times, axis=0) for part in (trial.gyr, trial.acc, trial.mag))
    time_s = np.arange(len(gyr)) / (trial.rate * times)
    kalman = OrientationFilter()
    started = time.process_time()
    kalman.update(time_s, gyr, acc, mag)
    return (time.process_time() - started) / len(gyr) * 1e6


def _start_of(trial: Trial) -> Trial:
    gyr, acc, mag = trial.gyr[:WARM_UP], trial.acc[:WARM_UP], trial.mag[:WARM_UP]
    return trial._replace(gyr=gyr, acc=acc, mag=mag)


def _score(contender: ReferenceFilter, trial: Trial, magnetometer: bool) -> Score:
    started = time.process_time()
    quat = contender.run(trial, magnetometer)
    us = (time.process_time() - started) / len(quat) * 1e6
    if not magnetometer:
        quat = same_heading(quat, trial)
    return Score(
        trial.name,
        trial.disturbed,
        contender.name,
        contender.offline,
        magnetometer,
        *errors(quat, trial),
        us,
    )
