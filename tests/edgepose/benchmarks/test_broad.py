"""BROAD: its measure, its files, and what our filters reach on six of its trials."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from edgepose import rotations as rot
from edgepose.benchmarks.broad import Trial, errors, find_trials, read_trial, same_heading, trials
from edgepose.errors import EdgeposeError
from edgepose.orientation import OrientationFilter, smooth
from tests.support import processes

DATA = Path(__file__).parents[2] / "data" / "broad"


def cut(trial: Trial, rows: slice) -> Trial:
    return trial._replace(
        **{name: getattr(trial, name)[rows] for name in ("gyr", "acc", "mag", "quat", "movement")}
    )


def as_arrays(trial: Trial) -> dict[str, object]:
    return {
        "imu_gyr": trial.gyr,
        "imu_acc": trial.acc,
        "imu_mag": trial.mag,
        "opt_quat": trial.quat,
        "movement": trial.movement,
        "sampling_rate": trial.rate,
    }


@pytest.fixture(scope="module")
def six() -> list[Trial]:
    return list(trials(DATA))


# --- the measure --------------------------------------------------------------------------------------------


def test_errors_of_known_turns(six):
    trial = cut(six[0], slice(4000, 6000))
    tilt = rot.rotvec_to_quat(np.deg2rad([3.0, 4.0, 0.0]))
    turned = rot.quat_multiply(rot.quat_about_z(np.deg2rad(-2.0)), trial.quat)
    assert errors(turned, trial) == pytest.approx((2.0, 2.0, 0.0), abs=1e-5)
    assert errors(rot.quat_multiply(tilt, trial.quat), trial) == pytest.approx((5.0, 0.0, 5.0), abs=1e-5)
    assert errors(-trial.quat, trial) == pytest.approx((0.0, 0.0, 0.0), abs=1e-5)


def test_what_is_not_known_or_no_movement_does_not_count(six):
    trial = cut(six[0], slice(4000, 6000))
    off = rot.quat_multiply(rot.quat_about_z(0.1), trial.quat)
    half = np.arange(2000)[:, None] < 1000
    mixed = np.where(half, off, trial.quat)
    assert errors(mixed, trial._replace(movement=~half[:, 0])).total == pytest.approx(0.0, abs=1e-5)
    lost = trial._replace(quat=np.where(half, np.nan, trial.quat))
    assert errors(mixed, lost).total == pytest.approx(0.0, abs=1e-5)
    assert errors(mixed, trial).total == pytest.approx(np.rad2deg(0.1) * np.sqrt(0.5), rel=0.05)


def test_heading_from_the_start_of_the_motion(six):
    trial = six[0]
    away = rot.quat_multiply(rot.quat_about_z(2.5), trial.quat)
    assert errors(same_heading(away, trial), trial).total == pytest.approx(0.0, abs=1e-4)


# --- its files ----------------------------------------------------------------------------------------------


def test_the_files_of_the_download(six, tmp_path):
    trial = cut(six[1], slice(5000, 5050))
    # Matlab has columns and matrices only.
    arrays = as_arrays(trial) | {"movement": trial.movement[:, None].astype(np.uint8)}
    savemat(tmp_path / "15_undisturbed.mat", arrays)
    again = read_trial(tmp_path / "15_undisturbed.mat")
    for a, b in zip(again[1:], trial[1:], strict=True):
        np.testing.assert_array_equal(a, b)
    assert again.movement.dtype == bool


def test_names_tell_which_are_disturbed(six):
    assert [trial.disturbed for trial in six] == [False] * 3 + [True] * 3


def test_no_trials(tmp_path):
    for folder in (tmp_path, tmp_path / "none"):
        with pytest.raises(EdgeposeError, match="no trials of BROAD"):
            find_trials(folder)


@pytest.mark.parametrize("name", ["a.npz", "a.mat"])
def test_files_that_are_none(tmp_path, name):
    (tmp_path / name).write_bytes(b"PK\3\4 or not, it is no trial at all, whatever it looks like" * 5)
    with pytest.raises(EdgeposeError, match=f"{name}: cannot read it"):
        read_trial(tmp_path / name)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"imu_mag": None}, "has no imu_mag"),
        ({"imu_acc": np.zeros((49, 3))}, "'imu_acc' is float64"),
        ({"opt_quat": np.array(["x"] * 50)}, "'opt_quat' is <U1"),
        ({"movement": np.zeros(7, bool)}, "'movement' or 'sampling_rate'"),
        ({"sampling_rate": np.nan}, "'movement' or 'sampling_rate'"),
        ({"movement": np.zeros(50, bool)}, "has no movement"),
        ({"imu_acc": np.diag([0.0] * 7 + [np.nan] + [0.0] * 42)[:, 7:10]}, "'imu_acc' has impos.* in row 7"),
        ({"imu_gyr": np.full((50, 3), 1e300)}, "'imu_gyr' has impossible values, the first in row 0"),
        ({"opt_quat": np.full((50, 4), 2.0)}, "'opt_quat' has impossible values"),
    ],
)
def test_arrays_that_do_not_fit(six, tmp_path, change, problem):
    arrays = as_arrays(cut(six[0], slice(0, 50))) | change
    np.savez(tmp_path / "a.npz", **{key: value for key, value in arrays.items() if value is not None})
    with pytest.raises(EdgeposeError, match=problem):
        read_trial(tmp_path / "a.npz")


# --- what filters reach -------------------------------------------------------------------------------------


def test_ours_beat_vqf_on_all_six(six):
    from vqf import VQF, offlineVQF

    ours, theirs, ours_offline, theirs_offline = [], [], [], []
    for trial in six:
        measured = (trial.gyr, trial.acc, trial.mag)
        ours.append(errors(OrientationFilter().update(trial.time_s, *measured).quat, trial))
        ours_offline.append(errors(smooth(trial.time_s, *measured).quat, trial))
        theirs.append(errors(VQF(1 / trial.rate).updateBatch(*measured)["quat9D"], trial))
        theirs_offline.append(errors(offlineVQF(*measured, 1 / trial.rate)["quat9D"], trial))
    online, vqf, offline, offline_vqf = (
        np.mean(scores, axis=0) for scores in (ours, theirs, ours_offline, theirs_offline)
    )
    assert online[0] < 2.2 < vqf[0]
    assert offline[0] < 1.6 < offline_vqf[0]
    assert online[2] < 0.85 < vqf[2]


def test_the_command(six, tmp_path):
    for trial in (six[0], six[4]):
        np.savez(tmp_path / f"{trial.name}.npz", **as_arrays(cut(trial, slice(4000, 5500))))
    command = [sys.executable, "-m", "edgepose", "bench", "orientation", "--data", tmp_path]
    shown = processes.run(command, capture_output=True, text=True, check=True)
    assert len(shown.stderr.splitlines()) == 2
    rows = [line.split() for line in shown.stdout.splitlines()]
    names = [row[0] for row in rows if len(row) > 6]
    assert names.count("edgepose") == 4  # filter and smoother, with and without magnetometer
    assert names.count("vqf") == names.count("offlineVQF") == names.count("imufusion") == 2
    told = json.loads(processes.run([*command, "--json"], capture_output=True, check=True).stdout)
    assert told["us_a_sample_at_286_hz"] > 0.0
    scores = told["scores"]
    assert len(scores) == 2 * 2 * len({score["filter"] for score in scores})
    assert all(0 < score["total"] < 180 and score["us"] > 0 for score in scores)


def test_what_another_filter_cannot_compute_is_no_number(six, tmp_path):
    """A field along gravity shows no heading."""
    arrays = as_arrays(cut(six[0], slice(4000, 4200)))
    np.savez(tmp_path / "trial.npz", **arrays | {"imu_mag": arrays["imu_acc"]})
    command = [sys.executable, "-m", "edgepose", "bench", "orientation", "--data", tmp_path]
    shown = processes.run([*command, "--json"], capture_output=True, check=True).stdout
    scores = json.loads(shown, parse_constant=lambda name: pytest.fail(name))["scores"]
    assert None in [score["total"] for score in scores]
    assert None not in [score["total"] for score in scores if score["filter"] == "edgepose"]
    assert "nan" not in processes.run(command, capture_output=True, text=True, check=True).stdout


def test_the_command_without_data(tmp_path):
    command = [sys.executable, "-m", "edgepose", "bench", "orientation", "--data", tmp_path]
    result = processes.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert result.stderr.startswith(f"edgepose: {tmp_path}: no trials of BROAD")
