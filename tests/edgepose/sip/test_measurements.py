"""From recordings of any sensors to frames, with gaps, late sensors and further sensors from a hold."""

from dataclasses import replace

import numpy as np
import pytest

from edgepose import rotations as rot
from edgepose.calibration import load_calibration
from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.npz import write_npz
from edgepose.formats.recordings.registry import read_recording, read_sensors
from edgepose.imu import Recording, SensorData
from edgepose.placements import PLACEMENTS, SITES
from edgepose.sip import inputs as reading
from edgepose.sip.measurements import SensorMount, measure, mounts_from_hold

NAMES = ("left_forearm", "head", "pelvis")
PLAIN = {name: SensorMount(np.eye(3), np.eye(3)) for name in NAMES}


def swinging(rate, seconds=4.0, start=0.0):
    """A sensor that swings about Z and moves on a path whose acceleration is known."""
    t = start + np.arange(round(seconds * rate)) / rate
    quat = rot.quat_about_z(np.sin(t))
    inertial = np.stack([np.sin(5.0 * t), 0.3 * t, np.cos(3.0 * t) + 9.81], axis=1)
    return SensorData(t, quat, rot.quat_rotate(rot.quat_conjugate(quat), inertial))


def path(t):
    """The place (N, 3) of that sensor."""
    return np.stack([-np.sin(5.0 * t) / 25.0, 0.05 * t**3, -np.cos(3.0 * t) / 9.0], axis=1)


def recording(**changes):
    return Recording({name: changes.get(name, swinging(100.0)) for name in NAMES}, {})


def test_acceleration_is_the_second_difference_of_the_path():
    """At frames between the samples, without the delay of a mean over past samples."""
    result = measure(recording(head=swinging(400.0)), PLAIN, 60.0)
    t = result.time_s
    differences = (path(t + 1 / 60) - 2.0 * path(t) + path(t - 1 / 60)) * 3600.0
    inside = result.valid.all(axis=1)
    assert inside.sum() > 230
    error = np.abs(result.acceleration - differences[:, None])[inside]
    assert error[:, 0].max() < 6e-4  # 100 Hz, linear between samples
    assert error[:, 1].max() < 6e-5  # 400 Hz
    np.testing.assert_allclose(result.orientation[:, 0], rot.rotation_about_axis("z", np.sin(t)), atol=2e-5)
    assert result.names == NAMES
    assert result.bones.tolist() == [18, 15, 0]


def test_a_gap_is_bridged_and_told():
    sensor = swinging(100.0)
    keep = (sensor.time_s < 1.0) | (sensor.time_s > 1.5)
    gap = SensorData(*(None if c is None else c[keep] for c in sensor))
    result = measure(recording(head=gap), PLAIN, 60.0)
    t = result.time_s
    inside = (t > 0.995) & (t < 1.505)  # samples at 0.99 and 1.51 s are there
    assert result.held[inside, 1].all()
    assert not result.held[~inside, 1].any()
    assert not result.held[:, [0, 2]].any()
    touched = (t > 0.995 - 1 / 60) & (t < 1.505 + 1 / 60)
    np.testing.assert_array_equal(result.valid[1:-3, 1], ~touched[1:-3])
    assert result.valid[1:-3, 0].all()
    # along the shorter arc between the samples on both sides
    ends = np.sin([gap.time_s[gap.time_s < 1.0][-1], gap.time_s[gap.time_s > 1.5][0]])
    angles = rot.yaw_of_quat(rot.matrix_to_quat(result.orientation[inside, 1]))
    assert ((angles >= ends.min()) & (angles <= ends.max())).all()


def test_a_sensor_that_ends_early_is_held_to_the_end():
    result = measure(recording(head=swinging(100.0, seconds=2.0)), PLAIN, 60.0)
    assert result.time_s[-1] > 3.9
    late = result.time_s > 2.0
    assert result.held[late, 1].all()
    assert not result.valid[late, 1].any()
    np.testing.assert_allclose(
        result.orientation[-1, 1], rot.rotation_about_axis("z", np.sin(1.99)), atol=1e-9
    )


def test_frames_begin_where_the_last_sensor_begins():
    result = measure(recording(pelvis=swinging(100.0, start=0.5)), PLAIN, 60.0)
    assert result.time_s[0] == 0.5


def test_one_sample_is_one_frame():
    result = measure(recording(**{name: swinging(100.0, seconds=0.01) for name in NAMES}), PLAIN, 60.0)
    assert result.orientation.shape == (1, 3, 3, 3)
    assert not result.valid.any()


def test_samples_of_the_same_time_count_once():
    sensor = swinging(100.0)
    twice = SensorData(*(None if c is None else np.repeat(c, 2, axis=0) for c in sensor))
    once, doubled = measure(recording(), PLAIN, 60.0), measure(recording(head=twice), PLAIN, 60.0)
    np.testing.assert_allclose(once.acceleration, doubled.acceleration, atol=1e-9)


