import random
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edgepose import rotations
from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.base import iter_samples
from edgepose.formats.recordings.registry import read_recording
from edgepose.imu import ImuSample
from edgepose.pipeline.frame_synchronizer import STALE_S, FrameSynchronizer
from edgepose.placements import PLACEMENTS, SENSORS

REAL = Path(__file__).parents[2] / "data" / "imu" / "six-sites-3s.npz"
TURN = np.array([0.3, -1.0, 2.0])  # rad/s


def truth(sensor, time_s):
    """Orientation (..., 4) at a time: constant rate, another start for each sensor."""
    return rotations.quat_multiply(
        rotations.rotvec_to_quat(np.full(3, sensor * 0.4)),
        rotations.rotvec_to_quat(TURN * np.asarray(time_s)[..., None]),
    )


def true_force(time_s):
    """Specific force (..., 3) in the inertial frame, the same at all sensors."""
    t = np.asarray(time_s)
    return np.stack([np.sin(7 * t), 3 * t, 9.81 + np.cos(9 * t)], axis=-1)


def made(sensor, times):
    quats = truth(sensor, times)
    accs = rotations.quat_rotate(rotations.quat_conjugate(quats), true_force(times))
    return [
        ImuSample(sensor, t, tuple(q), tuple(a))
        for t, q, a in zip(np.asarray(times).tolist(), quats.tolist(), accs.tolist(), strict=True)
    ]


def rig(rates=(100,) * 6, offsets=(0.0,) * 6, seconds=1.0, drop=lambda sensor, t: False):
    """Samples by sensor."""
    result = []
    for s, (rate, offset) in enumerate(zip(rates, offsets, strict=True)):
        times = offset + np.arange(int(seconds * rate)) / rate
        result.append(made(s, np.array([t for t in times if not drop(s, t)])))
    return result


def play(arrivals, clock, poll_s=0.005):
    """Frames and when each came, of (arrival, sample) pairs; the clock is asked as by a live source."""
    arrivals = sorted(arrivals)
    frames, when = [], []

    def ask(now):
        new = clock.frames(now)
        frames.extend(new)
        when.extend([now] * len(new))

    now = arrivals[0][0]
    for arrival, sample in arrivals:
        while now + poll_s < arrival:
            now += poll_s
            ask(now)
        now = arrival
        clock.push([sample], now)
        ask(now)
    return frames, when


def at_once(streams):
    return [(s.time_s, s) for stream in streams for s in stream]


def check_ticks(frames, rate):
    assert [f.index for f in frames] == list(range(len(frames)))
    t0 = frames[0].time_s
    assert all(f.time_s == t0 + k / rate for k, f in enumerate(frames))


def mean_force(stream, start, end):
    """Mean over time, from start to end, of the true force at the samples with straight lines between."""
    times = np.array([s.time_s for s in stream])
    inside = np.unique(np.concatenate([[start, end], times[(times > start) & (times < end)]]))
    forces = np.stack([np.interp(inside, times, column) for column in true_force(times).T], axis=-1)
    return np.trapezoid(forces, inside, axis=0) / (end - start)


@given(
    st.lists(st.integers(25, 1000), min_size=6, max_size=6),
    st.lists(st.floats(0, 0.5), min_size=6, max_size=6),
    st.sampled_from([30.0, 50.0, 59.94, 60.0, 120.0]),
    st.integers(0, 999),
)
@settings(max_examples=15, deadline=None)
def test_any_rates_and_offsets(rates, offsets, rate, seed):
    rng = random.Random(seed)
    streams = [[x for x in stream if x.time_s < 1.0] for stream in rig(rates, offsets)]
    # Jitter of arrival up to half a period: all sensors are waited for.
    arrivals = [
        (s.time_s + rng.random() * min(0.5 / rates[s.sensor], 0.008), s) for stream in streams for s in stream
    ]
    clock = FrameSynchronizer(rate)
    frames, _ = play(arrivals, clock)
    check_ticks(frames, rate)
    assert frames[0].time_s == max(offsets)
    # At the end some sensors have nothing more to say.
    frames = [f for f in frames if f.time_s <= min(stream[-1].time_s for stream in streams)]
    assert len(frames) > 0.4 * rate
    assert not np.any([f.held for f in frames])
    ticks = np.array([f.time_s for f in frames])
    for s, stream in enumerate(streams):
        orientation = np.array([f.orientation[s] for f in frames])
        assert (
            np.max(rotations.geodesic_angle(*map(rotations.quat_to_matrix, (orientation, truth(s, ticks)))))
            < 1e-7
        )
        for frame in frames:
            mean = mean_force(stream, max(offsets) + (frame.index - 1) / rate, frame.time_s)
            assert np.abs(frame.force[s] - mean).max() < 1e-9


