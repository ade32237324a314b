"""LPBUS: the frame, what a measurement holds, and what a decoder makes of a bad line."""

import math
import random
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocols.lpms import FIELDS, MAX_DATA, SENSOR_DATA, USUAL_FIELDS, LpmsDecoder, encode
from firmware_protocols.rotation import rotate
from firmware_protocols.sample import STANDARD_G, Sample

# witted-research/openzen (MIT), src/test/ModbusTest.cpp
UNIT_TEST = bytes.fromhex("3a0a000b0004000102030423000d0a")


def frame(data, sensor=1, command=SENSOR_DATA):
    body = struct.pack("<3H", sensor, command, len(data)) + data
    return b":" + body + struct.pack("<H", sum(body) & 0xFFFF) + b"\r\n"


def stream(n, seed=1):
    rng = random.Random(seed)
    samples = []
    for i in range(n):
        q = [rng.gauss(0, 1) for _ in range(4)]
        q = tuple(x / math.hypot(*q) for x in q)
        acc, gyr, mag = (tuple(rng.uniform(-30, 30) for _ in range(3)) for _ in range(3))
        samples.append(Sample(1 + i % 6, 2500 * i, q, acc, gyr, mag, rng.uniform(0, 50)))
    return samples


def test_frame_of_the_unit_test():
    assert frame(b"\1\2\3\4", 10, 11) == UNIT_TEST
    decoder = LpmsDecoder()
    assert decoder.feed(UNIT_TEST) == []
    assert (decoder.counters.skipped, decoder.counters.bad) == (1, 0)


def test_a_measurement_byte_for_byte():
    # 90 degrees about X from sensor to inertial: the sensor's Y points up. On the wire it is inertial to
    # sensor, and the force points down.
    h = 0.5**0.5
    data = struct.pack("<I13f", 400, 0.1, 0.2, 0.3, 0, -1, 0, 20, -30, 40, h, -h, 0, 0)
    (sample,) = LpmsDecoder(["quat", "mag", "acc", "gyr"]).feed(frame(data, 7))
    assert sample.sensor == 7
    assert sample.time_us == 1_000_000
    assert sample.quat == pytest.approx((h, h, 0, 0))
    assert sample.acc == pytest.approx((0, STANDARD_G, 0))
    assert rotate(sample.quat, sample.acc) == pytest.approx((0, 0, STANDARD_G), abs=1e-6)
    assert sample.gyr == pytest.approx((0.1, 0.2, 0.3))
    assert sample.mag == pytest.approx((20, -30, 40))
    assert sample.temperature is None


def test_a_measurement_in_whole_numbers():
    fields = ["rate", "gyr", "temperature", "acc"]
    data = struct.pack("<I10h", 1, 9, 9, 9, 250, 0, -1000, 100, -200, 300, 2150)
    (sample,) = LpmsDecoder(fields).feed(frame(data))
    assert sample == Sample(1, 2500, None, *sample[3:5], None, 21.5)
    assert sample.acc == pytest.approx((-0.25 * STANDARD_G, 0, STANDARD_G))
    assert sample.gyr == pytest.approx((0.1, -0.2, 0.3))


@given(st.integers(0, 2**32), st.booleans(), st.sets(st.sampled_from(FIELDS)))
@settings(max_examples=100, deadline=None)
def test_round_trip(seed, floats, extra):
    fields = extra | {"quat", "acc", "mag", "rate", "temperature"}
    (sample,) = stream(1, seed)
    (got,) = LpmsDecoder(fields).feed(encode(sample, fields, floats))
    assert abs(sum(a * b for a, b in zip(got.quat, sample.quat, strict=True))) == pytest.approx(1, abs=1e-7)
    for a, b in zip(got[3:6], sample[3:6], strict=True):
        assert a == pytest.approx(b, abs=0.006)
    assert got.temperature == pytest.approx(sample.temperature, abs=0.006)
    assert got[:2] == sample[:2]


