"""What is measured on a rig's samples; every fault gives its advice: real samples, broken on purpose."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from edgepose import rotations as rot
from edgepose.calibration import GRAVITY, load_calibration
from edgepose.diagnostics.rules import Diagnosis, diagnose
from edgepose.diagnostics.sensor_health import SensorHealth, SensorHealthMonitor
from edgepose.diagnostics.sensor_health.columns import TIME
from edgepose.diagnostics.sensor_health.timing import Timing
from edgepose.formats.recordings.base import iter_samples
from edgepose.formats.recordings.registry import read_recording
from edgepose.imu import ImuSample, SensorData
from edgepose.placements import PLACEMENTS
from edgepose.sources.clock_sync import DeviceClock

REAL = Path(__file__).parents[2] / "data" / "imu" / "six-sites-3s.npz"
HEAD = PLACEMENTS.index("head")

Fault = Callable[[SensorData], SensorData]


def report(rows: list[ImuSample], late_s: float = 0.0, **options: object) -> list[SensorHealth]:
    """Health after samples that came in order, a hundredth of a second at a time."""
    health = SensorHealthMonitor(**options)
    for sample in rows:
        health.add([sample], sample.time_s)
    return health.report(max(sample.time_s for sample in rows) + late_s)


def findings(rows: list[ImuSample], **options: object) -> list[Diagnosis]:
    return [diagnose(sensor) for sensor in report(rows, **options)]


def only(sensor: int, fault: Fault, recording) -> list[ImuSample]:
    """A recording's samples, those of one sensor with a fault."""
    name = PLACEMENTS[sensor]
    return list(
        iter_samples(recording._replace(sensors=recording.sensors | {name: fault(recording.sensors[name])}))
    )


@pytest.fixture(scope="module")
def still():
    """Three seconds of standing, really measured."""
    return read_recording(REAL)


@pytest.fixture(scope="module")
def moving(wearer):
    """Six seconds of standing and six of walking, without any noise."""
    return read_recording(wearer.recording)


def with_noise(recording, seed: int = 3):
    """A recording with the noise that real sensors have, and the resolution of 16 bits."""
    rng = np.random.default_rng(seed)

    def noisy(data: SensorData) -> SensorData:
        return data._replace(
            acc=np.round((data.acc + rng.normal(scale=0.02, size=data.acc.shape)) * 100) / 100,
            gyr=np.round((data.gyr + rng.normal(scale=0.002, size=data.gyr.shape)) * 900) / 900,
        )

    return recording._replace(sensors={name: noisy(data) for name, data in recording.sensors.items()})


# --- rigs without a fault -----------------------------------------------------------------------------------


def test_real_sensors_are_fine_and_their_numbers_right(still):
    for sensor, data in zip(report(list(iter_samples(still))), still.sensors.values(), strict=True):
        assert diagnose(sensor) == Diagnosis("ok")
        force = rot.quat_rotate(data.quat, data.acc)
        assert sensor.samples == 300
        assert sensor.rate_hz == pytest.approx(100.0, rel=1e-3)
        assert sensor.lost_percent == 0.0
        assert sensor.jitter_ms < 0.01
        assert sensor.norm_m_s2 == pytest.approx(np.linalg.norm(data.acc.mean(axis=0)), abs=0.05)
        error = np.linalg.norm(force.mean(axis=0) - [0, 0, GRAVITY])
        assert sensor.gravity_error_m_s2 == pytest.approx(error, abs=0.05)
        assert sensor.tilt_deg < 0.5
        assert 0.0 < sensor.acc_noise_m_s2 <= np.sqrt(data.acc.var(axis=0).sum()) * 1.1
        assert 0.0 < sensor.gyr_noise_deg_s < 2.0
        assert sensor.bias_deg_s < 1.0


@pytest.mark.parametrize("noise", [False, True])
def test_a_wearer_who_stands_and_walks_is_fine(moving, noise):
    rows = list(iter_samples(with_noise(moving) if noise else moving))
    assert findings(rows) == [Diagnosis("ok")] * 6
    for sensor in report(rows):
        assert sensor.gyro_ratio == pytest.approx(1.0, abs=0.05)
        assert sensor.gyro_agreement > 0.95


