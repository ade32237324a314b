"""The native packet in Python: bytes, framing, and what a decoder makes of a bad line."""

import math
import random
import struct
from binascii import crc_hqx

import pytest
from cobs import cobs
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocols import native, native_packet
from firmware_protocols.native import NativeDecoder, encode, encode_info
from firmware_protocols.native_packet import Info, Packet, decode_body, encode_body
from firmware_protocols.sample import Counters, Sample

VECTOR = Packet(3, 0x0102, 1_000_000, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 9.81), (0.0, 0.0, 0.0))
LONGEST = Packet(8, 1, 1, (1.0, 0.0, 0.0, 0.0), *[(1.1, 1.2, 1.3)] * 3, 25.0, (100, 255))
BODY = bytes.fromhex("11030700020140420F00FF7F00000000000000000000D503000000000000")
WIRE = bytes.fromhex("0411030706020140420F03FF7F01010101010101010103D5030101010101039BD600")


def single(limit):
    return st.floats(-limit, limit, width=32)


def vectors(limit):
    return st.none() | st.tuples(*[single(limit)] * 3)


@st.composite
def quaternions(draw):
    q = draw(st.tuples(*[single(1)] * 4).filter(lambda q: math.hypot(*q) > 0.1))
    return tuple(x / math.hypot(*q) for x in q)


PACKETS = st.builds(
    Packet,
    st.integers(0, 255),
    st.integers(0, 65535),
    st.integers(0, 2**32 - 1),
    st.none() | quaternions(),
    vectors(320),
    vectors(36),
    vectors(3200),
    st.none() | single(300),
    st.none() | st.tuples(st.integers(0, 100), st.integers(0, 255)),
)
INFOS = st.builds(
    Info,
    st.integers(0, 255),
    st.text(st.characters(min_codepoint=0x20, max_codepoint=0x7E), max_size=32),
    st.none() | st.integers(0, 23),
    st.sampled_from(native_packet.FRAMES),
    st.integers(0, 65535).map(lambda n: n / 10),
)


def close(a, b, tolerance):
    if a is None or b is None:
        return a is b
    return all(abs(x - y) <= tolerance for x, y in zip(a, b, strict=True))


def stream(n, sensors=1, period_us=10_000):
    """n packets a sensor, interleaved, with readings that differ."""
    return [
        Packet(
            s,
            500 + i,
            7_000_000 + i * period_us,
            (1.0, 0.0, 0.0, 0.0),
            (float(i), float(s), 9.81),
            (0.0, 1.0, 2.0),
        )
        for i in range(n)
        for s in range(sensors)
    ]


def decode(data):
    decoder = NativeDecoder()
    return decoder.feed(data), decoder.counters


def sample(packet):
    """What a decoder makes of a packet that loses nothing on the wire."""
    return Sample(packet.sensor_id, packet.t_us, *packet[3:8])


def framed(body):
    return native.frame_body(bytes(body))


# --- bytes ----------------------------------------------------------------------------------------


def test_reference_vector():
    assert crc_hqx(b"123456789", 0xFFFF) == 0x29B1
    assert encode_body(VECTOR) == BODY
    assert crc_hqx(BODY, 0xFFFF) == 0xD69B
    assert encode(VECTOR) == WIRE
    assert decode(WIRE)[0] == [sample(VECTOR)]


