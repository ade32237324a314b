"""Orientation filters against each other on trials with known truth."""

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
"""Samples that each filter runs over before its time is taken: what it imports is no part of its cost."""


class Score(NamedTuple):
    """What a filter reached in a trial.

    Attributes:
        trial: its name.
        disturbed: it is one with disturbances.
        filter: its name.
        offline: it saw the whole trial.
        magnetometer: it had the magnetometer; if not, its heading was set to the truth's at the start.
        total: error, deg.
        heading: its part about the vertical, deg.
        inclination: the rest, deg.
        us: time of one core a sample, microseconds.
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
    """Scores of all filters, trial by trial.

    Raises:
        EdgeposeError: a trial cannot be read.
    """
    filters = contenders()
    for number, path in enumerate(files):
        trial = read_trial(path)
        if number == 0:
            for one in filters:
                one.run(_beginning(trial), True)
        yield [_score(one, trial, mag) for mag in (True, False) for one in filters]


def cost_us(trial: Trial, hz: float = 286.0) -> float:
    """Microseconds of one core that our filter takes for each sample of a sensor that sends `hz` of them.

    A trial of a lower rate has each of its samples several times.
    """
    times = max(1, round(hz / trial.rate))
    gyr, acc, mag = (np.repeat(part, times, axis=0) for part in (trial.gyr, trial.acc, trial.mag))
    time_s = np.arange(len(gyr)) / (trial.rate * times)
    kalman = OrientationFilter()
    started = time.process_time()
    kalman.update(time_s, gyr, acc, mag)
    return (time.process_time() - started) / len(gyr) * 1e6


def _beginning(trial: Trial) -> Trial:
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
