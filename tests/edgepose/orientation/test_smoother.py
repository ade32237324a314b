"""The smoother on motion that is known."""

import numpy as np

from edgepose import rotations as rot
from edgepose.orientation import OrientationFilter, smooth


def rms(values):
    return float(np.sqrt(np.mean(values**2)))


def test_it_is_better_than_the_filter_from_the_first_sample(simulate, angles):
    data = simulate(np.arange(0, 40, 0.02), seed=1, bias=2.0)
    online = OrientationFilter().update(*data.measured)
    offline = smooth(*data.measured)
    for before, after in zip(angles(online.quat, data.quat), angles(offline.quat, data.quat), strict=True):
        assert rms(after) < 0.5 * rms(before)
    assert rms(angles(offline.quat, data.quat)[1][:100]) < 1.5
    assert (offline.bias_sigma[:-1] <= online.bias_sigma[:-1] + 1e-12).all()
    assert np.abs(np.rad2deg(offline.bias[0] - data.bias)).max() < 0.3


def test_it_ends_where_the_filter_ends(worn):
    online, offline = OrientationFilter().update(*worn.measured), smooth(*worn.measured)
    np.testing.assert_allclose(online.quat[-1], offline.quat[-1], atol=1e-9)
    np.testing.assert_array_equal(online.flagged, offline.flagged)


def test_it_has_no_jumps(simulate):
    """Orientations follow the rates: corrections are spread over their blocks."""
    data = simulate(np.arange(0, 20, 0.01), seed=1, noise=0.0, bias=0.0)
    quat = smooth(*data.measured).quat
    turned = rot.quat_to_rotvec(rot.quat_multiply(rot.quat_conjugate(quat[:-1]), quat[1:]))
    assert np.abs(np.rad2deg(turned - data.gyr[1:] * 0.01)).max() < 0.15


def test_gaps_and_bad_samples(worn, angles):
    there = worn.rows((worn.time_s < 15) | (worn.time_s > 18))
    acc = there.acc.copy()
    acc[700] = np.nan
    result = smooth(there.time_s, there.gyr, acc, there.mag)
    assert np.isfinite(result.quat).all()
    assert rms(angles(result.quat, there.quat)[1][there.time_s > 20]) < 0.6


def test_before_the_first_field_the_heading_is_known_too(simulate, angles):
    data = simulate(np.arange(0, 20, 0.01), seed=6, still=[(0, 4)])
    mag = np.where(data.time_s[:, None] < 5, np.nan, data.mag)
    assert rms(angles(smooth(*data.measured[:3], mag).quat, data.quat)[0]) < 2.0


def test_nothing_and_one_sample():
    empty = np.zeros((0, 3))
    assert smooth([], empty, empty).quat.shape == (0, 4)
    one = smooth([1.0], np.zeros((1, 3)), [[0.0, 0.0, 9.81]])
    np.testing.assert_allclose(one.quat, [[1.0, 0.0, 0.0, 0.0]])
