"""MAVLink through pymavlink: messages, pairing, and what a decoder makes of a bad line."""

import json
import math
import random
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocols import mavlink
from firmware_protocols.mavlink import Encoder, MavlinkDecoder
from firmware_protocols.rotation import rotate
from firmware_protocols.sample import STANDARD_G, Sample, z_up

common = pytest.importorskip("pymavlink.dialects.v20.common")

DATA = json.loads((Path(__file__).parents[1] / "data/protocols/mavlink.json").read_text(encoding="utf-8"))
SENSOR = 1 << 8 | 5


def quaternion(rng):
    q = [rng.gauss(0, 1) for _ in range(4)]
    return tuple(x / math.hypot(*q) for x in q)


def stream(n, sensors=(SENSOR,), seed=1):
    rng = random.Random(seed)
    return [
        Sample(
            sensor,
            5_000_000 + i * 10_000,
            quaternion(rng),
            tuple(rng.gauss(0, 8) for _ in range(3)),
            tuple(rng.gauss(0, 3) for _ in range(3)),
            tuple(rng.gauss(0, 30) for _ in range(3)),
            25.5,
        )
        for i in range(n)
        for sensor in sensors
    ]


def close(a, b, tolerance=1e-4):
    if a[:2] != b[:2]:
        return False
    for name, p, q in zip(Sample._fields[2:], a[2:], b[2:], strict=True):
        if p is None or q is None:
            if p is not q:
                return False
        elif name == "quat":
            if abs(abs(sum(x * y for x, y in zip(p, q, strict=True))) - 1) > tolerance:
                return False
        elif name == "temperature":
            if abs(p - q) > 0.01:
                return False
        elif any(abs(x - y) > tolerance for x, y in zip(p, q, strict=True)):
            return False
    return True


def all_close(a, b, tolerance=1e-4):
    return len(a) == len(b) and all(close(x, y, tolerance) for x, y in zip(a, b, strict=True))


def packed(message, sysid=1, compid=5, seq=0, **options):
    link = common.MAVLink(None, sysid, compid)
    link.seq = seq
    return bytes(message.pack(link, **options))


@pytest.mark.parametrize("vector", DATA["vectors"], ids=lambda v: v["id"])
def test_vectors(vector):
    decoder = MavlinkDecoder()
    assert decoder.feed(bytes.fromhex(vector["hex"])) == []
    (sample,) = decoder.flush()
    assert sample.sensor == vector["sensor"]
    assert sample.time_us == vector["time_us"]
    assert sample.gyr == pytest.approx(vector["gyr"])
    if "quat_ned" in vector:
        assert sample.quat == pytest.approx(z_up(tuple(vector["quat_ned"])))
    else:
        acc = vector.get("acc") or [x * STANDARD_G / 1000 for x in vector["acc_mg"]]
        assert sample.acc == pytest.approx(acc)
        # HIGHRES_IMU says that its magnetometer and temperature are not new.
        assert sample.mag == (pytest.approx(vector["mag"]) if "mag" in vector else None)
        assert sample.temperature is None


def test_level_and_north():
    """Body axes of MAVLink are x forward, y right, z down: a level still one reads -1 g on z."""
    attitude = common.MAVLink_attitude_quaternion_message(1000, 1, 0, 0, 0, 0, 0, 0)
    reading = common.MAVLink_scaled_imu_message(1000, 0, 0, -1000, 0, 0, 0, 0, 0, 0)
    decoder = MavlinkDecoder()
    (sample,) = decoder.feed(packed(reading) + packed(attitude, seq=1))
    assert rotate(sample.quat, sample.acc) == pytest.approx((0, 0, STANDARD_G))
    assert rotate(sample.quat, (1.0, 0.0, 0.0)) == pytest.approx((0, 1, 0), abs=1e-9)
    assert sample.mag is None
    assert decoder.counters.lost == 0


@pytest.mark.parametrize("highres", [True, False])
def test_round_trip(highres):
    expected = stream(50, sensors=(SENSOR, 2 << 8 | 1, 1 << 8 | 6))
    encoder = Encoder(highres=highres)
    decoder = MavlinkDecoder()
    got = decoder.feed(b"".join(map(encoder.encode, expected)))
    assert all_close(got, expected, 1e-4 if highres else 0.06)
    assert decoder.counters.packets == 150
    assert decoder.counters.bad == decoder.counters.lost == decoder.counters.skipped == 0


def test_lost_messages_are_counted_and_never_mixed():
    expected = stream(300)
    encoder = Encoder()
    pieces = [
        piece
        for s in expected
        for piece in (encoder.encode(s._replace(quat=None)), encoder.encode(s._replace(acc=None, gyr=None)))
    ]
    rng = random.Random(4)
    touched = set(rng.sample(range(1, 599), 50))
    decoder = MavlinkDecoder()
    got = decoder.feed(b"".join(p for i, p in enumerate(pieces) if i not in touched)) + decoder.flush()
    assert decoder.counters.lost == len(touched)
    by_time = {s.time_us: s for s in expected}
    for sample in got:
        true = by_time[sample.time_us]
        if sample.quat is not None:
            assert abs(sum(x * y for x, y in zip(sample.quat, true.quat, strict=True))) == pytest.approx(1)
        if sample.acc is not None:
            assert sample.acc == pytest.approx(true.acc, abs=1e-5)


def test_times_need_not_be_equal():
    a, b = stream(2)
    encoder = Encoder()
    shifted = [a, b._replace(time_us=b.time_us + 3000)]
    data = b""
    for sample, late in zip((a, b), shifted, strict=True):
        data += encoder.encode(late._replace(quat=None)) + encoder.encode(sample._replace(acc=None, gyr=None))
    got = MavlinkDecoder().feed(data)
    # Where both have a rate, that of the reading counts: the orientation's is 0 here.
    assert all_close(got, [a, b])
    decoder = MavlinkDecoder(tolerance_us=1000)
    assert len(decoder.feed(data) + decoder.flush()) == 3


