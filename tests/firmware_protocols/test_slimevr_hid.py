"""SlimeVR's receiver: reports by hand, after the layout in SlimeVR-Server."""

import math
import struct

import pytest

from firmware_protocols.sample import STANDARD_G
from firmware_protocols.slimevr_hid import SlimevrHidDecoder

Q15 = 32768


def full(tracker: int, xyzw: tuple[float, ...], shorts: tuple[int, ...] = (0, 0, 0), kind: int = 1) -> bytes:
    return struct.pack("<2B7h", kind, tracker, *(min(32767, round(q * Q15)) for q in xyzw), *shorts)


def reduced(tracker: int, vector: tuple[float, float, float], kind: int = 2) -> bytes:
    """As the firmware quantises: a vector in half turns, each component from -1 to 1."""
    x, y, z = (round((v + 1) / 2 * n) for v, n in zip(vector, (1024, 2048, 2048), strict=True))
    head = struct.pack("<5B", kind, tracker, 90, 100, 80)
    return head + struct.pack("<I3hB", x | y << 10 | z << 21, 128, -64, 0, 40)


def test_full_reports_of_two_trackers_in_one_transfer():
    half = math.sqrt(0.5)
    decoder = SlimevrHidDecoder()
    data = full(3, (0, 0, 0, 1), (128, -256, 64)) + full(4, (0, half, 0, half))  # X of the second points down
    first, second = decoder.feed(data)
    assert (first.sensor, second.sensor) == (3, 4)
    assert first.quat == pytest.approx((1.0, 0.0, 0.0, 0.0), abs=1e-4)
    assert first.acc == pytest.approx((1.0, -2.0, 0.5 + STANDARD_G), abs=1e-3)
    assert second.acc == pytest.approx((-STANDARD_G, 0.0, 0.0), abs=2e-3)
    assert first.time_us is None
    assert decoder.counters.packets == 2


@pytest.mark.parametrize("kind", [2, 7])
@pytest.mark.parametrize("vector", [(0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.1, -0.3, 0.6), (0.0, 0.99, 0.0)])
def test_reduced_reports(kind, vector):
    (sample,) = SlimevrHidDecoder().feed(reduced(1, vector, kind))
    length = math.hypot(*vector)
    angle = math.pi * length
    wanted = (math.cos(angle / 2), *(math.sin(angle / 2) * v / (length or 1.0) for v in vector))
    assert (
        math.degrees(
            2 * math.acos(min(1.0, abs(sum(a * b for a, b in zip(wanted, sample.quat, strict=True)))))
        )
        < 0.4
    )
    assert math.dist(sample.acc, (0, 0, 0)) > 8.0


def test_magnetic_field():
    """It replaces an acceleration, without which a run would end; the last one is repeated."""
    decoder = SlimevrHidDecoder()
    with_field = full(0, (0, 0, 0, 1), (512, 0, -1024), kind=4)
    assert decoder.feed(with_field) == []
    assert (decoder.counters.skipped, decoder.counters.bad) == (1, 0)
    _, _, sample = decoder.feed(full(0, (0, 0, 0, 1), (128, 0, 0)) + full(1, (0, 0, 0, 1)) + with_field)
    assert sample.sensor == 0
    assert sample.mag == pytest.approx((50.0, 0.0, -100.0))
    assert sample.acc == pytest.approx((1.0, 0.0, STANDARD_G))


def test_other_reports_are_skipped_and_wrong_ones_counted():
    decoder = SlimevrHidDecoder()
    for kind in (0, 3, 5, 6, 255):
        assert decoder.feed(bytes([kind]) + bytes(15)) == []
    assert decoder.counters.skipped == 5
    for data in (b"", bytes(15), b"\x01" + bytes(15), b"\x09" + bytes(15)):
        assert decoder.feed(data) == []
    assert decoder.counters.bad == 4
