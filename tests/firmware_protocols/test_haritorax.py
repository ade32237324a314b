"""HaritoraX: captured lines, and what a decoder makes of a bad line."""

import math
import random
from base64 import b64decode, b64encode

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocols.haritorax import MAX_LINE, SLOTS, HaritoraxDecoder, encode, encode_wired
from firmware_protocols.rotation import rotate
from firmware_protocols.sample import STANDARD_G, Sample

# JovannMC/haritorax-interpreter (MIT): README and data.txt; the leg line came without its label.
TRACKER = b"X0:0Ayb3u7+DzWeBxoDVQMAAA==\n"
LEG = b"X1:WSgd7VcpEhQACBUAUwADA93trNpTJHggKQJp+FAB\n"
WIRED = (
    b"P:a/Gu47EuBh7NAKb38QQ8A0kBDhpaOgkACAFtCZf+3fxY/uI/6wCd/zoJ6/9kA587Axed//UAbQki1z8xAwDFANj/2P/a9fv5S8BN/+oA"
    b"TgAxAPX1\n"
)


def stream(n, seed=1, slots=6):
    rng = random.Random(seed)
    samples = []
    for i in range(n):
        q = [rng.gauss(0, 1) for _ in range(4)]
        q = tuple(x / math.hypot(*q) for x in q)
        samples.append(Sample(i % slots, None, q, tuple(rng.uniform(-100, 100) for _ in range(3))))
    return samples


def close(a, b):
    dot = sum(x * y for x, y in zip(a.quat, b.quat, strict=True))
    return (
        a.sensor == b.sensor
        and abs(abs(dot) - 1) < 1e-7
        and all(abs(x - y) < 0.003 for x, y in zip(a.acc, b.acc, strict=True))
    )


def test_tracker():
    (sample,) = HaritoraxDecoder().feed(TRACKER)
    w, x, y, z = (value * 16383.4 for value in sample.quat)
    assert (x, y, z, w) == pytest.approx((3280, -8549, -274, 13583), abs=0.1)
    assert sample.acc == pytest.approx([v * STANDARD_G / 2048 for v in (1950, 794, 853)])
    assert sample.sensor == 0
    assert sample.time_us is sample.gyr is None


def test_leg_tracker_has_two_sensors():
    samples = HaritoraxDecoder().feed(LEG)
    assert [sample.sensor for sample in samples] == [1, 1 + SLOTS]
    for sample in samples:
        assert rotate(sample.quat, sample.acc) == pytest.approx((0, 0, STANDARD_G), abs=0.1)


def test_wired_sensors_stand_upright():
    samples = HaritoraxDecoder().feed(WIRED)
    assert [sample.sensor for sample in samples] == list(range(6))
    up = [rotate(sample.quat, sample.acc) for sample in samples]
    for x, y, z in up:
        assert math.hypot(x, y) < 0.005 * z
    assert sum(z for _, _, z in up) / 6 == pytest.approx(9.81, abs=0.2)


@given(st.integers(0, 2**32))
@settings(max_examples=100, deadline=None)
def test_round_trip(seed):
    samples = stream(6, seed)
    one, wired = HaritoraxDecoder(), HaritoraxDecoder()
    assert all(map(close, one.feed(b"".join(map(encode, samples))), samples))
    assert all(map(close, wired.feed(encode_wired(samples)), samples))
    assert one.counters.packets == wired.counters.packets == 6


def test_captured_line_is_encoded_back():
    assert encode(*HaritoraxDecoder().feed(TRACKER)) == TRACKER


@given(st.lists(st.integers(1, 60), max_size=40))
@settings(max_examples=50, deadline=None)
def test_any_chunking_gives_the_same(sizes):
    data = b"\xffAA==\r\n" + TRACKER + b"a0:7F\n\n" + LEG.replace(b"\n", b"\r\n") + WIRED + TRACKER[:9]
    whole, pieces = HaritoraxDecoder(), HaritoraxDecoder()
    expected = whole.feed(data)
    got, at = [], 0
    for size in [*sizes, len(data)]:
        got += pieces.feed(data[at : at + size])
        at += size
    assert got == expected
    assert len(got) == 1 + 2 + 6
    assert pieces.counters == whole.counters
    assert (whole.counters.skipped, whole.counters.bad, whole.counters.resyncs) == (1, 1, 1)


def test_a_broken_line_without_its_end_costs_only_itself():
    decoder = HaritoraxDecoder()
    assert len(decoder.feed(TRACKER[:-5] + TRACKER + b"X\0\n" + TRACKER)) == 2
    assert (decoder.counters.bad, decoder.counters.resyncs) == (2, 2)


def with_bytes(change):
    data = bytearray(b64decode(TRACKER[3:]))
    change(data)
    return b"X0:" + b64encode(data) + b"\n"


@pytest.mark.parametrize(
    "line",
    [
        with_bytes(lambda d: d.__setitem__(slice(0, 8), bytes(8))),  # a tracker that is starting
        with_bytes(lambda d: d.__setitem__(7, d[7] ^ 0x10)),
        with_bytes(lambda d: d.append(0)),
        with_bytes(lambda d: d.__delitem__(0)),
        b"X0:\n",
        b"X8:" + TRACKER[3:],
        b"P:" + TRACKER[3:],
        b"X0:" + WIRED[2:],
        TRACKER.replace(b"=", b""),
        TRACKER.replace(b"A", b"\x80", 1),
        b"P:" + b64encode(b64decode(WIRED[2:]) * 2) + b"\n",
        b"X0:" + b"A" * MAX_LINE + b"\n",
    ],
)
def test_lines_that_cannot_be_true(line):
    decoder = HaritoraxDecoder()
    assert decoder.feed(line) == []
    assert decoder.counters.bad == 1
    assert len(decoder.feed(TRACKER)) == 1
    assert decoder.counters.resyncs == 1


@given(st.lists(st.binary(max_size=80) | st.sampled_from([b"X", b":", b"\n", b"P:", TRACKER, WIRED[:99]])))
@settings(max_examples=200, deadline=None)
def test_random_bytes_never_raise(chunks):
    decoder = HaritoraxDecoder()
    for chunk in chunks:
        for sample in decoder.feed(chunk):
            assert math.hypot(*sample.quat) == pytest.approx(1)
        assert len(decoder._rest) <= MAX_LINE + 1
    assert decoder.counters.bytes == sum(map(len, chunks))


def test_what_cannot_be_sent():
    with pytest.raises(ValueError, match="slots"):
        encode(stream(1)[0]._replace(sensor=8))
    with pytest.raises(ValueError, match="needs both"):
        encode(Sample(0, None, (1.0, 0.0, 0.0, 0.0)))