def test_magnetometer_rows_without_orientation_are_passed_over():
    sensor = swinging(100.0)
    quat, acc = sensor.quat.copy(), sensor.acc.copy()
    quat[1::2] = np.nan
    acc[::2] = np.nan
    result = measure(recording(head=SensorData(sensor.time_s, quat, acc)), PLAIN, 60.0)
    inside = result.valid.all(axis=1)
    assert inside.sum() > 220
    whole = measure(recording(), PLAIN, 60.0)
    np.testing.assert_allclose(result.acceleration[inside, 1], whole.acceleration[inside, 1], atol=0.02)


def test_what_cannot_be_measured_is_told():
    with pytest.raises(EdgeposeError, match=r"2 sensors \(left_forearm, head\) are too few .* give 3 to 17"):
        measure(recording(), {name: PLAIN[name] for name in NAMES[:2]}, 60.0)
    raw = swinging(100.0)._replace(quat=None)
    with pytest.raises(EdgeposeError, match="head: the recording has no orientations"):
        measure(recording(head=raw), PLAIN, 60.0)
    with pytest.raises(EdgeposeError, match=r"head: no sample after all sensors had started, at 10\.00 s"):
        measure(
            recording(pelvis=swinging(100.0, start=10.0), left_forearm=swinging(100.0, 20.0)), PLAIN, 60.0
        )
    parts = swinging(100.0), swinging(100.0, start=100.0)
    pause = SensorData(*(None if a is None else np.concatenate([a, b]) for a, b in zip(*parts, strict=True)))
    with pytest.raises(EdgeposeError, match=r"all sensors are silent from 3\.99 to 100\.00 s"):
        measure(recording(**dict.fromkeys(NAMES, pause)), PLAIN, 60.0)


# --- further sensors ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def with_thigh(wearer, tmp_path_factory):
    """The wearer's recording with a thigh sensor, made of the shank's and mounted in another way."""
    whole = read_recording(wearer.recording)
    shank = whole.sensors["left_lower_leg"]
    mounted = rot.rotvec_to_quat([0.3, -1.0, 0.5])
    sensors = whole.sensors | {
        "left_upper_leg": shank._replace(
            quat=rot.quat_multiply(shank.quat, mounted),
            acc=rot.quat_rotate(rot.quat_conjugate(mounted), shank.acc),
            gyr=None,
        )
    }
    path = tmp_path_factory.mktemp("thigh") / "seven.npz"
    write_npz(path, Recording(sensors, {}))
    return path


def test_further_sensors_are_mounted_by_the_hold(wearer, with_thigh):
    calibration = load_calibration(wearer.calibration)
    data = reading.read(with_thigh, calibration)
    assert len(data.sensors) == 7
    result = measure(data, reading.mounted(with_thigh, data, calibration, 1.0), 60.0)
    assert result.names[-1] == "left_upper_leg"
    # Thigh and shank are straight in the hold, and this thigh moves with its shank.
    shank, thigh = (
        result.orientation[:, result.names.index(n)] for n in ("left_lower_leg", "left_upper_leg")
    )
    assert np.degrees(rot.geodesic_angle(shank, thigh)).max() < 0.1
    shank, thigh = (
        result.acceleration[:, result.names.index(n)] for n in ("left_lower_leg", "left_upper_leg")
    )
    np.testing.assert_allclose(shank, thigh, atol=1e-3)


def test_when_the_pose_was_held_must_be_known(wearer, with_thigh):
    calibration = load_calibration(wearer.calibration)
    data = reading.read(with_thigh, calibration)
    with pytest.raises(EdgeposeError, match="does not know left_upper_leg; say with --hold-from"):
        reading.mounted(with_thigh, data, calibration, None)
    with pytest.raises(EdgeposeError, match="left_upper_leg: 0 orientations from 50 to 53 s"):
        mounts_from_hold(data, calibration, ["left_upper_leg"], 50.0, 53.0)


def test_orientations_are_made_as_the_calibration_says(wearer, with_thigh):
    calibration = replace(load_calibration(wearer.calibration), filter="kalman", north=False)
    data = reading.read(wearer.short, calibration)
    sent = read_recording(wearer.short)
    for name, made in data.sensors.items():
        change = rot.quat_multiply(made.quat, rot.quat_conjugate(sent.sensors[name].quat))
        # Headings are the filter's own; the rest agrees, save in sharp movements.
        tilt = 2.0 * np.arctan2(np.hypot(change[:, 1], change[:, 2]), np.hypot(change[:, 0], change[:, 3]))
        assert np.degrees(np.median(tilt)) < 2.0, name
        assert not np.array_equal(made.quat, sent.sensors[name].quat)
    with pytest.raises(
        EdgeposeError, match=r"with --filter kalman, without left_upper_leg: calibrate again with all"
    ):
        reading.read(with_thigh, calibration)


def test_only_named_bones_are_read(with_thigh, tmp_path):
    with pytest.raises(EdgeposeError, match="unknown sensor"):
        read_sensors(with_thigh, PLACEMENTS)
    assert list(read_sensors(with_thigh, tuple(SITES)).sensors)[-1] == "left_upper_leg"
    np.savez(tmp_path / "tail.npz", t=np.zeros(1), tail_quat=np.ones((1, 4)))
    with pytest.raises(EdgeposeError, match=r"unknown sensor; the names are left_forearm, .*right_foot"):
        read_sensors(tmp_path / "tail.npz", tuple(SITES))
    assert len(SITES) == 17
    assert len(set(SITES.values())) == 17