@given(
    st.lists(st.integers(25, 300), min_size=6, max_size=6),
    st.lists(st.tuples(st.integers(0, 5), st.floats(0.1, 2), st.floats(0.01, 1)), max_size=6),
    st.integers(0, 999),
)
@settings(max_examples=25, deadline=None)
def test_drop_outs(rates, gaps, seed):
    """Ticks stay exact, nobody waits for long, and a frame says held where there was nothing."""
    rng = random.Random(seed)
    streams = rig(
        rates, seconds=2.5, drop=lambda s, t: any(g[0] == s and g[1] < t < g[1] + g[2] for g in gaps)
    )
    arrivals = [(s.time_s + rng.random() * 0.005, s) for stream in streams for s in stream]
    frames, when = play(arrivals, FrameSynchronizer())
    check_ticks(frames, 60.0)
    for frame, now in zip(frames, when, strict=True):
        for s, stream in enumerate(streams):
            *_, before_s, newest_s = (
                stream[0].time_s,
                *(x.time_s for x in stream if x.time_s <= frame.time_s),
            )
            age = frame.time_s - newest_s
            if age > max(4 / rates[s], 0.02):
                assert frame.held[s]
            elif age < 1 / rates[s] + 1e-3 and newest_s - before_s < STALE_S:
                # The first one after a long silence was not waited for.
                assert not frame.held[s]
        assert now - frame.time_s < 1.5 * 1.3 / min(rates) + 0.01 + 0.006
    assert frames[-1].time_s > max(s.time_s for stream in streams for s in stream) - 0.1


@given(st.lists(st.integers(25, 300), min_size=6, max_size=6), st.integers(0, 5), st.floats(0.3, 0.7))
@settings(max_examples=15, deadline=None)
def test_frames_do_not_depend_on_how_samples_are_batched(rates, sensor, gap):
    offsets = np.arange(6) * 0.0007  # what comes at one instant would have to be pushed together
    streams = rig(rates, offsets, 2.0, lambda s, t: s == sensor and 0.5 < t < 0.5 + gap)
    live, _ = play(at_once(streams), clock := FrameSynchronizer())
    live += clock.flush()
    whole = FrameSynchronizer()
    whole.push(sorted((s for stream in streams for s in stream), key=lambda s: s.time_s), 2.0)
    for a, b in zip(live, whole.flush(), strict=True):
        assert a[:2] == b[:2]
        np.testing.assert_array_equal(a.orientation, b.orientation)
        np.testing.assert_array_equal(a.force, b.force)
        np.testing.assert_array_equal(a.held, b.held)


def test_latency_is_one_period():
    frames, when = play(at_once(rig(offsets=np.arange(6) * 0.0015)), FrameSynchronizer(), poll_s=0.001)
    assert max(now - f.time_s for f, now in zip(frames, when, strict=True)) <= 0.0101
    assert all(f.ready_s == now for f, now in zip(frames, when, strict=True))


def test_the_time_of_the_next_frame_is_known_before():
    """Of regular sensors, exactly the sample that comes at that time completes it."""
    clock = FrameSynchronizer()
    for arrival_s, sample in sorted(at_once(rig(offsets=np.arange(6) * 0.0015))):
        next_s = clock.next_ready_s()
        clock.push([sample], arrival_s)
        made = bool(clock.frames(arrival_s))
        if arrival_s > 0.1:
            assert made == (arrival_s > next_s - 1e-6)