def test_layout_of_every_block():
    quat, acc, gyr, mag = (0.0, 1.0, 0.0, 0.0), (1.0, 2.0, 3.0), (1.0, -1.0, 2.0), (10.0, 20.0, -30.0)
    packet = Packet(9, 1, 2, quat, acc, gyr, mag, 36.6, (87, 0xA5))
    head = struct.pack("<BBHHI", 0x11, 9, 0x21F, 1, 2)
    fixed = struct.pack(
        "<4h3h3h3hhBB", 0, 32767, 0, 0, 100, 200, 300, 900, -900, 1800, 100, 200, -300, 3660, 87, 0xA5
    )  # fmt: skip
    assert encode_body(packet) == head + fixed
    floats = struct.pack(
        "<BBHHIh4f3f3f3fBB", 0x11, 9, 0x3F0, 1, 2, 3660, 0, 1, 0, 0, 1, 2, 3, 1, -1, 2, 10, 20, -30, 87, 0xA5
    )  # fmt: skip
    assert encode_body(packet, floats=True) == floats
    assert len(floats) == native_packet.MAX_BODY
    assert decode_body(head + fixed) == decode_body(floats) == packet


@given(PACKETS, st.booleans())
@settings(max_examples=150, deadline=None)
def test_round_trip(packet, floats):
    back = decode_body(encode_body(packet, floats=floats))
    assert back[:3] == packet[:3]
    assert close(back.quat, packet.quat, 1e-6 if floats else 6e-5)
    assert back.quat is None or math.hypot(*back.quat) == pytest.approx(1, abs=1e-12)
    for i, step in ((4, 0.01), (5, 1 / 900), (6, 0.1)):
        assert close(back[i], packet[i], 0 if floats else step / 2 + 1e-9)
    assert close(
        back[7:8] if back[7] is not None else None,
        packet[7:8] if packet[7] is not None else None,
        0.005 + 1e-9,
    )
    assert back.battery == packet.battery
    decoder = NativeDecoder()
    expected = [] if packet[3:8] == (None,) * 5 else [sample(back)]
    assert decoder.feed(encode(packet, floats=floats)) == expected
    assert (decoder.counters.packets, decoder.counters.skipped) == ((1, 0) if expected else (0, 1))
    assert decoder.batteries.get(packet.sensor_id) == packet.battery


@given(INFOS)
@settings(max_examples=80, deadline=None)
def test_info_round_trip(info):
    decoder = NativeDecoder()
    assert decoder.feed(encode_info(info)) == []
    assert decoder.infos == {info.sensor_id: info}
    assert (decoder.counters.packets, decoder.counters.skipped) == (0, 1)


def test_info_layout():
    info = Info(3, "edgepose-esp32 1.2", 18, "ENU", 100.0)
    assert (
        native_packet.encode_info_body(info)
        == bytes([0x12, 3, 18, 1, 0xE8, 0x03, 18]) + b"edgepose-esp32 1.2"
    )


@pytest.mark.parametrize(
    "packet",
    [
        VECTOR._replace(acc=(math.nan, 0.0, 0.0)),
        VECTOR._replace(quat=(math.inf, 0.0, 0.0, 0.0)),
        VECTOR._replace(temperature=math.nan),
        VECTOR._replace(sensor_id=256),
        VECTOR._replace(seq=-1),
        VECTOR._replace(t_us=2**32),
        VECTOR._replace(battery=(5, 256)),
        VECTOR._replace(acc=(0.0, 0.0)),
    ],
)
@pytest.mark.parametrize("floats", [False, True])
def test_encoder_refuses(packet, floats):
    with pytest.raises(ValueError, match="cannot send"):
        encode(packet, floats=floats)


def test_encoder_saturates_doubles_but_refuses_them_as_floats():
    huge = VECTOR._replace(acc=(1e300, -1e300, 0.0))
    assert decode(encode(huge))[0][0].acc == (327.67, -327.68, 0.0)
    with pytest.raises(ValueError, match="cannot send"):
        encode(huge, floats=True)


@pytest.mark.parametrize(
    "info",
    [
        Info(256, ""),
        Info(1, "x" * 33),
        Info(1, "é"),
        Info(1, "\x1b[2J"),
        Info(1, "", 24),
        Info(1, "", None, "XYZ"),
        Info(1, "", None, "ENU", 6553.6),
        Info(1, "", None, "ENU", math.nan),
    ],
)
def test_info_encoder_refuses(info):
    with pytest.raises(ValueError, match=r"must be|cannot send"):
        encode_info(info)