def test_nothing_is_said_of_rest_while_all_moves(moving):
    rows = [s for s in iter_samples(with_noise(moving)) if s.time_s > 9.5 and s.sensor != HEAD]
    found = findings(rows)
    assert found[0].name == "ok, moving"
    assert not found[0].problem
    assert found[HEAD].name == "no packets"


def test_raw_sensors_are_told_how_to_go_on(still):
    (found,) = set(findings([s._replace(quat=None) for s in iter_samples(still)]))
    assert found.name == "ok, raw"
    assert "--filter" in found.advice
    assert not found.problem


# --- faults of a sensor that stands still -------------------------------------------------------------------


def turned(data: SensorData, turn: np.ndarray) -> SensorData:
    """With another orientation, multiplied from the left."""
    return data._replace(quat=rot.quat_multiply(turn, data.quat))


def scaled(factor: float) -> Fault:
    return lambda data: data._replace(acc=data.acc * factor)


def without_gravity(data: SensorData) -> SensorData:
    up = rot.quat_rotate(rot.quat_conjugate(data.quat), np.tile([0.0, 0.0, GRAVITY], (len(data.quat), 1)))
    return data._replace(acc=data.acc - up)


def with_nan(data: SensorData) -> SensorData:
    acc = data.acc.copy()
    acc[::7, 1] = np.nan
    return data._replace(acc=acc)


def noisy(data: SensorData) -> SensorData:
    return data._replace(acc=data.acc + np.random.default_rng(1).normal(scale=0.5, size=data.acc.shape))


def every(step: int) -> Fault:
    return lambda data: SensorData(*(None if column is None else column[::step] for column in data))


def jumpy(data: SensorData) -> SensorData:
    rng = np.random.default_rng(2)
    return data._replace(time_s=data.time_s + rng.uniform(0.0, 0.009, len(data.time_s)))


def thinned(data: SensorData) -> SensorData:
    keep = np.random.default_rng(4).random(len(data.time_s)) > 0.1
    return SensorData(*(None if column is None else column[keep] for column in data))


NED = np.array([0.0, math.sqrt(0.5), math.sqrt(0.5), 0.0])


@pytest.mark.parametrize(
    ("name", "fault", "says"),
    [
        ("unit", scaled(1 / GRAVITY), "in g"),
        ("unit", scaled(1000 / GRAVITY), "in milli-g"),
        ("scale", scaled(2.0), "not 9.81"),
        ("no gravity", without_gravity, "gravity is already removed"),
        ("frame", scaled(-1.0), "negated"),
        ("frame", lambda d: turned(d, NED), "Z down"),
        ("frame", lambda d: d._replace(quat=rot.quat_conjugate(d.quat)), "inverse"),
        ("frame", lambda d: d._replace(quat=d.quat[:, [1, 2, 3, 0]]), "x, y, z, w"),
        ("frame", lambda d: turned(d, np.array([1.0, -1.0, 0, 0]) / math.sqrt(2)), "Y up"),
        ("frame", lambda d: d._replace(acc=d.acc * [1, 1, -1]), "disagree"),
        ("frame", lambda d: turned(d, rot.rotvec_to_quat([0.3, 0, 0])), "by 17 deg"),
        ("noise", noisy, "low-pass"),
        ("gyro unit", lambda d: d._replace(gyr=d.gyr * 57.3), "sends deg/s instead of rad/s"),
        ("bias", lambda d: d._replace(gyr=d.gyr + np.array([0.0, 0.1, 0.0])), "5.7 deg/s at rest"),
        ("slow", every(5), "20 samples a second"),
        ("irregular", jumpy, "intervals vary"),
        ("loss", thinned, "% of its samples are missing"),
        ("invalid", with_nan, "are not measurements"),
        ("not sent", lambda d: d._replace(acc=None), "no acceleration"),
        ("not sent", lambda d: d._replace(quat=None, gyr=None), "no orientation"),
        ("field", lambda d: d._replace(mag=np.full((300, 3), 120.0)), "208 uT"),
        ("field", lambda d: d._replace(mag=np.linspace([20.0] * 3, [40.0] * 3, 300)), "changes by"),
    ],
)
def test_a_fault_at_rest_gives_its_advice(still, name, fault, says):
    with np.errstate(invalid="raise"):
        found = findings(only(HEAD, fault, still))
    assert found[HEAD].name == name, found[HEAD]
    assert says in found[HEAD].advice
    assert found[HEAD].problem
    assert found[:HEAD] + found[HEAD + 1 :] == [Diagnosis("ok")] * 5