def test_no_drift_and_no_missing_index_in_ten_minutes():
    clock = FrameSynchronizer(60.0)
    count = 0
    for i in range(25 * 600):
        clock.push(
            [ImuSample(s, 1.7e9 + i / 25, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 9.81)) for s in range(6)], 0.0
        )
        if i % 250 == 249:
            for frame in clock.frames(1.7e9 + i / 25):
                assert frame.index == count
                assert frame.time_s == 1.7e9 + count / 60
                count += 1
    assert count == 60 * 600 - 2
    assert clock.dropped == clock.restarts == 0


@pytest.mark.parametrize("start_s", [0.0, 0.013, 1.7e9 + 0.021])
def test_on_a_grid_ticks_are_those_of_other_clocks(start_s):
    clock = FrameSynchronizer(grid=True)
    for sensor in rig(offsets=(start_s,) * 6, seconds=0.5):
        clock.push(sensor, start_s)
    (first, *_), frames = clock.frames(start_s + 0.2), clock.flush()
    assert 0.0 <= first.time_s - start_s < 1.0 / 60.0
    ticks = np.array([frame.time_s for frame in frames]) * 60.0
    np.testing.assert_allclose(ticks, np.round(ticks), atol=1e-4)
    np.testing.assert_allclose(np.diff(ticks), 1.0, atol=1e-4)


def test_hold_takes_the_last_sample():
    streams = rig()
    clock = FrameSynchronizer(60.0, "hold")
    frames, _ = play(at_once(streams), clock)
    for frame in frames:
        for s in range(6):
            last = max(x for x in streams[s] if x.time_s <= frame.time_s)
            np.testing.assert_array_equal(frame.orientation[s], last.quat)


def test_real_recording():
    clock = FrameSynchronizer()
    frames, _ = play([(s.time_s, s) for s in iter_samples(read_recording(REAL))], clock)
    frames += clock.flush()
    assert len(frames) == 180
    check_ticks(frames, 60.0)
    forces = np.array([f.force for f in frames])
    np.testing.assert_allclose(np.linalg.norm(forces.mean(axis=0), axis=-1), 9.81, atol=0.35)
    assert np.all(forces.mean(axis=0)[:, 2] > 9.6)
    assert not any(f.held.any() for f in frames)


def test_slow_healthy_sensor_is_never_held():
    streams = rig(rates=(25, 100, 100, 100, 100, 100), seconds=4)
    rng = random.Random(3)
    frames, _ = play([(s.time_s + 0.02 * rng.random(), s) for x in streams for s in x], FrameSynchronizer())
    assert not any(f.held.any() for f in frames)


def test_stale_sensor_adds_no_latency_and_comes_back():
    streams = rig(seconds=3, drop=lambda s, t: s == 4 and 1.0 < t < 2.0)
    frames, when = play(at_once(streams), FrameSynchronizer(), poll_s=0.001)
    waits = {f.index: now - f.time_s for f, now in zip(frames, when, strict=True)}
    held = [f.index for f in frames if f.held[4]]
    assert frames[held[0]].time_s == pytest.approx(1.025, abs=0.02)
    assert frames[held[-1]].time_s == pytest.approx(2.0, abs=0.02)
    assert held == list(range(held[0], held[-1] + 1))
    assert max(waits[i] for i in held if frames[i].time_s < 1.45) <= 0.0262
    assert max(waits[i] for i in held if frames[i].time_s > 1.55) <= 0.0102
    last = streams[4][100]
    assert last.time_s == 1.0
    for i in held:
        np.testing.assert_array_equal(frames[i].orientation[4], last.quat)
        assert list(frames[i].held) == [False, False, False, False, True, False]


def test_late_and_doubled_samples_are_dropped():
    clock = FrameSynchronizer()
    streams = rig(seconds=0.5)
    frames, _ = play(at_once(streams), clock)
    clock.push([streams[0][5], streams[1][-1]], 0.5)
    assert clock.dropped == 2
    assert frames[-1].time_s > streams[0][5].time_s


