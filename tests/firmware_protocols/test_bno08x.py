"""BNO08x UART-RVC: the frame, the order of its angles, and what a decoder makes of a bad line."""

import json
import math
import random
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocols.bno08x import FRAME_BYTES, ORDERS, Bno08xDecoder, encode
from firmware_protocols.rotation import rotate
from firmware_protocols.sample import STANDARD_G, Sample

DATA = json.loads((Path(__file__).parents[1] / "data/protocols/bno08x.json").read_text(encoding="utf-8"))
WIRE = bytes.fromhex(DATA["vectors"][0]["hex"])


def quaternion(rng):
    q = [rng.gauss(0, 1) for _ in range(4)]
    return tuple(x / math.hypot(*q) for x in q)


def stream(n, seed=1):
    rng = random.Random(seed)
    return [Sample(0, None, quaternion(rng), tuple(rng.gauss(0, 10) for _ in range(3))) for _ in range(n)]


def close(a, b):
    dot = sum(x * y for x, y in zip(a.quat, b.quat, strict=True))
    return abs(abs(dot) - 1) < 1e-7 and all(abs(x - y) < 0.006 for x, y in zip(a.acc, b.acc, strict=True))


def all_close(a, b):
    return len(a) == len(b) and all(map(close, a, b))


def frame(index=0, angles=(0, 0, 0), acc=(0, 0, 1000)):
    body = bytes([index]) + b"".join(v.to_bytes(2, "little", signed=True) for v in (*angles, *acc)) + bytes(3)
    return b"\xaa\xaa" + body + bytes([sum(body) & 0xFF])


def test_vector():
    vector = DATA["vectors"][0]
    assert frame(vector["index"], vector["raw"][:3], vector["raw"][3:]) == WIRE
    (sample,) = Bno08xDecoder().feed(WIRE)
    assert sample.sensor == 0
    assert sample.time_us is sample.gyr is None
    assert sample.acc == pytest.approx([x * STANDARD_G / 1000 for x in vector["raw"][3:]])
    assert encode(sample, vector["index"]) == WIRE


def test_gravity_of_the_vector_points_up_in_the_default_order_best():
    tilt = {}
    for order in ORDERS:
        (sample,) = Bno08xDecoder(order).feed(WIRE)
        x, y, z = rotate(sample.quat, sample.acc)
        tilt[order] = math.degrees(math.atan2(math.hypot(x, y), z))
    assert tilt["zxy"] < 0.06
    assert tilt["zxy"] < tilt["zyx-swapped"] < 0.1
    assert tilt["zyx"] > 30


@pytest.mark.parametrize("clockwise", [True, False])
@pytest.mark.parametrize(
    ("order", "angles", "axis_in", "axis_out"),
    [
        # 90 degrees of one angle at a time, where it takes an axis of the sensor
        ("zxy", (0, 9000, 0), (0, 1, 0), (0, 0, 1)),
        ("zxy", (0, 0, 9000), (0, 0, 1), (1, 0, 0)),
        ("zyx", (0, 9000, 0), (0, 0, 1), (1, 0, 0)),
        ("zyx", (0, 0, 9000), (0, 1, 0), (0, 0, 1)),
        ("zyx-swapped", (0, 9000, 0), (0, 1, 0), (0, 0, 1)),
        ("zyx-swapped", (0, 0, 9000), (0, 0, 1), (1, 0, 0)),
        # two at a time: the order counts
        ("zxy", (0, 9000, 9000), (0, 0, 1), (1, 0, 0)),
        ("zyx-swapped", (0, 9000, 9000), (0, 0, 1), (0, -1, 0)),
    ],
)
def test_orders(order, angles, axis_in, axis_out, clockwise):
    (sample,) = Bno08xDecoder(order, clockwise).feed(frame(0, angles))
    assert rotate(sample.quat, axis_in) == pytest.approx(axis_out, abs=1e-9)


def test_sense_of_the_heading():
    for order in ORDERS:
        (sample,) = Bno08xDecoder(order).feed(frame(0, (9000, 0, 0)))
        assert rotate(sample.quat, (1, 0, 0)) == pytest.approx((0, -1, 0), abs=1e-9)
        (sample,) = Bno08xDecoder(order, clockwise=False).feed(frame(0, (9000, 0, 0)))
        assert rotate(sample.quat, (1, 0, 0)) == pytest.approx((0, 1, 0), abs=1e-9)


@given(st.integers(0, 2**32), st.sampled_from(ORDERS), st.booleans())
@settings(max_examples=150, deadline=None)
def test_round_trip(seed, order, clockwise):
    (sample,) = stream(1, seed)
    got = Bno08xDecoder(order, clockwise).feed(encode(sample, seed, order=order, clockwise=clockwise))
    assert all_close(got, [sample])


