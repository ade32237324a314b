"""What --filter does to the samples of a run, and what it tells."""

from edgepose.imu import ImuSample
from edgepose.orientation.stage import OrientationStage

LEVEL = (0.0, 0.0, 9.81)


def raw(sensor: int, k: int, **other) -> ImuSample:
    return ImuSample(sensor, 0.01 * k, acc=LEVEL, gyr=(0.0, 0.0, 0.0), **other)


def test_samples_that_cannot_be_oriented_are_left_out() -> None:
    orient = OrientationStage("kalman", magnetometer=True)
    field = ImuSample(5, 0.105, mag=(20.0, 0.0, -40.0))
    without_rate = ImuSample(5, 0.11, acc=LEVEL)
    never_a_rate = ImuSample(4, 0.11, acc=LEVEL)
    came = orient([*(raw(5, k) for k in range(10)), field, without_rate, never_a_rate])
    assert [sample.sensor for sample in came] == [5] * 10 + [4]
    assert all(sample.quat is not None for sample in came[:10])
    # A sensor that sends no rate at all is told by whoever wants its orientation.
    assert came[-1] == never_a_rate


def test_without_a_filter_all_pass() -> None:
    samples = [ImuSample(5, 0.1, mag=(20.0, 0.0, -40.0)), raw(5, 11)]
    assert OrientationStage("none", magnetometer=True)(samples) is samples


def test_some_with_a_magnetometer_and_some_without() -> None:
    orient = OrientationStage("kalman", magnetometer=True)
    orient([raw(sensor, 0, mag=(20.0, 0.0, -40.0)) for sensor in range(3)] + [raw(s, 0) for s in range(3, 6)])
    assert orient.mixed
    assert not orient.north
    assert not OrientationStage("kalman", magnetometer=False).mixed


def test_fields_of_sensors_that_the_calibration_lacks_do_not_count() -> None:
    orient = OrientationStage("kalman", magnetometer=True)
    for sensor in (6, 7, *range(6)):
        orient([raw(sensor, 0, mag=(20.0, 0.0, -40.0))])
    assert orient.north
    assert orient.without_field == []


def test_gaps_are_told_at_the_end() -> None:
    orient = OrientationStage("kalman", magnetometer=False)
    orient([raw(2, k) for k in [*range(100), *range(150, 250)]])
    assert orient.summary_lines() == ["filter   left_lower_leg: 1 gap"]
    assert OrientationStage("none", magnetometer=True).summary_lines() == []