@given(st.lists(st.integers(1, 90), max_size=40))
@settings(max_examples=50, deadline=None)
def test_any_chunking_gives_the_same(sizes):
    data = b"::" + b"".join(map(encode, stream(12))) + b":\0\0" + UNIT_TEST + encode(stream(1)[0])[:30]
    whole, pieces = LpmsDecoder(), LpmsDecoder()
    expected = whole.feed(data)
    got, at = [], 0
    for size in [*sizes, len(data)]:
        got += pieces.feed(data[at : at + size])
        at += size
    assert got == expected
    assert len(got) == 12
    assert pieces.counters == whole.counters


def test_flipped_bits_and_cuts_cost_only_what_they_touch():
    rng = random.Random(2)
    expected = stream(600)
    pieces = list(map(encode, expected))
    touched = set(rng.sample(range(590), 90))
    for i in touched:
        piece = bytearray(pieces[i])
        if rng.random() < 0.5:
            piece[rng.randrange(len(piece))] ^= 1 << rng.randrange(8)
        else:
            del piece[rng.randrange(len(piece)) :]
        pieces[i] = bytes(piece)
    decoder = LpmsDecoder()
    got = decoder.feed(b"".join(pieces))
    assert [s.time_us for s in got] == [s.time_us for i, s in enumerate(expected) if i not in touched]
    assert 0 < decoder.counters.resyncs <= decoder.counters.bad <= len(touched)


def test_numbers_that_cannot_be_true_are_left_out():
    values = [math.nan] * 3 + [1, math.inf, 0] + [20, 30, 40] + [0, 0, 0, 0]
    (sample,) = LpmsDecoder().feed(frame(struct.pack("<I13f", 1, *values)))
    assert sample == Sample(1, 2500, mag=(20, 30, 40))


def test_other_settings_of_the_sensor_are_bad():
    decoder = LpmsDecoder()
    assert decoder.feed(encode(stream(1)[0], ["quat", "acc"])) == []
    assert decoder.feed(frame(b"")) == []
    assert decoder.counters.bad == 2
    assert LpmsDecoder().refused is None


def test_other_settings_are_named():
    """As LpmsControl sets them: everything, or 16 bit numbers."""
    (sample,) = stream(1)
    decoder = LpmsDecoder()
    more = encode(sample, [*USUAL_FIELDS, "euler", "linear"])
    assert decoder.feed(5 * more + encode(sample, FIELDS, floats=False)) == []
    assert decoder.refused == (
        "6 measurements came whole, but with 80 bytes instead of 56 (floats) or 30 (16 bit): set the sensor "
        "to send angular rate, acceleration, field and quaternion, and nothing else"
    )
    (got,) = decoder.feed(encode(sample, floats=False))
    assert got.acc == pytest.approx(sample.acc, abs=0.006)


def test_a_false_length_holds_up_little():
    decoder = LpmsDecoder()
    decoder.feed(b":\1\0\x09\0\xff\xff")
    assert decoder._rest == b""
    decoder.feed(b":\1\0\x09\0" + MAX_DATA.to_bytes(2, "little"))
    samples = stream(12)
    assert len(decoder.feed(b"".join(map(encode, samples)))) == 12


@given(st.lists(st.binary(max_size=80) | st.sampled_from([b":", UNIT_TEST, encode(stream(1)[0])])))
@settings(max_examples=200, deadline=None)
def test_random_bytes_never_raise(chunks):
    decoder = LpmsDecoder()
    for chunk in chunks:
        decoder.feed(chunk)
        assert len(decoder._rest) < MAX_DATA + 11
    assert decoder.counters.bytes == sum(map(len, chunks))


def test_settings_are_checked():
    with pytest.raises(ValueError, match="not none"):
        LpmsDecoder([])
    with pytest.raises(ValueError, match="not speed"):
        encode(stream(1)[0], ["quat", "speed"])
    with pytest.raises(ValueError, match="cannot send"):
        encode(stream(1)[0]._replace(sensor=1 << 16))
    assert set(USUAL_FIELDS) < set(FIELDS)
