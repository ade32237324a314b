"""Simulated chips and the exercises of simulated wearers."""

from __future__ import annotations

import numpy as np
import pytest

from edgepose import rotations as rot
from edgepose.calibration import EXERCISE_S, GRAVITY, ROUTINE
from edgepose.imu import SensorData
from edgepose.placements import BONES, PLACEMENTS
from edgepose_export.mocap.straight_pose import straight_pose
from edgepose_export.synthesis.heading_routine import exercises
from edgepose_export.synthesis.imu_errors import BMI270, FIELD_UT, raw

RATE, N = 100.0, 20_000
REST = SensorData(
    np.arange(N) / RATE, np.tile([1.0, 0, 0, 0], (N, 1)), np.tile([0, 0, GRAVITY], (N, 1)), np.zeros((N, 3))
)


def test_noise_and_bias_are_those_of_the_data_sheet():
    chips = [raw(REST, BMI270, seed, magnetometer=False) for seed in range(60)]
    assert chips[0].quat is None
    assert chips[0].mag is None
    for column, ideal, noise, bias in (
        ("gyr", 0.0, np.radians(0.007), np.radians(0.5)),
        ("acc", [0, 0, GRAVITY], 160e-6 * GRAVITY, 0.020 * GRAVITY),
    ):
        rows = np.array([getattr(chip, column) for chip in chips]) - ideal
        # White noise of a density d has the deviation d sqrt(rate / 2).
        np.testing.assert_allclose(rows.std(axis=1), noise * np.sqrt(RATE / 2), rtol=0.05)
        assert rows.mean(axis=1).std() == pytest.approx(bias, rel=0.25)
    other = raw(REST, BMI270, 0, magnetometer=False)
    np.testing.assert_array_equal(other.gyr, chips[0].gyr)
    # One chip keeps its bias whatever it records.
    short = raw(SensorData(*(None if c is None else c[:1000] for c in REST)), BMI270, 0, magnetometer=False)
    np.testing.assert_allclose(short.acc.mean(axis=0), chips[0].acc.mean(axis=0), atol=3e-3)


def test_a_magnetometer_measures_the_field():
    turned = REST._replace(quat=np.tile(rot.quat_about_z(np.pi / 2), (N, 1)))
    chip = raw(turned, BMI270, 1, magnetometer=True)
    np.testing.assert_allclose(chip.mag.mean(axis=0), [FIELD_UT[1], -FIELD_UT[0], FIELD_UT[2]], atol=0.02)


def test_what_has_no_rates_is_refused():
    with pytest.raises(ValueError, match="rates and forces, which are missing"):
        raw(REST._replace(gyr=None), BMI270, 0, magnetometer=False)


def test_each_exercise_moves_its_sensors_and_returns_to_the_straight_pose():
    rate = 50.0
    bones, length = exercises(rate), round(EXERCISE_S * rate)
    assert len(bones) == length * len(ROUTINE)
    for k, exercise in enumerate(ROUTINE):
        rows = bones[k * length : (k + 1) * length]
        for bone, name in zip(BONES, PLACEMENTS, strict=True):
            turned = np.degrees(rot.geodesic_angle(rows[:, bone], straight_pose()[bone])).max()
            assert (turned > 25.0) == (name in exercise.sensors), (exercise.text, name, turned)
        np.testing.assert_allclose(rows[0], straight_pose(), atol=1e-9)
