"""Samples of several sensors, oriented; recordings with a filter."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from edgepose import rotations as rot
from edgepose.cli import cli
from edgepose.errors import EdgeposeError
from edgepose.formats.recordings import xio_session as xio
from edgepose.formats.recordings.base import iter_samples
from edgepose.formats.recordings.registry import read_recording
from edgepose.imu import ImuSample, Recording, SensorData
from edgepose.orientation import Event, OrientationEstimator, OrientationFilter, smooth
from edgepose.orientation.offline import orient_recording
from edgepose.orientation.vqf_filter import VqfFilter

REAL = Path(__file__).parents[2] / "data" / "imu" / "six-sites-3s.npz"
XIO = REAL.parent / "xio-lower-body"
DEVICE = (0.5, 0.5, 0.5, 0.5)


def samples_of(sensor, data, count, mag=True):
    return [
        ImuSample(
            sensor,
            float(data.time_s[i]),
            DEVICE,
            tuple(data.acc[i].tolist()),
            tuple(data.gyr[i].tolist()),
            tuple(data.mag[i].tolist()) if mag else None,
        )
        for i in range(count)
    ]


@pytest.mark.parametrize(("kind", "make"), [("kalman", OrientationFilter), ("vqf", VqfFilter)])
@pytest.mark.parametrize("size", [1, 7, 1000])
def test_each_sensor_has_its_own_filter(worn, kind, make, size):
    both = [samples_of(4, worn, 500), samples_of(1, worn.rows(slice(1000, 1500)), 500, mag=False)]
    mixed = [sample for pair in zip(*both, strict=True) for sample in pair]
    orienter = OrientationEstimator(kind)
    result = [s for start in range(0, 1000, size) for s in orienter.orient(mixed[start : start + size])]
    assert [s[:2] + s[3:] for s in result] == [s[:2] + s[3:] for s in mixed]
    first = make().update(*worn.rows(slice(0, 500)).measured)
    second = make().update(*worn.rows(slice(1000, 1500)).measured[:3])
    np.testing.assert_allclose([s.quat for s in result[::2]], first.quat, atol=1e-9)
    np.testing.assert_allclose([s.quat for s in result[1::2]], second.quat, atol=1e-9)
    status = orienter.status()
    assert list(status) == [1, 4]
    assert status[4].rest == first.rest[-1]
    np.testing.assert_allclose(status[4].bias, np.rad2deg(first.bias[-1]), atol=1e-9)


def test_samples_without_a_rate_keep_what_they_have(worn):
    whole = samples_of(0, worn, 400)
    parts = []
    for sample in whole:
        # A magnetometer with messages of its own, before those of the rest.
        parts += [ImuSample(0, sample.time_s, mag=sample.mag), sample._replace(mag=None)]
    parts.insert(100, ImuSample(0, 1.0, DEVICE, acc=(0.0, 0.0, 9.8)))
    result = OrientationEstimator().orient(parts)
    assert result[100] == parts[100]
    expected = OrientationEstimator().orient(whole)
    oriented = [sample for sample in result if sample.gyr is not None]
    np.testing.assert_allclose([s.quat for s in oriented], [s.quat for s in expected], atol=1e-9)


def test_magnetometers_can_be_left_out(worn):
    result = OrientationEstimator(magnetometer=False).orient(samples_of(2, worn, 300))
    expected = OrientationFilter().update(*worn.rows(slice(0, 300)).measured[:3])
    np.testing.assert_allclose([s.quat for s in result], expected.quat, atol=1e-12)


def test_status_counts_events(worn):
    orienter = OrientationEstimator()
    batch = samples_of(3, worn, 300)
    del batch[150:160], batch[200:230]
    orienter.orient(batch[:180])
    orienter.orient(batch[180:])
    orienter.orient([batch[-1]])
    assert orienter.status()[3].events == {Event.GAP: 2, Event.STAMP: 1}


def test_filters_come_only_when_asked_for():
    code = (
        "import sys; from edgepose.orientation import OrientationEstimator;"
        "assert 'filterpy' not in sys.modules;"
        "OrientationEstimator(); assert 'filterpy' in sys.modules and 'vqf' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_vqf_that_is_not_installed(tmp_path):
    code = (
        "import sys; sys.modules['vqf'] = None\n"
        "from edgepose.cli import main\n"
        f"sys.argv = ['edgepose', 'convert', {str(REAL)!r}, '--to', 'csv', '--out', {str(tmp_path)!r}, "
        "'--filter', 'vqf']\nmain()"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert "pip install 'edgepose[vqf]'" in result.stderr


def test_vqf_is_vqf(worn):
    from vqf import VQF

    expected = VQF(0.01).updateBatch(*(np.ascontiguousarray(c) for c in worn.measured[1:]))
    ours = VqfFilter().update(*worn.measured)
    np.testing.assert_allclose(np.abs((ours.quat * expected["quat9D"]).sum(axis=1)), 1.0, atol=1e-4)
    np.testing.assert_array_equal(ours.rest[100:], expected["restDetected"][100:])


# --- recordings ---------------------------------------------------------------------------------------------


def inclination(quat, truth):
    up = rot.quat_rotate(rot.quat_conjugate(quat), np.array([0.0, 0.0, 1.0]))
    true_up = rot.quat_rotate(rot.quat_conjugate(truth), np.array([0.0, 0.0, 1.0]))
    return np.rad2deg(np.arccos(np.clip((up * true_up).sum(axis=1), -1, 1)))


@pytest.mark.parametrize("kind", ["kalman", "smoother", "vqf"])
def test_a_real_recording_without_its_orientations(kind):
    """Standing straight: a filter offline over the whole recording and one over three seconds agree."""
    recording = read_recording(REAL)
    result = orient_recording(recording, kind)
    assert result.metadata["filter"] == kind
    for name, data in result.sensors.items():
        assert inclination(data.quat, recording.sensors[name].quat).mean() < 2.5, name


@pytest.mark.parametrize("sensor", ["pelvis", "left_lower_leg"])
@pytest.mark.parametrize("kind", ["kalman", "smoother"])
def test_a_device_with_a_filter_of_its_own(sensor, kind):
    """18 s with disturbed fields; the device counts its heading from north, ours from east."""
    device = xio.read_session(XIO)
    assert device.damage is None
    ours = orient_recording(device, kind).sensors[sensor].quat
    truth = rot.quat_multiply(rot.quat_about_z(np.pi / 2), device.sensors[sensor].quat)
    error = rot.quat_to_rotvec(rot.quat_multiply(ours[100:], rot.quat_conjugate(truth[100:])))
    assert np.rad2deg(np.linalg.norm(error, axis=1)).mean() < 4.5
    assert inclination(ours[100:], truth[100:]).mean() < 2.5


def test_rows_without_a_rate_keep_their_orientation(worn):
    count = 300
    gyr, quat = worn.gyr[:count].copy(), np.tile(DEVICE, (count, 1))
    gyr[1::2] = np.nan
    data = SensorData(worn.time_s[:count], quat, worn.acc[:count], gyr, worn.mag[:count])
    result = orient_recording(Recording({"head": data}, {}), "smoother").sensors["head"].quat
    np.testing.assert_array_equal(result[1::2], quat[1::2])
    half = worn.rows(slice(0, count, 2))
    np.testing.assert_allclose(result[::2], smooth(*half.measured).quat)


def test_a_recording_without_rates():
    recording = read_recording(REAL)
    recording.sensors["head"] = recording.sensors["head"]._replace(gyr=None)
    with pytest.raises(EdgeposeError, match="head has no rates"):
        orient_recording(recording, "kalman", name="walk.npz")


def test_convert_with_a_filter(tmp_path):
    arguments = ["convert", str(REAL), "--to", "npz", "--out", str(tmp_path), "--filter", "kalman"]
    cli.main(arguments, standalone_mode=False)
    written = read_recording(tmp_path / REAL.name)
    oriented = OrientationEstimator().orient(list(iter_samples(read_recording(REAL))))
    for sample, expected in zip(iter_samples(written), oriented, strict=True):
        np.testing.assert_allclose(sample.quat, expected.quat, atol=1e-6)
