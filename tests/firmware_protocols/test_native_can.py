"""Native packets on a CAN bus: frames, the pairing of ACC and QUAT, clocks, and what must not get through."""

import math
import random
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocols import native_can
from firmware_protocols.native_can import NativeCanDecoder, can_id, encode, encode_fd, encode_sync
from firmware_protocols.native_packet import Info, Packet, encode_body
from firmware_protocols.sample import Counters, Sample

LEVEL = Packet(3, 0x0102, 1_000_000, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 9.81), (0.0, 0.0, 0.0))


def stream(n, sensors=1, period_us=10_000, start_us=7_000_000, **changes):
    return [
        Packet(s, i & 0xFFFF, start_us + i * period_us, (1.0, 0.0, 0.0, 0.0), (float(i % 300), 0.0, float(s)))
        ._replace(**changes)
        for i in range(n)
        for s in range(sensors)
    ]  # fmt: skip


def sample(packet):
    """What a decoder makes of a packet that loses nothing on the bus."""
    time_us = packet.t_us % NativeCanDecoder.WRAP_US
    return Sample(packet.sensor_id, time_us, packet.quat, packet.acc, packet.gyr, packet.mag)


def decode(frames, base=native_can.BASE):
    decoder = NativeCanDecoder(base)
    extended = native_can.is_extended(base)
    return [s for i, data in frames for s in decoder.feed(i, data, extended)], decoder.counters


def can20(packets):
    return [frame for packet in packets for frame in encode(packet)]


# --- frames ---------------------------------------------------------------------------------------


def test_layout():
    packet = LEVEL._replace(t_us=123_456, gyr=(1.0, -1.0, 2.0), mag=(10.0, 20.0, -30.0))
    assert encode(packet) == [
        (0x403, struct.pack("<3hH", 0, 0, 981, 1234)),
        (0x443, struct.pack("<3hH", 900, -900, 1800, 1234)),
        (0x463, struct.pack("<3hH", 100, 200, -300, 1234)),
        (0x423, struct.pack("<4h", 32767, 0, 0, 0)),
    ]
    samples, counters = decode(encode(packet))
    assert samples == [sample(packet)._replace(time_us=123_400)]
    assert counters == Counters(bytes=32, packets=1)


def test_fd_layout():
    body = encode_body(LEVEL)
    assert len(body) == 30
    assert encode_fd(LEVEL) == (0x403, body + bytes(2))
    assert encode_fd(Packet(31, 1, 2)) == (0x41F, encode_body(Packet(31, 1, 2)) + bytes(2))
    samples, counters = decode([encode_fd(LEVEL)])
    assert samples == [sample(LEVEL)]
    assert counters == Counters(bytes=32, packets=1)


def test_sync_is_skipped():
    assert encode_sync(2**32 + 0x01020304) == (0x080, bytes([4, 3, 2, 1]))
    assert decode([encode_sync(5)]) == ([], Counters(bytes=4, skipped=1))


VECTORS = st.tuples(*[st.floats(-30, 30, width=32)] * 3)