def test_swapped_samples_are_sorted():
    streams = rig(seconds=0.5)
    swapped = [s for stream in streams for s in stream]
    swapped.sort(key=lambda s: round(s.time_s * 100) ^ 1)
    a, b = FrameSynchronizer(), FrameSynchronizer()
    a.push(swapped, 0.5)
    b.push(sorted(swapped, key=lambda s: s.time_s), 0.5)
    for x, y in zip(a.flush(), b.flush(), strict=False):
        if x.time_s == y.time_s:
            np.testing.assert_array_equal(x.orientation, y.orientation)
    assert a.dropped == b.dropped == 0


def test_all_sensors_silent():
    """Frames go on for a minute, all held, and go on counting after it."""
    clock = FrameSynchronizer()
    play(at_once(rig(seconds=1)), clock)
    frames = clock.frames(30.0)
    assert all(f.held.all() for f in frames[5:])
    assert frames[-1].time_s == pytest.approx(30.0, abs=0.02)
    frames += clock.frames(1e6)
    assert frames[-1].time_s == pytest.approx(60.99, abs=0.02)
    clock.push([s._replace(time_s=s.time_s + 1e6) for x in rig(seconds=1) for s in x], 1e6 + 1)
    after = clock.frames(1e6 + 1)
    assert clock.restarts == 1
    assert after[0].time_s == 1e6
    assert after[0].index == frames[-1].index + 1
    assert 55 < len(after) < 62


def test_many_gaps_at_once():
    clock = FrameSynchronizer()
    rows = [
        ImuSample(s, 100.0 * i, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 9.81)) for i in range(3000) for s in range(6)
    ]
    clock.push(rows, 0.0)
    frames = clock.flush()
    assert clock.restarts == 2999
    assert [f.index for f in frames] == list(range(3000))


def test_sensors_that_are_not_needed_do_not_end_a_gap():
    """Of a rig without a head sensor, while chest (added) and head (not calibrated) go on alone."""
    clock = FrameSynchronizer(added=["chest"], without=["head"])
    six = sorted((s for x in rig(seconds=1) for s in x), key=lambda s: s.time_s)
    others = [s._replace(sensor=sensor) for s in six[::6] for sensor in (4, SENSORS.index("chest"))]
    clock.push([s for s in six if s.sensor != 4], 1.0)
    clock.push([s._replace(time_s=s.time_s + 100.0 * k) for k in range(1, 5) for s in others], 500.0)
    clock.push([s._replace(time_s=s.time_s + 900.0) for s in six if s.sensor != 4], 901.0)
    frames = clock.flush()
    assert clock.restarts == 1
    assert 110 < sum(not f.held[:4].any() for f in frames) <= len(frames) < 122


def test_missing_sensors_are_named():
    rows = sorted((s for x in rig(seconds=4) for s in x if s.sensor not in (0, 4)), key=lambda s: s.time_s)
    with pytest.raises(EdgeposeError, match="left_forearm, head in the first 3 s"):
        play([(s.time_s, s) for s in rows], FrameSynchronizer())
    clock = FrameSynchronizer()
    clock.push(rows[:200], 1.0)
    assert clock.frames(1.0) == []
    with pytest.raises(EdgeposeError, match="left_forearm, head"):
        clock.flush()


def test_nothing_gives_nothing():
    clock = FrameSynchronizer()
    assert clock.frames(1.0) == clock.flush() == []


def test_sensor_without_orientation_or_acceleration():
    good = rig()[2][0]
    with pytest.raises(EdgeposeError, match=f"{PLACEMENTS[2]}: .* no orientation; set it to send"):
        FrameSynchronizer().push([good._replace(quat=None)], 0.0)
    with pytest.raises(EdgeposeError, match=f"{PLACEMENTS[2]}: the device sends no acceleration"):
        FrameSynchronizer().push([good._replace(acc=None)], 0.0)