def test_still_sensor_reads_gravity_upwards():
    rng = random.Random(8)
    for _ in range(100):
        w, x, y, z = quaternion(rng)
        acc = rotate((w, -x, -y, -z), (0.0, 0.0, STANDARD_G))
        (sample,) = Bno08xDecoder().feed(encode(Sample(0, None, (w, x, y, z), acc), 0))
        assert rotate(sample.quat, sample.acc) == pytest.approx((0, 0, STANDARD_G), abs=0.02)


@given(st.lists(st.integers(1, 40), max_size=40))
@settings(max_examples=50, deadline=None)
def test_any_chunking_gives_the_same(in_pieces, sizes):
    data = b"\xaa\xaa\xaajunk" + b"".join(encode(s, i) for i, s in enumerate(stream(20))) + b"\xaa"
    data += b"%SW\r\n" + WIRE
    got, _ = in_pieces(Bno08xDecoder, data, sizes)
    assert len(got) == 21


@given(st.lists(st.binary(max_size=80) | st.sampled_from([b"\xaa", b"\xaa\xaa", WIRE[:10], WIRE])))
@settings(max_examples=200, deadline=None)
def test_random_bytes_never_raise(chunks):
    decoder = Bno08xDecoder()
    for chunk in chunks:
        for sample in decoder.feed(chunk):
            assert math.hypot(*sample.quat) == pytest.approx(1)
        assert len(decoder._rest) < FRAME_BYTES
    assert decoder.counters.bytes == sum(map(len, chunks))


def test_header_inside_a_frame():
    # AA AA as index, angle and force, and again as the end of one frame and the start of the next
    frames = [frame(0xAA, (-0x5556 % 18000, 170, -17750), (-0x5556, -0x5556, -0x5556)) for _ in range(3)]
    assert all(f.count(b"\xaa\xaa") > 2 for f in frames)
    for start in range(FRAME_BYTES):
        decoder = Bno08xDecoder()
        assert len(decoder.feed(b"".join(frames)[start:])) == 3 - (start > 0)


def test_flipped_bits_and_cuts_cost_only_what_they_touch():
    rng = random.Random(2)
    expected = stream(1000)
    pieces = [encode(s, i) for i, s in enumerate(expected)]
    touched = set(rng.sample(range(1000), 150))
    for i in touched:
        piece = bytearray(pieces[i])
        if rng.random() < 0.5:
            piece[rng.randrange(FRAME_BYTES)] ^= 1 << rng.randrange(8)
        else:
            del piece[rng.randrange(FRAME_BYTES) :]
        pieces[i] = bytes(piece)
    decoder = Bno08xDecoder()
    got = decoder.feed(b"".join(pieces))
    assert all_close(got, [s for i, s in enumerate(expected) if i not in touched])
    # Those behind the last good one cannot be missed.
    assert decoder.counters.lost == len(touched - set(range(999, 1000)))
    assert 0 < decoder.counters.resyncs <= decoder.counters.bad <= len(touched)


def test_index_counts_losses_and_wraps():
    decoder = Bno08xDecoder()
    for index in (250, 251, 255, 0, 1, 4):
        decoder.feed(frame(index))
    assert decoder.counters.lost == 3 + 2
    decoder.feed(frame(4) * 3)  # a device that does not count
    assert decoder.counters.lost == 5
    assert decoder.counters.packets == 9


def test_greeting_is_a_restart():
    decoder = Bno08xDecoder()
    decoder.feed(frame(100) + b"%Hillcrest Labs 10003608\r\n%SW Ver 3.2.13\r\n" + frame(0))
    assert decoder.counters.restarts == 1
    assert decoder.counters.lost == 0


def test_impossible_angles_are_bad():
    decoder = Bno08xDecoder()
    assert decoder.feed(frame(0, (18001, 0, 0)) + frame(0, (0, -18001, 0)) + frame(0, (0, 0, 32767))) == []
    assert decoder.counters.bad


@pytest.mark.parametrize(
    "sample", [Sample(0), Sample(0, None, (1.0, 0.0, 0.0, 0.0)), Sample(0, acc=(0.0, 0.0, 1.0))]
)
def test_what_cannot_be_sent(sample):
    with pytest.raises(ValueError, match="needs both"):
        encode(sample, 0)


def test_settings_are_checked():
    with pytest.raises(ValueError, match="order must be one of"):
        Bno08xDecoder("xyz")
    with pytest.raises(ValueError, match="order must be one of"):
        encode(Sample(0, None, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), 0, order="")
    with pytest.raises(ValueError, match="cannot send"):
        encode(Sample(0, None, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, math.nan)), 0)