@given(
    st.integers(0, 31),
    st.integers(0, 2**40),
    st.sampled_from([0x100, 0x400, 0x780, 0x781, 0x18FF_0000, 2**29 - 128]),
    VECTORS,
    st.none() | VECTORS,
    st.none() | VECTORS,
    st.booleans(),
)
@settings(max_examples=100, deadline=None)
def test_round_trip(sensor, t_us, base, acc, gyr, mag, oriented):
    quat = (0.6, 0.0, -0.8, 0.0) if oriented else None
    (back,), counters = decode(encode(Packet(sensor, 0, t_us, quat, acc, gyr, mag), base), base)
    assert (back.sensor, back.time_us) == (sensor, t_us // 100 % 65536 * 100)
    for sent, got, step in (
        (quat, back.quat, 1e-4), (acc, back.acc, 0.01), (gyr, back.gyr, 1 / 900), (mag, back.mag, 0.1)
    ):  # fmt: skip
        assert got == (None if sent is None else pytest.approx(sent, abs=step * 0.51))
    assert counters.bad == counters.lost == 0


@pytest.mark.parametrize("floats", [False, True])
def test_fd_round_trip_of_every_length(floats):
    parts = {"quat": (0.5, -0.5, 0.5, 0.5), "acc": (1.0, 2.0, 3.0), "gyr": (1.0, 2.0, 3.0)}
    parts |= {"mag": (1.0, 2.0, 3.0), "temperature": 25.0, "battery": (50, 7)}
    lengths = set()
    for mask in range(1, 63):
        packet = Packet(9, 1, 2_000_000, **{k: v for i, (k, v) in enumerate(parts.items()) if mask >> i & 1})
        decoder = NativeCanDecoder()
        frame = encode_fd(packet, floats=floats)
        lengths.add(len(frame[1]))
        expected = sample(packet)._replace(temperature=packet.temperature)
        if expected[2:] == (None,) * 5:
            assert (decoder.feed(*frame), decoder.counters.skipped) == ([], 1)
        else:
            (got,) = decoder.feed(*frame)
            assert got[:2] == expected[:2]
            for a, b in zip(got[2:], expected[2:], strict=True):
                assert a == (None if b is None else pytest.approx(b, abs=6e-4))
        assert decoder.batteries == ({} if packet.battery is None else {9: (50, 7)})
    assert lengths <= set(native_can.FD_LENGTHS)
    assert len(lengths) > 4


def test_fd_info():
    decoder = NativeCanDecoder()
    info = Info(4, "board 1.0", 18, "ENU", 100.0)
    assert decoder.feed(*encode_fd(info)) == []
    assert decoder.infos == {4: info}
    assert decoder.counters == Counters(bytes=16, skipped=1)


def test_encoders_refuse():
    longest = Packet(8, 1, 1, (1.0, 0.0, 0.0, 0.0), *[(1.1, 1.2, 1.3)] * 3, 25.0, (100, 255))
    with pytest.raises(ValueError, match="66 bytes"):
        encode_fd(longest, floats=True)
    with pytest.raises(ValueError, match="acceleration"):
        encode(LEVEL._replace(acc=None))
    with pytest.raises(ValueError, match="cannot send"):
        encode(LEVEL._replace(quat=(math.nan, 0.0, 0.0, 0.0)))
    for call in (lambda: encode(LEVEL._replace(sensor_id=32)), lambda: encode_fd(Info(32, ""))):
        with pytest.raises(ValueError, match="0 to 31"):
            call()


@pytest.mark.parametrize("base", [-1, 0x001, 0x080, 2**29 - 127])
def test_bases_that_cannot_be(base):
    with pytest.raises(ValueError, match="base"):
        NativeCanDecoder(base)
    with pytest.raises(ValueError, match="base"):
        can_id(0, 0, base)


def test_others_on_the_bus_are_skipped():
    decoder = NativeCanDecoder(0x200)
    for other in (0x1FF, 0x280, 0x403, 0x080):
        assert decoder.feed(other, bytes(8)) == []
    assert decoder.feed(0x200, bytes(8), extended=True) == []
    assert decoder.counters == Counters(bytes=40, skipped=5)


# --- pairing --------------------------------------------------------------------------------------


@pytest.mark.parametrize("changes", [{}, {"gyr": (1.0, 0.0, -1.0)}, {"mag": (1.0, 2.0, 3.0)}])
def test_one_lost_frame_costs_one_sample(changes):
    sent = stream(5, sensors=3, **changes)
    frames = can20(sent)
    per_sample = len(frames) // 15
    for at in range(3 * per_sample, len(frames) - 3 * per_sample):
        got, counters = decode(frames[:at] + frames[at + 1 :])
        whole = [sample(p) for p in sent]
        place = at // per_sample
        if at % per_sample in (0, per_sample - 1):
            assert got == whole[:place] + whole[place + 1 :], at
            assert counters.lost == 1
        else:
            whole[place] = whole[place]._replace(gyr=None, mag=None)
            assert got == whole, at


def test_empty_quat_closes_a_sample_without_orientation():
    sent = stream(5, quat=None, gyr=(1.0, 2.0, 3.0))
    frames = can20(sent)
    assert frames[2] == (0x420, b"")
    assert decode(frames)[0] == [sample(p) for p in sent]
    got, counters = decode(frames[:5] + frames[6:])
    assert got == [sample(p) for p in (*sent[:1], *sent[2:])]
    assert counters.lost == 1


def test_loss_across_two_samples_shows_in_the_angular_rate():
    sent = stream(4, gyr=(1.0, 2.0, 3.0))
    frames = can20(sent)
    got, counters = decode(frames[:5] + frames[7:])  # QUAT of sample 1, ACC of sample 2
    assert got == [sample(sent[0]), sample(sent[3])]
    assert (counters.lost, counters.bad) == (2, 0)


def feed_timed(frames_and_times):
    decoder = NativeCanDecoder()
    return [s for (i, d), t in frames_and_times for s in decoder.feed(i, d, False, t)], decoder.counters


def test_loss_across_two_samples_shows_in_the_times_of_arrival():
    sent = stream(10)
    timed = [(f, 100 + 0.01 * i + 0.0005 * k) for i, p in enumerate(sent) for k, f in enumerate(encode(p))]
    assert feed_timed(timed)[0] == [sample(p) for p in sent]
    for k in range(3, 17, 2):
        got, counters = feed_timed(timed[:k] + timed[k + 2 :])
        assert got == [sample(p) for i, p in enumerate(sent) if i not in (k // 2, k // 2 + 1)]
        assert counters.lost == 2


def test_period_recovers_after_two_samples_close_together():
    times = [0.0, 0.01, 0.0101, *(0.02 + 0.01 * i for i in range(100))]
    timed = []
    for i, t in enumerate(times):
        for k, frame in enumerate(encode(LEVEL._replace(t_us=round(t * 1e6), acc=(float(i), 0.0, 0.0)))):
            timed.append((frame, t + 0.002 * k))
    got, _ = feed_timed(timed)
    assert [s.acc[0] for s in got[-60:]] == [float(i) for i in range(43, 103)]


@pytest.mark.parametrize("extra", [{}, {"gyr": (0.0, 0.0, 0.0)}])
def test_losses_never_mix_samples(extra):
    rng = random.Random(8)
    timed = []
    for p in stream(300, sensors=3, **extra):
        # Orientation and rate tell which sample they belong to, as the acceleration does.
        p = p._replace(quat=(math.cos(p.seq / 200), math.sin(p.seq / 200), 0.0, 0.0))
        p = p._replace(gyr=p.gyr and (p.seq / 10, 0.0, 0.0))
        timed += [(f, p.t_us * 1e-6 + 0.001 * p.sensor_id + 0.0002 * k) for k, f in enumerate(encode(p))]
    kept = []
    while timed:
        keep, drop = rng.randrange(1, 30), rng.choice([1, 1, 2, 5, 13, 100])
        kept += timed[:keep]
        timed = timed[keep + drop :]
    got, counters = feed_timed(kept)
    assert 150 < counters.packets == len(got) < 800
    for s in got:
        index = s.acc[0]
        assert s.quat[:2] == pytest.approx((math.cos(index / 200), math.sin(index / 200)), abs=1e-3)
        assert s.gyr is None or s.gyr[0] == pytest.approx(index / 10, abs=1e-3)


def test_joining_in_the_middle_is_no_loss():
    sent = stream(3, gyr=(1.0, 2.0, 3.0))
    for start in (1, 2):
        got, counters = decode(can20(sent)[start:])
        assert got == [sample(p) for p in sent[1:]]
        assert counters.lost == 0


def test_frame_that_came_twice_is_harmless():
    sent = stream(3)
    frames = can20(sent)
    got, counters = decode([frames[0], frames[0], *frames[1:]])
    assert got == [sample(p) for p in sent]
    assert counters.lost == 0


def test_starting_sensor_gives_nothing():
    zeros = (0x423, bytes(8))
    nearly = (0x423, struct.pack("<4h", 29000, 0, 0, 0))
    acc = encode(LEVEL)[0]
    got, counters = decode([acc, zeros, acc, nearly, *encode(LEVEL)])
    assert got == [sample(LEVEL)]
    assert (counters.bad, counters.resyncs) == (2, 1)


# --- clocks ---------------------------------------------------------------------------------------


def test_times_of_both_forms_wrap_alike():
    # Over the wrap of the 16 bit time and, on CAN FD, over that of the 32 bit time.
    start = 42_900_000 * 100
    sent = stream(1500, start_us=start)
    expected = [p.t_us % NativeCanDecoder.WRAP_US for p in sent]
    assert [s.time_us for s in decode(can20(sent))[0]] == expected
    fd = [encode_fd(p._replace(t_us=p.t_us % 2**32)) for p in sent]
    samples, counters = decode(fd)
    assert [s.time_us for s in samples] == expected
    assert (counters.lost, counters.late, counters.restarts) == (0, 0, 0)


def test_fd_sequence():
    sent = stream(6)
    frames = list(map(encode_fd, sent))
    got, counters = decode([frames[0], frames[0], frames[3], frames[2], frames[4]])
    assert got == [sample(sent[i]) for i in (0, 3, 4)]
    assert (counters.lost, counters.late) == (2, 2)


# --- content --------------------------------------------------------------------------------------


FD = encode_fd(LEVEL)[1]


@pytest.mark.parametrize(
    ("can_id", "data"),
    [
        (0x403, FD[:-1] + b"\1"),
        (0x404, FD),  # another sensor's identifier
        (0x423, FD),  # a whole packet is message 0
        (0x403, FD[:24]),
        (0x403, b"\x21" + FD[1:]),
        (0x403, FD[:3] + b"\x80" + FD[4:]),
        (0x403, b"\x12\x03\0\0\0\0\x20" + b"a" * 25),
        (0x403, FD[:10] + bytes(22)),
        (0x403, bytes(7)),
        (0x403, b""),
        (0x423, bytes(7)),
        (0x443, bytes(8)),  # no ACC before it
        (0x463, bytes(8)),
    ],
)
def test_bad_content(can_id, data):
    acc, gyr, quat = encode(LEVEL)
    before = [acc] if can_id == 0x423 and len(data) < 9 else []
    got, counters = decode([*before, (can_id, data), acc, gyr, quat])
    assert got == [sample(LEVEL)]
    assert (counters.bad, counters.resyncs) == (1, 1)


@given(st.lists(st.tuples(st.integers(0x3F0, 0x490), st.binary(max_size=64), st.booleans()), max_size=30))
@settings(max_examples=150, deadline=None)
def test_random_frames_never_raise(frames):
    decoder = NativeCanDecoder()
    for frame in frames:
        for s in decoder.feed(*frame):
            assert 0 <= s.time_us < NativeCanDecoder.WRAP_US


def test_accepts_every_bytes_like():
    for kind in (bytearray, memoryview):
        assert decode([(i, kind(d)) for i, d in [*encode(LEVEL), encode_fd(LEVEL)]])[0] == [sample(LEVEL)] * 2
