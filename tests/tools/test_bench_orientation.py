"""The comparison of orientation filters by kind of trial, on pieces of two trials."""

from pathlib import Path

import numpy as np
import pytest

from edgepose.benchmarks.broad import read_trial
from edgepose.orientation import FilterSettings, OrientationFilter
from tools import bench_orientation

BROAD = Path(__file__).parents[1] / "data" / "broad"


@pytest.fixture(scope="module")
def two():
    pieces = []
    for path in sorted(BROAD.glob("*.npz"))[::4]:
        trial, rows = read_trial(path), slice(4300, 5000)
        names = ("gyr", "acc", "mag", "quat", "movement")
        pieces.append(trial._replace(**{name: getattr(trial, name)[rows] for name in names}))
    return pieces


def test_groups_are_words_of_the_names():
    names = ["07_undisturbed_fast_rotation_B", "28_disturbed_stationary_magnet_A"]
    groups = bench_orientation.groups(names)
    assert groups == {"all": [0, 1], "undisturbed": [0], "disturbed": [1], "rotation": [0], "magnet": [1]}


def test_means_by_group(two):
    table = bench_orientation.table(two)
    head, _, *rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table]
    assert head[:3] == ["trials", "n", "edgepose, 6-axis"]
    cells = {row[0]: dict(zip(head[1:], map(float, row[1:]), strict=True)) for row in rows}
    first = OrientationFilter().update(two[0].time_s, two[0].gyr, two[0].acc, two[0].mag).quat
    expected = bench_orientation.total(first, two[0], True)
    assert cells["undisturbed"]["edgepose, 9-axis"] == pytest.approx(expected, abs=0.006)
    for column, mean in cells["all"].items():
        parts = cells["undisturbed"][column], cells["disturbed"][column]
        assert mean == pytest.approx(sum(parts) if column == "n" else np.mean(parts), abs=0.011)


def test_settings_are_judged_on_the_trial_that_did_not_choose_them(two):
    """With two trials, each is judged with the settings that suit the other best."""
    noises = (1e-3, 0.3)
    *lines, mean, _ = bench_orientation.cross_validate(two, {"gyr_noise": noises})
    scores = np.empty((2, 2, 2))
    for i, j in np.ndindex(2, 2):
        trial, filter = two[j], OrientationFilter(FilterSettings(gyr_noise=noises[i]))
        quat = filter.update(trial.time_s, trial.gyr, trial.acc).quat
        scores[i, j, 0] = bench_orientation.total(quat, trial, False)
        filter = OrientationFilter(FilterSettings(gyr_noise=noises[i]))
        quat = filter.update(trial.time_s, trial.gyr, trial.acc, trial.mag).quat
        scores[i, j, 1] = bench_orientation.total(quat, trial, True)
    best = scores.mean(axis=2).argmin(axis=0)
    judged = [scores[best[1], 0], scores[best[0], 1]]
    for line, trial, (six, nine) in zip(lines, two, judged, strict=True):
        assert line.startswith(f"{trial.name}: 6-axis {six:.2f}, 9-axis {nine:.2f} (gyr_noise ")
    six, nine = np.mean(judged, axis=0)
    assert mean == f"left-out mean: 6-axis {six:.2f}, 9-axis {nine:.2f}"