def test_one_of_several_readings():
    def reading(number, z):
        return common.MAVLink_highres_imu_message(1000, 0, 0, z, *[0] * 10, 63, number)

    data = packed(reading(0, -1)) + packed(reading(1, -2)) + packed(reading(0, -3))
    decoder = MavlinkDecoder(imu=1)
    assert [s.acc for s in decoder.feed(data) + decoder.flush()] == [(0, 0, -2)]
    assert decoder.counters.skipped == 2


def test_other_versions_messages_and_values():
    nan = math.nan
    attitude = common.MAVLink_attitude_quaternion_message(7, 1, 0, 0, 0, 0, 0, 0)
    decoder = MavlinkDecoder()
    decoder.feed(packed(common.MAVLink_heartbeat_message(1, 1, 0, 0, 0, 3)))
    decoder.feed(packed(common.MAVLink_attitude_quaternion_message(5, nan, 0, 0, 0, 0, 0, 0)))
    decoder.feed(packed(common.MAVLink_attitude_quaternion_message(5, 0, 0, 0, 0, 0, 0, 0)))
    decoder.feed(packed(common.MAVLink_highres_imu_message(5, nan, 0, 0, 0, nan, 0, *[0] * 7, 63)))
    assert decoder.counters.skipped == 4
    signing = common.MAVLink(None, 1, 5)
    signing.signing.secret_key = bytes(32)
    signing.signing.sign_outgoing = True
    for wire in (packed(attitude, force_mavlink1=True), bytes(attitude.pack(signing))):
        decoder = MavlinkDecoder()
        assert decoder.feed(wire + wire[:1]) + decoder.flush() == [
            Sample(SENSOR, 7000, z_up((1.0, 0.0, 0.0, 0.0)), None, (0, 0, 0))
        ]
        assert decoder.counters.bad == 0


@given(st.lists(st.integers(1, 90), max_size=40))
@settings(max_examples=40, deadline=None)
def test_any_chunking_gives_the_same(in_pieces, sizes):
    encoder = Encoder()
    data = b"\xfd\x05noise\xfe" + b"".join(map(encoder.encode, stream(8))) + b"\xfd\x00\x02" + bytes(300)
    got, _ = in_pieces(MavlinkDecoder, data, sizes)
    assert len(got) == 8


@given(
    st.lists(st.binary(max_size=100) | st.sampled_from([b"\xfd", b"\xfe", b"\xfd\x1f\x00\x00"]), max_size=30)
)
@settings(max_examples=150, deadline=None)
def test_random_bytes_never_raise(chunks):
    decoder = MavlinkDecoder()
    for chunk in chunks:
        decoder.feed(chunk)
        assert len(decoder._rest) < 300
    assert decoder.counters.bytes == sum(map(len, chunks))


def test_flipped_bits_and_cuts_cost_only_what_they_touch():
    rng = random.Random(12)
    expected = stream(300)
    encoder = Encoder()
    pieces = list(map(encoder.encode, expected))
    touched = set(rng.sample(range(300), 60))
    for i in touched:
        piece = bytearray(pieces[i])
        kind = rng.randrange(3)
        if kind == 0:
            piece[rng.randrange(len(piece))] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del piece[rng.randrange(len(piece)) :]
        else:
            at = rng.randrange(1, len(piece))
            piece[at:at] = rng.randbytes(rng.randrange(1, 40))
        pieces[i] = bytes(piece)
    decoder = MavlinkDecoder()
    # A cut at the end may leave a length that reaches beyond it.
    got = decoder.feed(b"".join(pieces) + bytes(300))
    whole = {s.time_us: s for s in got if s.quat is not None and s.acc is not None}
    for i, sample in enumerate(expected):
        if i not in touched:
            assert close(whole[sample.time_us], sample)
    assert decoder.counters.bad
    assert decoder.counters.resyncs


def test_sees_what_pymavlink_sees():
    encoder = Encoder()
    data = b"".join(map(encoder.encode, stream(100)))
    parser = common.MAVLink(None)
    messages = parser.parse_buffer(data)
    decoder = MavlinkDecoder()
    got = decoder.feed(data)
    turns = [m for m in messages if m.get_msgId() == 31]
    assert len(messages) == 2 * len(turns) == 2 * len(got) == 200
    for sample, turn in zip(got, turns, strict=True):
        assert sample.quat == pytest.approx(z_up((turn.q1, turn.q2, turn.q3, turn.q4)), abs=1e-6)
        assert sample.time_us == turn.time_boot_ms * 1000


@pytest.mark.parametrize(
    "sample",
    [
        Sample(SENSOR, None, (1.0, 0.0, 0.0, 0.0)),
        Sample(1 << 16, 1, (1.0, 0.0, 0.0, 0.0)),
        Sample(SENSOR, 1, None, (0.0, 0.0, 1.0)),
        Sample(SENSOR, 1, (1e39, 0.0, 0.0, 0.0)),
        Sample(SENSOR, 1, None, (0.0, 0.0, 1e6), (0.0, 0.0, 0.0)),
    ],
)
def test_what_cannot_be_sent(sample):
    with pytest.raises(ValueError, match=r"time|both|cannot"):
        Encoder(highres=False).encode(sample)


def test_without_pymavlink(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymavlink.dialects.v20.common", None)
    for make in (MavlinkDecoder, Encoder):
        with pytest.raises(RuntimeError, match=r"pip install \"edgepose\[mavlink\]\""):
            make()
    assert mavlink.MavlinkDecoder.WRAP_US == 1000 << 32
