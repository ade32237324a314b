"""Recordings whose times are in another unit, or have too few digits."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.csv import write_csv
from edgepose.formats.recordings.npz import write_npz
from edgepose.formats.recordings.registry import read_recording, salvage_recording
from edgepose.imu import Recording

REAL = Path(__file__).parents[3] / "data" / "imu" / "six-sites-3s.npz"
UNIX = 1_732_340_000.0


def changed(change: Callable[[np.ndarray], np.ndarray]) -> Recording:
    recording = read_recording(REAL)
    sensors = {
        name: data._replace(time_s=np.asarray(change(data.time_s), float))
        for name, data in recording.sensors.items()
    }
    return recording._replace(sensors=sensors)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda t: 1e3 * t, "are 10 s apart; time_s seems to be in milliseconds: multiply it by 0.001"),
        (lambda t: 1e6 * t, "are 10000 s apart; time_s seems to be in microseconds: multiply it by 1e-06"),
        (np.floor, r"300 samples of left_forearm share \d times; write time_s with more digits"),
        (lambda t: np.float32(t + UNIX), "300 samples of left_forearm share 1 times"),
        (lambda t: [float(f"{x:.6g}") for x in t + UNIX], "300 samples of left_forearm share 1 times"),
        (lambda t: 1e3 * (t + UNIX), "time too large for seconds; is it in milliseconds"),
    ],
)
@pytest.mark.parametrize("write", [write_csv, write_npz])
def test_times_that_are_not_seconds(tmp_path, change, problem, write):
    path = tmp_path / ("a.csv" if write is write_csv else "a.npz")
    write(path, changed(change))
    for read in (read_recording, salvage_recording):
        with pytest.raises(EdgeposeError, match=problem):
            read(path)


@pytest.mark.parametrize(
    "change",
    [
        lambda t: t + UNIX,
        lambda t: np.round(t, 2),
        lambda t: np.round(t * 25) / 25,  # packets of four samples with one time
        lambda t: t * 20,  # 5 Hz
        lambda t: t / 30,  # 3 kHz
    ],
)
def test_times_that_are_unusual(tmp_path, change):
    write_npz(tmp_path / "a.npz", changed(change))
    assert read_recording(tmp_path / "a.npz").damage is None


def test_sensors_that_share_no_time(tmp_path):
    recording = changed(lambda t: t)
    head = recording.sensors["head"]
    recording.sensors["head"] = head._replace(time_s=head.time_s + 500.0)
    write_npz(tmp_path / "a.npz", recording)
    says = r"head starts at 540\.0 s, after the end of left_forearm at 43\.0 s; if their clocks differ, synch"
    with pytest.raises(EdgeposeError, match=says):
        read_recording(tmp_path / "a.npz")
    recording = salvage_recording(tmp_path / "a.npz")
    assert re.search(says, recording.damage)
    assert len(recording.sensors["head"].time_s) == 300