def test_earth_field_is_fine(still):
    field = rot.quat_rotate(rot.quat_conjugate(still.sensors["head"].quat), np.array([0.0, 20.0, -40.0]))
    sensor = report(only(HEAD, lambda d: d._replace(mag=field), still))[HEAD]
    assert diagnose(sensor) == Diagnosis("ok")
    assert sensor.field_ut == pytest.approx(math.hypot(20, 40))


def test_no_sample_at_all():
    health = SensorHealthMonitor()
    assert {diagnose(sensor).name for sensor in health.report(5.0)} == {"no packets"}


def test_a_sensor_that_falls_silent(still):
    rows = [
        s for s in iter_samples(still) if s.sensor != HEAD or s.time_s < still.sensors["head"].time_s[150]
    ]
    found = findings(rows)
    assert found[HEAD].name == "silent"
    assert "nothing for 1.5 s" in found[HEAD].advice


def test_two_placements_with_the_same_data(still):
    found = findings(only(HEAD, lambda _: still.sensors["pelvis"], still))
    assert [f.name for f in found] == ["ok"] * 4 + ["same data"] * 2
    assert "same values as pelvis" in found[HEAD].advice


def test_two_devices_under_one_name(still):
    other = still.sensors["pelvis"]

    def mixed(data: SensorData) -> SensorData:
        odd = np.arange(300)[:, None] % 2 == 1
        return data._replace(
            quat=np.where(odd, other.quat, data.quat), acc=np.where(odd, other.acc, data.acc)
        )

    assert findings(only(HEAD, mixed, still))[HEAD].name == "two devices"


def test_a_magnetometer_in_packets_of_its_own(still):
    """They have the time of the packet before them; the two are one sample."""
    rows = [
        part
        for sample in iter_samples(still)
        for part in (
            sample._replace(mag=None),
            ImuSample(sample.sensor, sample.time_s, None, None, None, (20.0, 1.0, -40.0)),
        )
    ]
    for health in report(rows):
        assert diagnose(health).name == "ok"
        assert health.rate_hz == pytest.approx(100.0, abs=2.0)
        assert health.field_ut == pytest.approx(44.7, abs=0.1)


def test_a_sensor_that_hangs(still):
    def hanging(data: SensorData) -> SensorData:
        return SensorData(data.time_s, *(np.tile(q[0], (300, 1)) for q in data[1:4]))

    found = findings(only(HEAD, hanging, still))
    assert found[HEAD].name == "frozen"
    assert [f.name for f in found].count("ok") == 5


def test_packets_in_bursts(moving):
    health = SensorHealthMonitor()
    for sample in iter_samples(moving):
        health.add([sample], math.ceil(sample.time_s / 0.06) * 0.06)
    found = [diagnose(sensor) for sensor in health.report(12.0)]
    assert {f.name for f in found} == {"late"}
    assert "latency timer" in found[0].advice


# --- faults that show in motion -----------------------------------------------------------------------------


def stuck(column: str) -> Fault:
    def fault(data: SensorData) -> SensorData:
        values = getattr(data, column).copy()
        values[700:] = values[700]
        return data._replace(**{column: values})

    return fault


