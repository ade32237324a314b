import math
import random
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edgepose.sources.clock_sync import ArrivalClock, CaptureClock, DeviceClock

WRAP = 1 << 32


def times(device_us, delays, clock=None, start=1_700_000_000.0, rate=1.0):
    """Results of a clock for device times and delays; rate is host seconds a device second."""
    clock = clock or DeviceClock()
    first = device_us[0]
    arrivals = [start + (t - first) * 1e-6 * rate + d for t, d in zip(device_us, delays, strict=True)]
    return [clock.host_time(t % WRAP, a) for t, a in zip(device_us, arrivals, strict=True)]


@given(st.integers(0, WRAP - 1), st.integers(0, 999))
@settings(max_examples=30, deadline=None)
def test_jitter_is_taken_out(start_us, seed):
    rng = random.Random(seed)
    device = [start_us + 10_000 * i for i in range(600)]
    delays = [0.001 + min(rng.expovariate(200), 0.04) for _ in device]
    result = times(device, delays)
    assert all(b > a for a, b in pairwise(result))
    steps = [b - a for a, b in pairwise(result[200:])]
    assert max(abs(s - 0.01) for s in steps) < 0.0015
    assert abs(result[-1] - (1_700_000_000.0 + 5.99)) < 0.005


def test_wrap_at_71_minutes():
    device = [WRAP - 1_000_000 + 10_000 * i for i in range(300)]
    result = times(device, [0.0] * 300)
    assert result == pytest.approx([1_700_000_000.0 + 0.01 * i for i in range(300)], abs=1e-5)


def test_wrap_during_a_long_silence():
    clock = DeviceClock()
    a = clock.host_time(0, 100.0)
    b = clock.host_time(round(5000e6) % WRAP, 5100.0)
    assert b - a == pytest.approx(5000.0, abs=1e-3)
    assert clock.resets == 0


@pytest.mark.parametrize("ppm", [-150, 0, 150])
def test_drift_is_followed(ppm):
    rng = random.Random(1)
    device = [10_000 * i for i in range(60_000)]  # ten minutes
    clock = DeviceClock()
    result = times(device, [rng.expovariate(500) for _ in device], clock, rate=1 + ppm * 1e-6)
    true = 1_700_000_000.0 + device[-1] * 1e-6 * (1 + ppm * 1e-6)
    assert abs(result[-1] - true) < 0.002
    assert clock.resets == 0


def test_bad_oscillator_is_followed_in_steps():
    device = [10_000 * i for i in range(30_000)]
    result = times(device, [0.0] * len(device), rate=1.01)
    errors = [r - 1_700_000_000.0 - t * 1.01e-6 for r, t in zip(result, device, strict=True)]
    assert max(map(abs, errors)) < 0.08


@pytest.mark.parametrize("reboot_us", [0, 20_000_000, 3_000_000_000])
def test_reboot(reboot_us):
    clock = DeviceClock()
    times([15_000_000 + 10_000 * i for i in range(100)], [0.0] * 100, clock, start=1000.0)
    result = times([reboot_us + 10_000 * i for i in range(300)], [0.0] * 300, clock, start=1060.0)
    assert clock.resets == 1
    assert result[-1] == pytest.approx(1062.99, abs=1e-3)


def test_a_stalled_host_does_not_shift_the_clock():
    clock = DeviceClock()
    device = [10_000 * i for i in range(1000)]
    # Packets of 2 s come at once at t = 5 s.
    delays = [max(0.0, 5.0 - t * 1e-6) if 3.0 < t * 1e-6 < 5.0 else 0.001 for t in device]
    result = times(device, delays, clock, start=0.0)
    assert clock.resets == 0
    assert result == pytest.approx([t * 1e-6 for t in device], abs=0.003)


def test_doubled_and_swapped_packets_stay_in_order():
    result = times([0, 10_000, 10_000, 30_000, 20_000, 40_000], [0.0] * 6)
    assert all(b > a for a, b in pairwise(result))
    assert result[-1] - result[0] == pytest.approx(0.04, abs=1e-4)


def test_capture_keeps_device_time_over_a_wrap():
    clock = CaptureClock()
    result = [clock.time(s, (WRAP - 500_000 + 10_000 * i) % WRAP) for i in range(100) for s in range(2)]
    assert result[-1] - result[0] == pytest.approx(0.99, abs=1e-5)
    assert result[::2] == pytest.approx(result[1::2], abs=1e-5)


def test_capture_brings_clocks_of_different_boards_together():
    clock = CaptureClock()
    boards = [[clock.time(s, s * 1_000_000_000 + 10_000 * i) for s in range(3)] for i in range(10)]
    for instant in boards:
        assert max(instant) - min(instant) < 1e-4


@pytest.mark.parametrize("reboot_us", [0, 3_900_000_000])
def test_capture_goes_on_after_a_reboot(reboot_us):
    clock = CaptureClock()
    before = clock.time(0, 3_000_000_000)
    after = [clock.time(0, reboot_us + 10_000 * i) for i in range(10)]
    assert 0 < after[0] - before < 0.01
    assert after[-1] - after[0] == pytest.approx(0.09, abs=1e-5)


def test_arrivals_after_a_backlog():
    """33 samples that have waited come at once; the rate that they seem to have must not last."""
    rng = random.Random(3)
    clock = ArrivalClock()
    backlog = [clock.host_time(5.0 + 1e-5 * i) for i in range(33)]
    assert backlog == sorted(set(backlog))
    late = []
    for i in range(1000):
        measured_s = 5.01 + 0.01 * i
        late.append(clock.host_time(measured_s + rng.uniform(0.0, 0.0005)) - measured_s)
    # Before, they were up to 19 ms early for 10 s.
    assert max(map(abs, late[170:])) < 0.001


def test_arrivals_with_a_gap_keep_their_rate():
    """20 samples are lost at once, less than a pause."""
    clock = ArrivalClock()
    late = [clock.host_time(5.0 + 0.01 * i) - 5.0 - 0.01 * i for i in range(600) if not 280 <= i < 300]
    assert max(map(abs, late)) < 1e-6


def test_arrivals_in_pairs_and_with_losses():
    """A converter delivers every 20 ms; later every tenth sample is lost."""
    rng = random.Random(4)
    clock = ArrivalClock()
    late = []
    for i in range(2000):
        measured_s = 5.0 + 0.01 * i
        if i < 1000 or rng.random() < 0.9:
            late.append(clock.host_time(math.ceil(measured_s * 50.0 - 1e-6) / 50.0) - measured_s)
    # Half of them come at once and half 10 ms later.
    assert min(late[100:900]) > -0.001
    assert max(late[100:900]) < 0.006
    assert max(map(abs, late[900:])) < 0.035
