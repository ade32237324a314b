"""Orientation filters against each other on trials with known truth."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from edgepose.broad import Trial, errors, read_trial, same_heading
from edgepose.orientation.contenders import Contender, contenders


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
    for path in files:
        trial = read_trial(path)
        yield [_score(one, trial, mag) for mag in (True, False) for one in filters]


def _score(contender: Contender, trial: Trial, magnetometer: bool) -> Score:
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