# --- COBS -----------------------------------------------------------------------------------------

SPARSE = st.lists(
    st.sampled_from([b"\0", b"\1", b"ab", b"\xff" * 253, b"x" * 254, b"y" * 255]), max_size=6
).map(b"".join)


@given(st.binary(max_size=600) | SPARSE)
@settings(max_examples=200, deadline=None)
def test_cobs_agrees_with_reference(data):
    encoded = native.cobs_encode(data)
    assert encoded == cobs.encode(data)
    assert native.cobs_decode(encoded) == data


@given(st.binary(max_size=80) | SPARSE)
@settings(max_examples=200, deadline=None)
def test_cobs_refuses_what_reference_refuses(data):
    try:
        expected = cobs.decode(data)
    except cobs.DecodeError:
        with pytest.raises(ValueError, match="COBS"):
            native.cobs_decode(data)
    else:
        assert native.cobs_decode(data) == expected


# --- content from the wire ------------------------------------------------------------------------


def head(mask, kind=0x11):
    return struct.pack("<BBHHI", kind, 1, mask, 5, 6)


@pytest.mark.parametrize(
    "body",
    [
        head(0x401),
        head(0x8000),
        head(0x021) + struct.pack("<4h4f", 32767, 0, 0, 0, 1, 0, 0, 0),  # a quantity in both forms
        head(0x001) + bytes(8),  # norm 0
        head(0x001) + struct.pack("<4h", 29000, 0, 0, 0),
        head(0x001) + struct.pack("<4h", 32767, 20000, 0, 0),
        head(0x020) + struct.pack("<4f", math.nan, 0, 0, 0),
        head(0x020) + struct.pack("<4f", 1.11, 0, 0, 0),
        head(0x020) + struct.pack("<4f", 3e38, 3e38, 3e38, 3e38),
        head(0x040) + struct.pack("<3f", math.inf, -math.inf, 0),
        head(0x080) + struct.pack("<3f", 0, math.nan, 0),
        head(0x100) + struct.pack("<3f", 0, 0, math.inf),
        head(0x200) + b"\x65\x00",
        head(0x002) + bytes(5),
        head(0x002) + bytes(7),
        head(0x000)[:9],
        b"\x11",
        head(0, kind=0x21),
        head(0, kind=0x13),
        bytes([0x12, 1, 0, 0, 0, 0]),
        bytes([0x12, 1, 0, 0, 0, 0, 4]) + b"abc",
        bytes([0x12, 1, 0, 0, 0, 0, 3]) + b"abcd",
        bytes([0x12, 1, 0, 0, 0, 0, 33]) + b"a" * 33,
        bytes([0x12, 1, 24, 0, 0, 0, 0]),
        bytes([0x12, 1, 0, 5, 0, 0, 0]),
        bytes([0x12, 1, 0, 0, 0, 0, 1]) + b"\x07",
    ],
)
def test_rejected_content(body):
    with pytest.raises(ValueError, match=r"\w"):
        decode_body(body)
    packets, counters = decode(framed(body) + WIRE)
    assert packets == [sample(VECTOR)]
    assert counters == Counters(bytes=len(framed(body) + WIRE), packets=1, bad=1, resyncs=1)


def test_quaternion_is_normalised():
    (packet,), _ = decode(framed(head(0x020) + struct.pack("<4f", 0.0, 0.0, -1.09, 0.0)))
    assert packet.quat == (0.0, 0.0, -1.0, 0.0)


def test_packet_with_nothing_for_a_sample():
    decoder = NativeDecoder()
    assert decoder.feed(framed(head(0)) + encode(Packet(1, 7, 8, battery=(60, 1)))) == []
    assert decoder.batteries == {1: (60, 1)}
    assert (decoder.counters.skipped, decoder.counters.lost) == (2, 1)