def clipped(data: SensorData) -> SensorData:
    acc = data.acc + 40.0 * np.sin(data.time_s * 8.0)[:, None] * (data.time_s > 7.0)[:, None]
    return data._replace(acc=np.clip(acc, -4 * GRAVITY, 4 * GRAVITY))


def doubled(data: SensorData) -> SensorData:
    rows = np.arange(len(data.time_s)) // 2 * 2
    return SensorData(data.time_s, data.quat[rows], data.acc[rows], data.gyr[rows])


@pytest.mark.parametrize(
    ("name", "fault", "says"),
    [
        ("gyro unit", lambda d: d._replace(gyr=d.gyr * 57.2958), "sends deg/s instead of rad/s"),
        ("gyro unit", lambda d: d._replace(gyr=d.gyr / 57.2958), "sends rad/s instead of deg/s"),
        ("gyro axes", lambda d: d._replace(gyr=d.gyr[:, [1, 0, 2]] * [1, -1, 1]), "axes or signs"),
        ("gyro axes", lambda d: d._replace(gyr=-d.gyr), "axes or signs"),
        ("gyro axes", lambda d: d._replace(gyr=rot.quat_rotate(d.quat, d.gyr)), "gyroscope"),
        ("gyro scale", lambda d: d._replace(gyr=d.gyr * 2), "check the gyroscope's range"),
        ("frozen", stuck("quat"), "its orientation does not change"),
        ("frozen", stuck("acc"), "its acceleration does not change"),
        ("frozen", stuck("gyr"), "its gyroscope does not change"),
        ("range", clipped, "acceleration at the end"),
        ("repeats", doubled, "measures more slowly"),
    ],
)
def test_a_fault_in_motion_gives_its_advice(moving, name, fault, says):
    arm = PLACEMENTS.index("right_forearm")
    found = findings(only(arm, fault, with_noise(moving)))
    assert found[arm].name == name, found[arm]
    assert says in found[arm].advice
    assert found[:arm] + found[arm + 1 :] == [Diagnosis("ok")] * 5


# --- headings and placements --------------------------------------------------------------------------------


def lying(headings_deg: list[float], noise: float = 0.01) -> list[ImuSample]:
    """Six sensors side by side on a table."""
    rng = np.random.default_rng(5)
    data = {}
    for name, heading in zip(PLACEMENTS, headings_deg, strict=True):
        quat = rot.quat_multiply(rot.quat_about_z(math.radians(heading)), rot.rotvec_to_quat([0.02, 0.01, 0]))
        up = rot.quat_rotate(rot.quat_conjugate(quat), [0.0, 0.0, GRAVITY])
        n = 300
        data[name] = SensorData(
            np.arange(n) / 100.0,
            np.tile(quat, (n, 1)),
            up + rng.normal(scale=noise, size=(n, 3)),
            rng.normal(scale=0.001, size=(n, 3)),
        )
    recording = read_recording(REAL)
    return list(iter_samples(recording._replace(sensors=data)))


def test_headings_on_a_table():
    rows = report(lying([90, 93, 88, 90, 150, 91]))
    assert [row.heading_on for row in rows] == ["table"] * 6
    assert rows[HEAD].heading_deg == pytest.approx(60, abs=0.5)
    assert [diagnose(row).name for row in rows] == ["ok"] * 4 + ["heading", "ok"]
    assert "+60 deg" in diagnose(rows[HEAD]).advice
    assert "--heading-reset" in diagnose(rows[HEAD]).advice


def test_headings_across_the_turn():
    rows = report(lying([179, -179, 178, -178, 180, 177]))
    assert max(abs(row.heading_deg) for row in rows) < 4
    assert {diagnose(row).name for row in rows} == {"ok"}


