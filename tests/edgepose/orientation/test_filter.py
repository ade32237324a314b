"""The orientation filter on motion that is known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edgepose import rotations as rot
from edgepose.orientation import Event, FilterSettings, OrientationFilter, OrientationResult
from edgepose.orientation.vqf_filter import VqfFilter

FILTERS = [OrientationFilter, VqfFilter]


def rms(values):
    return float(np.sqrt(np.mean(values**2)))


def in_chunks(make, columns, sizes):
    own, start, parts = make(), 0, []
    for size in sizes:
        parts.append(own.update(*(None if c is None else c[start : start + size] for c in columns)))
        start += size
    return OrientationResult(*map(np.concatenate, zip(*parts, strict=True)))


# --- accuracy -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", [25, 50, 100, 286, 1000])
def test_any_rate(simulate, angles, rate):
    data = simulate(np.arange(0, 20, 1 / rate), seed=2, still=[(0, 4)])
    result = OrientationFilter().update(*data.measured)
    total, inclination = angles(result.quat, data.quat)
    assert rms(total[data.time_s > 4]) < 1.0
    assert rms(inclination[data.time_s > 4]) < 0.6
    assert not result.flagged.any()


def test_uneven_times(simulate, angles):
    rng = np.random.default_rng(3)
    data = simulate(np.cumsum(rng.uniform(0.007, 0.013, 2000)), seed=2, still=[(0, 4)])
    result = OrientationFilter().update(*data.measured)
    assert rms(angles(result.quat, data.quat)[0][data.time_s > 4]) < 1.0


def test_start_in_motion(simulate, angles):
    data = simulate(np.arange(0, 30, 0.01), seed=1)
    total, inclination = angles(OrientationFilter().update(*data.measured).quat, data.quat)
    assert rms(inclination[(data.time_s > 5) & (data.time_s < 10)]) < 2.0
    assert rms(inclination[data.time_s > 20]) < 1.0
    assert rms(total[data.time_s > 20]) < 4.0


@pytest.mark.parametrize("still", [[(0, 5)], []], ids=["at rest", "in motion"])
def test_bias_of_a_bad_gyroscope_is_found(simulate, still):
    data = simulate(np.arange(0, 60, 0.01), seed=1, bias=6.0, still=still)
    result = OrientationFilter().update(*data.measured)
    assert np.abs(np.rad2deg(result.bias[-1] - data.bias)).max() < 0.2
    assert (np.abs(result.bias[-1] - data.bias) < 4 * result.bias_sigma[-1]).all()
    assert result.rest.any() == bool(still)


def test_it_knows_how_wrong_it_is(simulate):
    """Errors of bias over their sigmas: about 1, and certainly not 3, in any of many motions."""
    ratios = []
    for seed in range(8):
        data = simulate(np.arange(0, 30, 0.02), seed=seed, bias=1.0, noise=2.0)
        result = OrientationFilter().update(*data.measured)
        ratios.append((result.bias[-1] - data.bias) / result.bias_sigma[-1])
    square = np.mean(np.square(ratios))
    # The settings are for real sensors, whose errors are not white: on white noise they are cautious.
    assert 0.005 < square < 2.0


def test_without_a_magnetometer_heading_starts_at_zero(simulate, angles):
    data = simulate(np.arange(0, 20, 0.01), seed=4, still=[(0, 4)])
    result = OrientationFilter().update(*data.measured[:3])
    assert rot.yaw_of_quat(result.quat[0]) == pytest.approx(0.0, abs=1e-9)
    assert rms(angles(result.quat, data.quat)[1][data.time_s > 4]) < 0.6
    drift = np.rad2deg(
        np.unwrap(rot.yaw_of_quat(rot.quat_multiply(result.quat, rot.quat_conjugate(data.quat))))
    )
    assert abs(drift[-1] - drift[400]) < 2.0
    assert not result.disturbed.any()


def test_axes_are_east_north_up():
    count = 500
    still = np.zeros((count, 3))
    up = np.tile([0.0, 0.0, 9.81], (count, 1))
    # Lying flat, its X to the east: the field is along its Y and down.
    flat = OrientationFilter().update(np.arange(count) / 100, still, up, np.tile([0.0, 20, -40], (count, 1)))
    np.testing.assert_allclose(np.abs(flat.quat[[0, -1], 0]), 1.0, atol=1e-6)
    # Its X to the north: turned by 90 degrees from there.
    north = OrientationFilter().update(np.arange(count) / 100, still, up, np.tile([20.0, 0, -40], (count, 1)))
    np.testing.assert_allclose(rot.yaw_of_quat(north.quat[[0, -1]]), np.pi / 2, atol=1e-6)


@pytest.mark.parametrize("force", [(0, 0, -9.81), (0, 0, 0), (9.81, 0, 0)], ids=str)
def test_any_first_force(force):
    forces = np.tile(np.array(force, float), (300, 1))
    result = OrientationFilter().update(np.arange(300) / 100, np.zeros((300, 3)), forces)
    np.testing.assert_allclose(np.linalg.norm(result.quat, axis=1), 1.0)
    if any(force):
        np.testing.assert_allclose(rot.quat_rotate(result.quat, forces)[:, 2], 9.81, atol=1e-3)


def test_axes_that_sense_each_others_rotation_cost_little_heading(simulate):
    """Scale and cross-axis errors of 1 % show in the tilt, and are then known about the vertical, too."""
    data = simulate(np.arange(0, 60, 0.02), seed=6, turn=3.0, still=[(0, 4)])
    gyr = data.gyr @ np.array([[1.01, 0.0, 0.01], [-0.01, 0.99, 0.0], [0.0, 0.01, 1.01]]).T
    drifts = []
    for start in (FilterSettings().sensitivity_start, 1e-6):
        filter = OrientationFilter(FilterSettings(sensitivity_start=start))
        quat = filter.update(data.time_s, gyr, data.acc).quat
        error = np.unwrap(rot.yaw_of_quat(rot.quat_multiply(quat, rot.quat_conjugate(data.quat))))
        drifts.append(rms(np.rad2deg(error - error[200])))
    assert drifts[0] < 0.7 * drifts[1]


# --- chunks and stamps --------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", FILTERS)
@pytest.mark.parametrize("fields", [True, False], ids=["9D", "6D"])
def test_any_chunking_gives_the_same(worn, make, fields):
    columns = [*worn.rows(slice(0, 1500)).measured[:3], worn.mag[:1500] if fields else None]
    whole = make().update(*columns)
    rng = np.random.default_rng(5)
    for sizes in ([1] * 1500, [0, 700, 0, 800], [*rng.integers(1, 12, 200).tolist(), 1500]):
        for a, b in zip(whole, in_chunks(make, columns, sizes), strict=True):
            assert a.dtype == b.dtype
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-9)


steps = st.sampled_from(
    [0.01, 0.01, 0.01, 0.0, -0.004, -30.0, 1e-6, 0.02, 0.3, 2.0, 1e9, float("nan"), float("inf")]
)
rates = st.sampled_from([0.1, 0.1, 0.1, -3.0, 34.9, float("nan"), float("-inf"), 1e30])


@pytest.mark.parametrize("make", FILTERS)
@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(steps, rates, rates, st.booleans()), max_size=60), st.integers(1, 7))
def test_whatever_comes_a_rotation_comes_out(make, drawn, size):
    time_s, times = 100.0, []
    for step, *_ in drawn:
        times.append(time_s + step)
        time_s = times[-1] if np.isfinite(times[-1]) else time_s
    count = len(drawn)
    gyr = np.array([[rate, 0.0, -rate] for _, rate, _, _ in drawn]).reshape(count, 3)
    acc = np.array([[1.0, force * 3, 9.0] for _, _, force, _ in drawn]).reshape(count, 3)
    mag = np.array([[20.0, 1.0, np.nan if lost else -40.0] for *_, lost in drawn]).reshape(count, 3)
    columns = [np.array(times), gyr, acc, mag]
    result = make().update(*columns)
    assert [len(column) for column in result] == [count] * 6
    assert np.isfinite(result.quat).all()
    assert np.isfinite(result.bias).all()
    np.testing.assert_allclose(np.linalg.norm(result.quat, axis=1), 1.0, atol=1e-6)
    bad = ~(np.abs(gyr).sum(1) < 1e3) | ~(np.abs(acc).sum(1) < 1e4) | ~np.isfinite(times)
    np.testing.assert_array_equal(result.flagged & Event.BAD > 0, bad)
    again = in_chunks(make, columns, [size] * (count // size + 1))
    np.testing.assert_allclose(result.quat, again.quat, rtol=0, atol=1e-9)


@pytest.mark.parametrize("make", FILTERS)
def test_bad_samples_and_stamps_change_nothing_but_themselves(worn, make):
    clean = worn.rows(slice(0, 800))
    times, gyr, acc, mag = (np.repeat(column, 2, axis=0) for column in clean.measured)
    gyr[1::8, 0], acc[3::8, 2], times[5::8] = np.nan, np.inf, times[5::8] - 0.5
    result = make().update(times, gyr, acc, mag)
    expected = make().update(*clean.measured)
    np.testing.assert_allclose(result.quat[::2], expected.quat, atol=1e-9)
    np.testing.assert_allclose(result.quat[1::2], expected.quat, atol=1e-9)  # held
    assert (result.flagged[1::8] & Event.BAD).all()
    assert (result.flagged[3::8] & Event.BAD).all()
    assert (result.flagged[5::8] == Event.STAMP).all()
    assert (result.flagged[7::8] == Event.STAMP).all()
    assert not result.flagged[::2].any()


@pytest.mark.parametrize("shape", [(5, 2), (4, 3), (5,)])
def test_shapes_that_do_not_fit(shape):
    with pytest.raises(ValueError, match=r"shape \(N, 3\)"):
        OrientationFilter().update(np.arange(5.0), np.zeros((5, 3)), np.zeros(shape))


# --- gaps ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gap_s", [0.02, 0.05, 0.2, 0.5, 2.0, 10.0])
@pytest.mark.parametrize("make", FILTERS)
def test_gap(worn, angles, make, gap_s):
    there = worn.rows((worn.time_s < 15) | (worn.time_s >= 15 + gap_s - 0.001))
    result = make().update(*there.measured)
    (at,) = np.flatnonzero(there.time_s >= 15)[:1]
    assert result.flagged[at] == Event.GAP | (Event.RESTART if gap_s > 1 else 0)
    assert not np.delete(result.flagged, at).any()
    total, inclination = angles(result.quat, there.quat)
    assert rms(total[at - 100 : at]) < 1.0
    if make is OrientationFilter:
        assert rms(inclination[there.time_s > 15 + gap_s + 5]) < 1.0
        assert rms(total[there.time_s > 15 + gap_s + 10]) < 6.0
        assert np.abs(np.rad2deg(result.bias[-1] - there.bias)).max() < 0.2


def test_a_clock_that_begins_anew(worn, angles):
    half = len(worn.time_s) // 2
    times = worn.time_s - np.where(np.arange(len(worn.time_s)) < half, 0.0, 18.0)
    result = OrientationFilter().update(times, *worn.measured[1:])
    assert result.flagged[half] == Event.STAMP | Event.RESTART
    assert not np.delete(result.flagged, half).any()
    assert rms(angles(result.quat, worn.quat)[1][half + 500 :]) < 1.0


def test_a_slower_rate_is_no_gap_for_ever(simulate):
    data = simulate(np.concatenate([np.arange(0, 5, 0.005), np.arange(5, 30, 0.02)]), seed=1)
    flagged = OrientationFilter().update(*data.measured).flagged
    assert flagged[data.time_s > 5][0] == Event.GAP
    assert not flagged[data.time_s > 7].any()


# --- rest, shocks, ends of ranges ---------------------------------------------------------------------------


def test_rest_is_seen_and_left(simulate):
    data = simulate(np.arange(0, 30, 0.01), seed=3, still=[(0, 6), (15, 22)])
    rest = OrientationFilter().update(*data.measured).rest
    for start, end, expected in ((2, 5, True), (7, 14, False), (19, 21.5, True), (23, 30, False)):
        part = rest[(data.time_s > start) & (data.time_s < end)]
        assert part.all() if expected else not part.any()


def test_steady_turning_is_no_rest_once_the_bias_is_known():
    count = 2000
    gyr = np.zeros((count, 3))
    gyr[800:, 2] = np.deg2rad(6.0)
    result = OrientationFilter().update(np.arange(count) / 100, gyr, np.tile([0, 0, 9.81], (count, 1)))
    assert result.rest[700]
    assert not result.rest[850:].any()
    assert np.rad2deg(rot.yaw_of_quat(result.quat[-1])) == pytest.approx(72.0, abs=3.0)


@pytest.mark.parametrize(("acceleration", "seconds"), [(3.0, 3.0), (10.0, 1.0)])
def test_recovery_from_sustained_acceleration(simulate, angles, acceleration, seconds):
    data = simulate(np.arange(0, 40, 0.01), seed=1, still=[(0, 5)], push=(10.0, 10.0 + seconds, acceleration))
    _, inclination = angles(OrientationFilter().update(*data.measured).quat, data.quat)
    after = data.time_s - 10.0 - seconds
    assert rms(inclination[(after > 5) & (after < 10)]) < 5.0
    assert rms(inclination[after > 15]) < 0.5


def test_gyroscope_at_the_end_of_its_range(simulate, angles):
    data = simulate(np.arange(0, 40, 0.01), seed=3, turn=6.0, still=[(0, 5), (15, 40)])
    clipped = data._replace(gyr=np.clip(data.gyr, -8.7, 8.7))
    result = OrientationFilter().update(*clipped.measured)
    flagged = (result.flagged & Event.SATURATED) > 0
    ends = (np.abs(clipped.gyr) == 8.7).any(axis=1)
    assert ends.sum() > 50
    assert not (flagged & ~ends).any()
    assert (flagged & ends).sum() > 0.8 * ends.sum()
    total, inclination = angles(result.quat, data.quat)
    assert rms(inclination[(data.time_s > 20) & (data.time_s < 25)]) < 2.0
    assert rms(total[data.time_s > 35]) < 10.0


def test_a_shock_is_flagged_and_forgotten(worn, angles):
    acc = worn.acc.copy()
    acc[1500:1503] += [150.0, -80.0, 60.0]
    result = OrientationFilter().update(worn.time_s, worn.gyr, acc, worn.mag)
    assert (result.flagged[1500:1503] & Event.SATURATED).all()
    assert not result.flagged[1510:].any()
    assert rms(angles(result.quat, worn.quat)[1][2000:]) < 1.0


# --- magnetometer -------------------------------------------------------------------------------------------


def test_a_passing_magnet_is_seen_and_not_believed(simulate, angles):
    data = simulate(np.arange(0, 40, 0.01), seed=5, still=[(0, 4)])
    near = (data.time_s > 15) & (data.time_s < 25)
    magnet = rot.quat_rotate(rot.quat_conjugate(data.quat), np.array([25.0, -5.0, 10.0]))
    mag = data.mag + near[:, None] * magnet
    result = OrientationFilter().update(*data.measured[:3], mag)
    assert result.disturbed[near].mean() > 0.95
    assert result.disturbed[data.time_s > 26].mean() < 0.05
    assert rms(angles(result.quat, data.quat)[0][data.time_s > 15]) < 2.0


def test_a_new_field_is_accepted_in_the_end(simulate):
    data = simulate(np.arange(0, 80, 0.02), seed=5, still=[(0, 4)])
    later = data.time_s > 20
    field = rot.quat_rotate(rot.quat_conjugate(data.quat), np.array([12.0, 16.0, -60.0]))
    result = OrientationFilter().update(*data.measured[:3], np.where(later[:, None], field, data.mag))
    assert result.disturbed[(data.time_s > 21) & (data.time_s < 35)].all()
    assert not result.disturbed[data.time_s > 70].any()
    error = rot.yaw_of_quat(rot.quat_multiply(result.quat[-500:], rot.quat_conjugate(data.quat[-500:])))
    # North is where the new field points: 36.9 degrees east of the old one.
    assert np.rad2deg(error).mean() == pytest.approx(36.9, abs=10.0)


def test_magnetometer_lost_and_back(simulate, angles):
    data = simulate(np.arange(0, 60, 0.01), seed=6, still=[(0, 4)])
    gone = (data.time_s > 15) & (data.time_s < 30)
    mag = np.where(gone[:, None], np.nan, data.mag)
    result = OrientationFilter().update(*data.measured[:3], mag)
    lost = (result.flagged & Event.MAG_LOST) > 0
    assert lost[gone & (data.time_s > 16.02)].all()
    assert not lost[~gone | (data.time_s < 15.99)].any()
    assert not result.disturbed[lost].any()
    total, inclination = angles(result.quat, data.quat)
    assert rms(inclination[lost]) < 0.6
    assert rms(total[lost]) < 3.0
    assert rms(total[data.time_s > 40]) < 1.0


def test_magnetometer_that_comes_later(simulate, angles):
    data = simulate(np.arange(0, 30, 0.01), seed=6, still=[(0, 4)])
    mag = np.where(data.time_s[:, None] < 10, np.nan, data.mag)
    result = OrientationFilter().update(*data.measured[:3], mag)
    assert rot.yaw_of_quat(result.quat[0]) == pytest.approx(0.0, abs=1e-9)
    assert rms(angles(result.quat, data.quat)[0][data.time_s > 15]) < 2.0
    assert not result.flagged.any()


@pytest.mark.parametrize("every", [4, 50])
def test_slow_magnetometer(simulate, angles, every):
    data = simulate(np.arange(0, 30, 0.01), seed=6, still=[(0, 4)])
    mag = np.full_like(data.mag, np.nan)
    mag[::every] = data.mag[::every]
    result = OrientationFilter().update(*data.measured[:3], mag)
    assert rms(angles(result.quat, data.quat)[0][data.time_s > 6]) < 1.0
    assert not result.flagged.any()


def test_unit_of_the_field_does_not_matter(worn):
    a = OrientationFilter().update(*worn.measured)
    b = OrientationFilter().update(*worn.measured[:3], worn.mag / 48.0)
    np.testing.assert_allclose(a.quat, b.quat, atol=1e-9)


def test_settings_are_used(worn):
    calm = OrientationFilter(FilterSettings(rest_gyr=0.0)).update(*worn.measured)
    assert not calm.rest.any()


def test_a_long_loss_says_nothing_of_the_field():
    """Minutes without a reading, then a field that is a little stronger: it is used, not rejected."""
    time_s = np.arange(0, 180, 0.02)
    gyr, acc = np.zeros((len(time_s), 3)), np.tile([0.0, 0.0, 9.81], (len(time_s), 1))
    mag = np.tile([0.0, 20.0, -40.0], (len(time_s), 1))
    mag[(time_s > 30) & (time_s < 150)] = np.nan
    mag[time_s >= 150] *= 1.03
    result = OrientationFilter().update(time_s, gyr, acc, mag)
    assert not result.disturbed[time_s > 152].any()


@pytest.mark.parametrize("gap_at", [15, 40])
def test_vqf_keeps_its_heading_over_a_gap_while_it_learns_the_rate(gap_at):
    turning = np.deg2rad(100.0)
    time_s = np.arange(200) * 0.01
    time_s[gap_at:] += 2.0
    gyr, acc = np.tile([0.0, 0.0, turning], (200, 1)), np.tile([0.0, 0.0, 9.81], (200, 1))
    headings = np.unwrap(rot.yaw_of_quat(VqfFilter().update(time_s, gyr, acc).quat))
    # Nobody knows how far it turned in the gap; after it, each sample turns by a degree.
    assert np.abs(np.diff(headings[gap_at:]) - 0.01 * turning).max() < np.deg2rad(1.5)