# --- the stream -----------------------------------------------------------------------------------


@given(st.integers(0, 2**32))
@settings(max_examples=80, deadline=None)
def test_any_chunking(seed):
    rng = random.Random(seed)
    data = b""
    for packet in stream(6, sensors=2):
        data += encode(packet, floats=rng.random() < 0.5)
        if rng.random() < 0.4:
            data += rng.choice(
                [
                    b"",
                    b"\0",
                    rng.randbytes(300),
                    encode_info(Info(1, "v"))[: rng.randrange(12)],
                    b"x" * 70,
                    b"y" * 200,
                ]
            )
    whole = NativeDecoder()
    expected = whole.feed(data)
    pieces = NativeDecoder()
    packets, start = [], 0
    while start < len(data):
        size = rng.choice([1, 2, 7, 64, 200])
        packets += pieces.feed(data[start : start + size])
        start += size
    assert packets == expected
    assert pieces.counters == whole.counters
    assert pieces.infos == whole.infos
    assert len(packets) == 12


def test_noise_costs_no_packet():
    rng = random.Random(1)
    for length in (1, 2, 5, 34, 69, 70, 71, 1000):
        sent = stream(20)
        data = b"".join(rng.randbytes(length) + encode(p) for p in sent) + rng.randbytes(length)
        packets, counters = decode(data)
        assert packets == list(map(sample, sent))
        assert counters.lost == 0
        assert counters.resyncs == 20
        assert counters.bad >= 20