def test_a_wearer_who_stands_in_the_pose_again(moving, wearer):
    calibration = load_calibration(wearer.calibration)
    standing = [s for s in iter_samples(moving) if s.time_s < 4.0]
    for turn, sensor, name in ((0.0, HEAD, "ok"), (50.0, HEAD, "heading"), (-50.0, 2, "heading")):
        wrong = rot.quat_about_z(math.radians(turn))
        rows = [
            s._replace(quat=tuple(rot.quat_multiply(wrong, s.quat))) if s.sensor == sensor else s
            for s in standing
        ]
        found = report(rows, calibration=calibration)
        assert found[sensor].heading_on == "body"
        assert found[sensor].heading_deg == pytest.approx(turn, abs=1.0)
        assert diagnose(found[sensor]).name == name
        assert {diagnose(own).name for i, own in enumerate(found) if i != sensor} == {"ok"}


def test_two_sensors_that_were_swapped(moving, wearer):
    calibration = load_calibration(wearer.calibration)
    a, b = PLACEMENTS.index("left_forearm"), PLACEMENTS.index("pelvis")
    exchange = {a: b, b: a}
    rows = [
        s._replace(sensor=exchange.get(s.sensor, s.sensor)) for s in iter_samples(moving) if s.time_s < 4.0
    ]
    found = findings(rows, calibration=calibration)
    assert [f.name for f in found] == ["placement", *["ok"] * 4, "placement"]
    assert "where pelvis was calibrated" in found[a].advice


# --- clocks -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("ppm", "name"), [(0.0, "ok"), (100.0, "ok"), (800.0, "clock"), (-800.0, "clock")])
def test_a_clock_that_drifts(ppm, name):
    rng = np.random.default_rng(6)
    clock = DeviceClock()
    for count in range(3000):
        true_s = count * 0.01
        clock.host_time(round(true_s * (1.0 - ppm * 1e-6) * 1e6), 1.7e9 + true_s + rng.exponential(0.002))
    measured, error = clock.drift_ppm()
    assert measured == pytest.approx(ppm, abs=20.0)
    assert error < 20.0
    health = SensorHealthMonitor()
    health.add(lying([0.0] * 6))
    own = health.report(3.0, {HEAD: clock})[HEAD]
    assert diagnose(own).name == name


def test_a_clock_that_began_anew():
    clock = DeviceClock()
    for count in range(100):
        clock.host_time(count % 50 * 10_000, count * 0.01)
    assert math.isnan(clock.drift_ppm()[0])
    health = SensorHealthMonitor()
    health.add(lying([0.0] * 6))
    found = diagnose(health.report(3.0, {HEAD: clock})[HEAD])
    assert found.name == "restarts"
    assert found.advice == "its clock restarted; its heading may differ after that: check its power"


# --- hostile samples ----------------------------------------------------------------------------------------


def test_rubbish_raises_nothing():
    rng = np.random.default_rng(7)
    health = SensorHealthMonitor()
    values = [0.0, 1.0, -1.0, math.nan, math.inf, -math.inf, 1e300, 1e-300]
    for count in range(3000):
        pick = [tuple(rng.choice(values, n)) if rng.random() > 0.2 else None for n in (4, 3, 3, 3)]
        time_s = float(rng.choice([count * 0.01, 0.0]))
        with np.errstate(all="ignore"):
            health.add([ImuSample(int(rng.integers(6)), time_s, *pick)], time_s)
    with np.errstate(all="ignore"):
        found = [diagnose(sensor) for sensor in health.report(30.0)]
    assert all(f.problem for f in found)


def test_the_same_however_the_samples_come(moving):
    rows = list(iter_samples(with_noise(moving)))
    one, other = SensorHealthMonitor(), SensorHealthMonitor()
    one.add(rows)
    for sample in rows:
        other.add([sample])
    now_s = rows[-1].time_s
    for a, b in zip(one.report(now_s), other.report(now_s), strict=True):
        assert dataclasses.asdict(a) == pytest.approx(dataclasses.asdict(b), nan_ok=True)


def test_times_that_go_to_and_fro():
    """As in a capture that holds one piece again and again: there is no period."""
    window = np.zeros((31, 15))
    window[:, TIME] = [*np.tile([0.0, 0.01, 0.02], 10), 0.0]
    timing = Timing()
    timing.update(window, 31)
    assert math.isnan(timing.period_s)
    assert timing.result(window, 31, 0.0, 0.02).lost == 0
