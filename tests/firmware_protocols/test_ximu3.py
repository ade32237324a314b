"""x-IMU3: messages, pairing of what belongs to one instant, and what a decoder makes of a bad line."""

import json
import math
import random
import struct
import time
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocols import ximu3
from firmware_protocols.rotation import rotate
from firmware_protocols.sample import STANDARD_G, Sample, z_up
from firmware_protocols.ximu3 import Ximu3Decoder, encode, encode_message

DATA = json.loads((Path(__file__).parents[1] / "data/protocols/ximu3.json").read_text(encoding="utf-8"))
STILL = ((0.0, 0.0, STANDARD_G), (0.0, 0.0, 0.0))


def quaternion(rng):
    q = [rng.gauss(0, 1) for _ in range(4)]
    return tuple(x / math.hypot(*q) for x in q)


def stream(n, sensors=(0,), period_us=10_000, seed=1):
    rng = random.Random(seed)
    return [
        Sample(
            sensor,
            5_000_000 + i * period_us + 7 * sensor,
            quaternion(rng),
            tuple(rng.gauss(0, 10) for _ in range(3)),
            tuple(rng.gauss(0, 3) for _ in range(3)),
        )
        for i in range(n)
        for sensor in sensors
    ]


def decode(data, **options):
    decoder = Ximu3Decoder(**options)
    return decoder.feed(data) + decoder.flush()


def close(a, b, tolerance=1e-4):
    """Every quantity alike; quaternions up to sign."""
    for name, p, q in zip(Sample._fields, a, b, strict=True):
        if name == "quat" and p is not None and q is not None:
            if abs(abs(sum(x * y for x, y in zip(p, q, strict=True))) - 1) > tolerance:
                return False
        elif isinstance(p, tuple) and isinstance(q, tuple):
            if any(abs(x - y) > tolerance for x, y in zip(p, q, strict=True)):
                return False
        elif isinstance(p, float) and isinstance(q, float):
            if abs(p - q) > tolerance:
                return False
        elif p != q:
            return False
    return True


def all_close(a, b, tolerance=1e-4):
    return len(a) == len(b) and all(close(x, y, tolerance) for x, y in zip(a, b, strict=True))


# --- what messages say ----------------------------------------------------------------------------


@pytest.mark.parametrize("vector", DATA["vectors"], ids=lambda v: v["id"])
def test_vectors(vector):
    decoder = Ximu3Decoder()
    assert decoder.feed(bytes.fromhex(vector["hex"])) == []
    (sample,) = decoder.flush()
    assert sample.sensor == 0
    assert sample.time_us == vector["time_us"]
    if vector["letter"] == "I":
        assert sample.gyr == tuple(map(math.radians, vector["values"][:3]))
        assert sample.acc == tuple(x * STANDARD_G for x in vector["values"][3:])
        assert sample.quat is None
    else:
        assert sample.quat == tuple(vector["values"])
        assert sample.acc is sample.gyr is None
    assert decoder.counters.packets == 1
    assert decoder.counters.bad == 0


@pytest.mark.parametrize("vector", [v for v in DATA["vectors"] if v["letter"] in "IQ"], ids=lambda v: v["id"])
def test_encoder_gives_the_vectors(vector):
    wire = bytes.fromhex(vector["hex"])
    assert encode_message(vector["letter"], vector["time_us"], vector["values"], ascii=wire[0] < 0x80) == wire


@pytest.mark.parametrize("recorded", DATA["recorded"], ids=lambda r: r["segment"])
def test_gravity_points_up_in_recordings(recorded):
    wire = encode_message("I", recorded["time_us"], recorded["inertial"])
    wire += encode_message("Q", recorded["time_us"], recorded["quaternion"])
    (sample,) = Ximu3Decoder().feed(wire)
    x, y, z = rotate(sample.quat, sample.acc)
    assert math.degrees(math.atan2(math.hypot(x, y), z)) < 1
    assert z == pytest.approx(STANDARD_G, abs=0.05)
    assert math.hypot(*sample.gyr) < 0.01