def test_every_single_bit_flip_costs_one_packet_at_most():
    first, second, third = stream(3)
    good = encode(second)
    for bit in range(8 * len(good)):
        broken = bytearray(good)
        broken[bit // 8] ^= 1 << bit % 8
        packets, counters = decode(encode(first) + bytes(broken) + encode(third))
        # A flip in the closing 00 joins the frame to the next one, which is still found.
        assert packets == [sample(first), sample(third)], bit
        assert counters.lost == 1
        assert counters.resyncs == 1


def test_every_truncation_costs_one_packet():
    first, second, third = stream(3)
    good = encode(second)
    for keep in range(1, len(good)):
        packets, counters = decode(encode(first) + good[:keep] + encode(third))
        assert packets == [sample(first), sample(third)], keep
        assert counters.bad == 1
    for start in range(1, len(good) - 1):
        packets, _ = decode(encode(first) + good[start:] + encode(third))
        assert packets == [sample(first), sample(third)]


@pytest.mark.parametrize("noise", [1, 2, 68, 69, 70, 71, 500])
@pytest.mark.parametrize("size", [1, 50, 10_000])
def test_longest_packet_after_noise(noise, size):
    data = random.Random(noise).randbytes(noise).replace(b"\0", b"\1") + encode(LONGEST, floats=True)
    decoder, packets = NativeDecoder(), []
    for start in range(0, len(data), size):
        packets += decoder.feed(data[start : start + size])
    assert [p.sensor for p in packets] == [LONGEST.sensor_id]
    assert decoder.counters == Counters(bytes=len(data), packets=1, bad=1, resyncs=1)


def test_start_in_the_middle_and_unfinished_end():
    sent = stream(3)
    data = b"".join(map(encode, sent))
    packets, counters = decode(data[10:-1])
    assert packets == [sample(sent[1])]
    assert (counters.lost, counters.bad) == (0, 1)


def test_oversize_frame_is_dropped_without_growing():
    decoder = NativeDecoder()
    for _ in range(1000):
        assert decoder.feed(b"\x55" * 1000) == []
        assert len(decoder._rest) <= native.MAX_FRAME + 1
    assert decoder.feed(b"\0" + WIRE) == [sample(VECTOR)]
    assert decoder.counters == Counters(bytes=1_000_001 + len(WIRE), packets=1, bad=1, resyncs=1)


def test_longest_frame_is_accepted():
    wire = encode(LONGEST, floats=True)
    assert len(wire) == native.MAX_FRAME + 1
    assert len(decode(wire)[0]) == 1


@given(st.lists(st.binary(max_size=120), max_size=8))
@settings(max_examples=150, deadline=None)
def test_random_bytes_never_raise(chunks):
    decoder = NativeDecoder()
    for chunk in chunks:
        decoder.feed(chunk)
    assert decoder.counters.bytes == sum(map(len, chunks))


@given(st.binary(max_size=70), st.sampled_from([0x11, 0x12, None]))
@settings(max_examples=200, deadline=None)
def test_random_bodies_with_good_checksums_never_raise(body, kind):
    decode(framed(body if kind is None else bytes([kind]) + body) + b"\0")


def test_accepts_every_bytes_like():
    assert NativeDecoder().feed(bytearray(WIRE)) == [sample(VECTOR)]
    assert NativeDecoder().feed(memoryview(WIRE)) == [sample(VECTOR)]


# --- sequences ------------------------------------------------------------------------------------


def run(*seq_and_time, sensor=0):
    """Counters after packets at (seq, seconds), and the sequence numbers that came out."""
    decoder = NativeDecoder()
    out = []
    for seq, t in seq_and_time:
        seq &= 0xFFFF
        packet = Packet(sensor, seq, round(t * 1e6) & 0xFFFFFFFF, acc=(float(seq), 0.0, 0.0))
        out += decoder.feed(encode(packet, floats=True))
    return decoder.counters, [s.acc[0] for s in out]


def test_loss_by_sensor():
    sent = stream(50, sensors=6)
    missing = {(0, 510), (0, 511), (4, 530)}
    _, counters = decode(b"".join(encode(p) for p in sent if p[:2] not in missing))
    assert counters.packets == 297
    assert (counters.lost, counters.late, counters.restarts) == (3, 0, 0)


def test_sequence_and_clock_wrap():
    counters, seqs = run((65534, 4294.95), (65535, 4294.96), (0, 4294.97), (2, 4294.99))
    assert seqs == [65534, 65535, 0, 2]
    assert (counters.lost, counters.late, counters.restarts) == (1, 0, 0)


def test_long_loss():
    counters, _ = run((60000, 100.0), (62000, 120.0))
    assert (counters.lost, counters.restarts) == (1999, 0)
    counters, _ = run((65000, 100.0), (1464, 120.0))
    assert (counters.lost, counters.restarts) == (1999, 0)


def test_duplicates_and_late_packets_are_dropped():
    counters, seqs = run((10, 1.0), (10, 1.0), (11, 1.01), (13, 1.03), (12, 1.02), (14, 1.04))
    assert seqs == [10, 11, 13, 14]
    assert (counters.lost, counters.late, counters.restarts) == (1, 2, 0)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ((40000, 400.0), (0, 0.01)),
        ((3, 400.0), (0, 0.01)),
        ((65000, 650.0), (0, 0.01)),  # forwards by 536 in the sequence
        ((100, 3000.0), (101, 0.5)),
        ((100, 300.0), (101, 0.5)),  # only the clock began anew
        ((30000, 300.0), (0, 303.0)),  # the clock went on
        ((5, 5.0), (40000, 5.01)),
        ((5, 5.0), (5000, 65.0)),  # a pause in which the sequence can go around
    ],
)
def test_restart_is_not_loss(before, after):
    counters, seqs = run(before, after, (after[0] + 1, after[1] + 0.01))
    assert seqs == [before[0], after[0], after[0] + 1]
    assert (counters.lost, counters.late, counters.restarts) == (0, 0, 1)


def test_sensor_that_does_not_count():
    counters, seqs = run((0, 1.0), (0, 1.01), (0, 1.02))
    assert seqs == [0, 0, 0]
    assert (counters.lost, counters.late, counters.restarts) == (0, 0, 0)