def test_matrix_and_angles_say_what_the_quaternion_says():
    rng = random.Random(3)
    for _ in range(200):
        q = quaternion(rng)
        columns = [rotate(q, axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]
        m = tuple(columns[j][i] for i in range(3) for j in range(3))
        roll = math.degrees(math.atan2(m[7], m[8]))
        pitch = math.degrees(math.asin(max(-1, min(1, -m[6]))))
        yaw = math.degrees(math.atan2(m[3], m[0]))
        expected = [Sample(0, 1, q)]
        assert all_close(decode(encode_message("R", 1, m)), expected, 1e-5)
        assert all_close(decode(encode_message("A", 1, (roll, pitch, yaw))), expected, 1e-5)


@pytest.mark.parametrize("frame", ximu3.FRAMES)
def test_linear_and_earth_acceleration_with_orientation(frame):
    rng = random.Random(4)
    for _ in range(50):
        q = quaternion(rng)  # to Z up
        wire_q = z_up(q) if frame == "NED" else q
        acc = tuple(rng.gauss(0, 10) for _ in range(3))
        inertial = rotate(q, acc)
        moved = (inertial[0], inertial[1], inertial[2] - STANDARD_G)
        if frame == "NED":
            moved = (moved[1], moved[0], -moved[2])
        w, x, y, z = wire_q
        linear = tuple(v / STANDARD_G for v in rotate((w, -x, -y, -z), moved))
        earth = tuple(v / STANDARD_G for v in moved)
        expected = [Sample(0, 9, q, acc)]
        assert all_close(decode(encode_message("L", 9, (*wire_q, *linear)), frame=frame), expected)
        assert all_close(decode(encode_message("E", 9, (*wire_q, *earth)), frame=frame), expected)


def test_other_messages_are_skipped_and_counted():
    decoder = Ximu3Decoder()
    lines = [
        b"N,1000000,Hello\r\n",
        b"B,1000000,100.0000,4.2000,2.0000\r\n",
        b'{"ping":{"interface":"USB","name":"x","sn":"1"}}\r\n',
        b"\xd7" + struct.pack("<Qff", 1, 100.0, -50.0).replace(b"\n", b"\xdb\xdc") + b"\n",
        encode_message("L", 5, (0.0, 0.0, 0.0)),
    ]
    assert decoder.feed(b"".join(lines)) == []
    assert decoder.counters.skipped == 5
    assert decoder.counters.bad == 0


@pytest.mark.parametrize(
    "line",
    [
        b"Q,1000000,1.0,0.0,0.0\r\n",  # too few
        b"Q,1000000,0,0,0,0\r\n",  # norm 0
        b"Q,1000000,nan,0,0,0\r\n",
        b"Q,-5,1,0,0,0\r\n",
        b"Q,99999999999999999999,1,0,0,0\r\n",
        b"Q,1_0,1,0,0,0\r\n",
        b"I,1,1e30,0,0,0,0,1\r\n",  # out of any range
        b"I,1,0,0,0,0,0,inf\r\n",
        b"R,1,1,0,0,0,1,0,0,0,9\r\n",
        b"A,1,0,500,0\r\n",
        b"Z,1,1\r\n",
        b"hello\r\n",
        b"^\n",
        b"^A\n",
        b"^A^B^CQ,1,1,0,0,0\n",  # deeper than anything sends
        b"\xd1\xdb\xde" + bytes(23) + b"\n",  # no such escape
        b"\xd1" + bytes(7) + b"\xdb\n",
        b"{cut",
    ],
)
def test_what_cannot_be_true_is_bad(line):
    decoder = Ximu3Decoder()
    assert decoder.feed(line + b"\n") + decoder.flush() == []
    assert decoder.counters.bad == 1


# --- pairing --------------------------------------------------------------------------------------


def test_orientation_and_reading_of_one_instant_are_one_sample():
    (expected,) = stream(1)
    inertial = encode(expected._replace(quat=None))
    turn = encode(expected._replace(acc=None, gyr=None))
    for wire in (inertial + turn, turn + inertial):
        assert all_close(Ximu3Decoder().feed(wire), [expected])


def test_a_lost_message_never_mixes_two_instants():
    expected = stream(6)
    wires = [[encode(s._replace(quat=None)), encode(s._replace(acc=None, gyr=None))] for s in expected]
    for lost in range(12):
        pieces = [piece for pair in wires for piece in pair]
        del pieces[lost]
        got = decode(b"".join(pieces))
        alone = expected[lost // 2]
        alone = alone._replace(acc=None, gyr=None) if lost % 2 == 0 else alone._replace(quat=None)
        assert all_close(got, [*expected[: lost // 2], alone, *expected[lost // 2 + 1 :]])


def test_second_form_of_an_orientation_is_skipped():
    q = (0.5, 0.5, 0.5, 0.5)
    inertial = encode_message("I", 10, (0, 0, 0, 0, 0, 1))
    turn = encode_message("Q", 10, q)
    linear = encode_message("L", 10, (*q, 0, 0, 0))
    for parts in ((inertial, turn, linear), (turn, linear, inertial), (linear, turn, inertial)):
        decoder = Ximu3Decoder()
        assert all_close(decoder.feed(b"".join(parts)) + decoder.flush(), [Sample(0, 10, q, *STILL)])
        assert decoder.counters.skipped == 1


def test_slow_readings_go_with_one_sample_if_fresh():
    a, b, c = stream(3)
    wire = encode_message("M", a.time_us - 4000, (0.5, -0.25, 1))
    wire += encode_message("T", a.time_us - 900_000, (31.5,))
    wire += encode(a) + encode(b) + encode_message("M", c.time_us - 100_001, (1, 1, 1)) + encode(c)
    got = decode(wire)
    assert all_close(got, [a._replace(mag=(0.5, -0.25, 1.0), temperature=31.5), b, c])


def test_channels_are_sensors():
    expected = stream(20, sensors=(0, ord("A"), ord("B"), ord("A") << 8 | ord("C")))
    rng = random.Random(5)
    pieces = [encode(s, ascii=rng.random() < 0.5) for s in expected]
    assert all_close(Ximu3Decoder().feed(b"".join(pieces)), expected, 2e-3)
    assert b"^A^CI," in encode(expected[3], ascii=True)


def test_restart_needs_two_messages():
    before, after = stream(5), [s._replace(time_us=s.time_us - 4_900_000) for s in stream(5)]
    before = [s._replace(time_us=s.time_us + 60_000_000) for s in before]
    decoder = Ximu3Decoder()
    got = decoder.feed(b"".join(map(encode, before + after))) + decoder.flush()
    # The first reading of the new clock is given up, its orientation comes out alone.
    assert all_close(got, [*before, after[0]._replace(acc=None, gyr=None), *after[1:]])
    assert decoder.counters.restarts == 1
    assert decoder.counters.bad == 1


def test_a_wrong_time_costs_its_message_only():
    samples = stream(6)
    pieces = [encode(s) for s in samples]
    pieces[2] = encode(samples[2]._replace(time_us=samples[2].time_us | 1 << 50, quat=None)) + encode(
        samples[2]._replace(acc=None, gyr=None)
    )
    got = decode(b"".join(pieces))
    assert all_close(got, [*samples[:2], samples[2]._replace(acc=None, gyr=None), *samples[3:]])


# --- the line -------------------------------------------------------------------------------------

finite = st.floats(-200, 200, width=32)
samples = st.builds(
    Sample,
    st.sampled_from([0, 65, 66, 65 << 8 | 67]),
    st.integers(0, 2**64 - 1),
    st.integers(0, 2**32).map(lambda seed: quaternion(random.Random(seed))),
    st.tuples(finite, finite, finite),
    st.tuples(*[st.floats(-100, 100, width=32)] * 3),
    st.none() | st.tuples(finite, finite, finite),
    st.none() | finite,
)


@given(samples, st.booleans(), st.sampled_from(ximu3.FRAMES))
@settings(max_examples=150, deadline=None)
def test_round_trip(sample, ascii, frame):
    got = Ximu3Decoder(frame).feed(encode(sample, ascii=ascii, frame=frame))
    assert all_close(got, [sample], 2e-3 if ascii else 1e-4)


@given(st.lists(st.integers(1, 60), max_size=40), st.booleans())
@settings(max_examples=50, deadline=None)
def test_any_chunking_gives_the_same(in_pieces, sizes, ascii):
    data = b"\x80noise\n" + b"".join(encode(s, ascii=ascii) for s in stream(8, sensors=(0, 65, 66))) + b"I,1"
    got, _ = in_pieces(Ximu3Decoder, data, sizes)
    assert len(got) == 24


@given(st.lists(st.binary(max_size=300) | st.sampled_from([b"\xd1", b"\xc9", b"^", b"I,", b"\n", b"{"])))
@settings(max_examples=200, deadline=None)
def test_random_bytes_never_raise(chunks):
    decoder = Ximu3Decoder()
    for chunk in chunks:
        for sample in decoder.feed(chunk):
            assert sample.quat is None or math.hypot(*sample.quat) == pytest.approx(1)
    decoder.flush()
    assert decoder.counters.bytes == sum(map(len, chunks))


def test_flipped_bits_and_cuts_cost_only_what_they_touch():
    rng = random.Random(11)
    expected = stream(300, sensors=(65, 66))
    pieces = [encode(s) for s in expected]
    touched = set(rng.sample(range(2, 598), 60))
    for i in touched:
        piece = bytearray(pieces[i])
        kind = rng.randrange(3)
        if kind == 0:
            piece[rng.randrange(len(piece))] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del piece[rng.randrange(len(piece)) :]
        else:
            at = rng.randrange(len(piece))
            piece[at:at] = rng.randbytes(rng.randrange(1, 40))
        pieces[i] = bytes(piece)
    decoder = Ximu3Decoder()
    got = decoder.feed(b"".join(pieces)) + decoder.flush()
    whole = {(s.sensor, s.time_us): s for s in got if s.quat is not None and s.acc is not None}
    for i, sample in enumerate(expected):
        if i not in touched:
            assert close(whole[sample.sensor, sample.time_us], sample)
    assert decoder.counters.bad
    assert decoder.counters.resyncs


def test_lost_line_feed_does_not_cost_the_message_behind():
    expected = stream(4)
    pieces = [encode(s) for s in expected]
    data = pieces[0] + pieces[1][:-1] + pieces[2] + pieces[3]
    got = decode(data)
    assert all_close(got, [expected[0], expected[1]._replace(quat=None), *expected[2:]])


def test_long_line_keeps_memory_small():
    decoder = Ximu3Decoder()
    for _ in range(200):
        decoder.feed(b"x" * 1000)
    assert len(decoder._rest) <= ximu3.MAX_MESSAGE + 1
    (sample,) = stream(1)
    assert all_close(decoder.feed(b"\n" + encode(sample)), [sample])


@pytest.mark.parametrize(
    "sample",
    [
        Sample(0, None, (1.0, 0.0, 0.0, 0.0)),
        Sample(0, 1, None, *STILL[:1]),
        Sample(0, -1, (1.0, 0.0, 0.0, 0.0)),
        Sample(0, 1 << 64, (1.0, 0.0, 0.0, 0.0)),
        Sample(0, 1, (math.nan, 0.0, 0.0, 0.0)),
        Sample(0, 1, (1e39, 0.0, 0.0, 0.0)),
        Sample(10, 1, (1.0, 0.0, 0.0, 0.0)),
        Sample(1 << 16, 1, (1.0, 0.0, 0.0, 0.0)),
    ],
)
def test_what_cannot_be_sent(sample):
    with pytest.raises(ValueError, match=r"cannot|channel|time|both"):
        encode(sample)


def test_settings_are_checked():
    with pytest.raises(ValueError, match="frame must be one of"):
        Ximu3Decoder("ned")


def test_same_as_the_makers_library(tmp_path):
    library = pytest.importorskip("ximu3")
    rng = random.Random(6)
    fields = {
        "I": ("inertial", [f"{n}_{a}" for n in ("gyroscope", "accelerometer") for a in "xyz"]),
        "Q": ("quaternion", list("wxyz")),
        "R": ("rotation_matrix", [a + b for a in "xyz" for b in "xyz"]),
        "A": ("euler_angles", ["roll", "pitch", "yaw"]),
        "L": ("linear_acceleration", list("xyz")),
        "M": ("magnetometer", list("xyz")),
        "T": ("temperature", ["temperature"]),
    }
    wires, got = [], []
    for _ in range(2000):
        letter = rng.choice(list(fields))
        values = tuple(rng.gauss(0, 1) * 10 ** rng.randint(-3, 3) for _ in fields[letter][1])
        stamp = rng.choice([rng.getrandbits(64), 0x0A0ADBDC0A])
        wires.append(encode_message(letter, stamp, values, ascii=rng.random() < 0.3))
    path = tmp_path / "x.ximu3"
    path.write_bytes(b"".join(wires))
    link = library.Connection(library.FileConnectionConfig(str(path)))
    for letter, (name, names) in fields.items():

        def callback(m, letter=letter, names=names):
            got.append((letter, m.timestamp, [getattr(m, name) for name in names]))

        getattr(link, f"add_{name}_callback")(callback)
    link.open()
    for _ in range(200):
        if len(got) == len(wires):
            break
        time.sleep(0.05)
    link.close()
    assert len(got) == len(wires)
    for wire, (letter, stamp, values) in zip(wires, got, strict=True):
        mine = ximu3._parse(wire[:-1])
        assert mine[1:3] == (letter, stamp)
        assert mine[3] == pytest.approx(values, rel=1e-6)
