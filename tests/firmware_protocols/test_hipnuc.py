"""HiPNUC over a serial line and CAN: published and measured frames, bad lines, encoders against decoders."""

import json
import math
import random
import struct
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocols import hipnuc, hipnuc_can
from firmware_protocols.hipnuc import HipnucDecoder
from firmware_protocols.hipnuc_can import HipnucCanopenDecoder, HipnucJ1939Decoder
from firmware_protocols.sample import STANDARD_G, Counters, Sample

VECTORS = json.loads((Path(__file__).parents[1] / "data" / "protocols" / "hipnuc.json").read_text())
SERIAL = {v["id"]: v for v in VECTORS if v["form"] == "serial"}
STEP = dict(rel=1e-6, abs=1e-6)


def stream(n, sensor=0, mag=True):
    return [
        Sample(
            sensor,
            (1000 + 10 * i) * 1000,
            (0.5, -0.5, 0.5, 0.5),
            (STANDARD_G * i / 64, STANDARD_G, 0.0),
            (0.0, math.radians(i), 1.0),
            (20.0, float(i), -40.0) if mag else None,
            25.0,
        )
        for i in range(n)
    ]


def check(sample, expected, **tolerance):
    tolerance = tolerance or STEP
    for name in Sample._fields:
        if name in expected:
            got, want = getattr(sample, name), expected[name]
            assert (got is None) == (want is None), name
            assert want is None or got == pytest.approx(want, **tolerance), name


def same(got, sent, **tolerance):
    assert len(got) == len(sent)
    for a, b in zip(got, sent, strict=True):
        check(a, b._asdict(), **tolerance)


def rotated(quat, v):
    w, x, y, z = quat
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return [sum(a * b for a, b in zip(row, v, strict=True)) for row in rows]


def decode(data, **options):
    decoder = HipnucDecoder(**options)
    return decoder.feed(data), decoder.counters


def run(decoder, frames):
    return [sample for can_id, data, extended in frames for sample in decoder.feed(can_id, data, extended)]


# --- published and measured frames ----------------------------------------------------------------


@pytest.mark.parametrize("name", SERIAL)
def test_serial_vectors(name):
    vector = SERIAL[name]
    samples, counters = decode(bytes.fromhex(vector["hex"]))
    assert len(samples) == len(vector["expect"])
    for sample, expected in zip(samples, vector["expect"], strict=True):
        # The manual gives the quaternions of its own example with three digits; norms off 1 are put right.
        norm = math.hypot(*expected["quat"])
        check(sample, {name: value for name, value in expected.items() if name != "quat"})
        loose = 2e-4 if name == "hi62_two_nodes" else 2e-6
        assert sample.quat == pytest.approx([x / norm for x in expected["quat"]], abs=loose)
        assert math.hypot(*sample.quat) == pytest.approx(1, abs=1e-12)
    assert (counters.packets, counters.bad, counters.skipped) == (len(samples), 0, 0)


@pytest.mark.parametrize("name", ["hi91_new", "hi91_live", "hi_legacy"])
def test_gravity_points_up(name):
    (sample,), _ = decode(bytes.fromhex(SERIAL[name]["hex"]))
    up = rotated(sample.quat, sample.acc)
    assert up == pytest.approx([0, 0, math.hypot(*sample.acc)], abs=0.4)
    assert math.hypot(*sample.acc) == pytest.approx(STANDARD_G, rel=0.03)


def test_canopen_vectors():
    frames = {v["can_id"]: v for v in VECTORS if v["form"] == "canopen"}
    decoder = HipnucCanopenDecoder()
    assert decoder.feed(0x188, bytes.fromhex(frames[0x188]["hex"])) == []
    assert decoder.feed(0x288, bytes.fromhex(frames[0x288]["hex"])) == []
    assert decoder.feed(0x388, bytes.fromhex("8F00CFFFB90F")) == []  # angles
    (sample,) = decoder.feed(0x488, bytes.fromhex(frames[0x488]["hex"]))
    assert sample.sensor == 8
    for vector in frames.values():
        check(sample, vector["expect"])
    assert decoder.counters == Counters(bytes=26, packets=1, skipped=1)


# --- items ----------------------------------------------------------------------------------------


def test_id_of_older_devices():
    sent = stream(1, sensor=5)
    (plain,), _ = decode(hipnuc.encode(sent[0]))
    assert (plain.sensor, plain.temperature) == (0, 25.0)
    (older,), _ = decode(hipnuc.encode(sent[0], node_ids=True), node_ids=True)
    assert (older.sensor, older.temperature) == (5, None)
    same([older], [sent[0]._replace(temperature=None)])


def test_round_trip_91():
    sent = stream(5)
    same(decode(b"".join(map(hipnuc.encode, sent)))[0], sent)
    (bare,), _ = decode(hipnuc.encode(sent[0]._replace(mag=None, temperature=None, time_us=None)))
    assert bare.mag is None
    assert (bare.time_us, bare.temperature) == (0, 0)
    (late,), _ = decode(hipnuc.encode(sent[0]._replace(time_us=HipnucDecoder.WRAP_US + 7000)))
    assert late.time_us == 7000
    with pytest.raises(ValueError, match="quaternion, acceleration and angular rate are required"):
        hipnuc.encode(Sample(0))


@pytest.mark.parametrize("nodes", [0, 1, 6, 16])
def test_round_trip_of_wireless_nodes(nodes):
    sent = [stream(1, sensor=i)[0]._replace(temperature=None) for i in range(nodes)]
    samples, counters = decode(hipnuc.encode_nodes(sent, gateway=3))
    same(samples, sent)
    assert counters.skipped == (not nodes)


def test_bad_node_costs_no_other():
    sent = [stream(1, sensor=i)[0]._replace(temperature=None) for i in range(3)]
    payload = bytearray(hipnuc.encode_nodes(sent)[6:])
    payload[8 + 76 : 8 + 2 * 76] = bytes([0x91, 1]) + bytes(74)
    samples, counters = decode(hipnuc.encode_frame(bytes(payload)))
    same(samples, [sent[0], sent[2]])
    assert (counters.packets, counters.bad) == (2, 1)


@given(st.lists(st.booleans(), min_size=6, max_size=6), st.booleans())
@settings(max_examples=40, deadline=None)
def test_round_trip_of_fields(keep, node_ids):
    (full,) = stream(1, sensor=9)
    gone = {n: None for n, k in zip(Sample._fields[1:], keep, strict=True) if not k}
    sent = full._replace(**gone, sensor=9 if node_ids else 0)
    samples, counters = decode(hipnuc.encode_fields(sent, node_ids=node_ids))
    if sent.quat is None and sent.acc is None:
        assert (samples, counters.skipped) == ([], 1)
    else:
        same(samples, [sent])


def test_round_trip_of_items():
    sent = [s._replace(time_us=None) for s in stream(5, sensor=77)]
    same(decode(b"".join(map(hipnuc.encode_items, sent)))[0], sent, abs=0.01)


@pytest.mark.parametrize("counted", [True, False])
def test_round_trip_of_old_receiver(counted):
    sent = [stream(1, sensor=i, mag=False)[0]._replace(time_us=None, temperature=None) for i in (0, 1, 4)]
    payload = hipnuc.encode_tables(sent)[6:]
    # Without the item that says how many nodes there are, the length tells.
    samples, _ = decode(hipnuc.encode_frame(payload if counted else payload[4:]))
    same(samples, sent, abs=0.01)


def test_angles_in_place_of_quaternions():
    angles = struct.pack("<3h", -4500, 3000, 600)  # pitch -45, roll 30, yaw 60
    floats = struct.pack("<3f", -45, 30, 60)
    q = decode(hipnuc.encode_frame(b"\xd0" + angles))[0][0].quat
    assert rotated(q, (1, 0, 0)) == pytest.approx([math.sqrt(1 / 8), math.sqrt(3 / 8), math.sqrt(1 / 2)])
    assert rotated(q, (0, 1, 0))[2] == pytest.approx(math.sqrt(1 / 8))  # cos(pitch) sin(roll)
    assert decode(hipnuc.encode_frame(b"\xd9" + floats))[0][0].quat == pytest.approx(q)
    # The quaternion is the better one.
    both = hipnuc.encode_frame(b"\xd0" + angles + b"\xd1" + struct.pack("<4f", 1, 0, 0, 0))
    assert decode(both)[0][0].quat == (1, 0, 0, 0)
    (node,), _ = decode(hipnuc.encode_frame(b"\x61\0\1\1\x72" + angles))
    assert node.quat == pytest.approx(q)


BLOCK = hipnuc.encode(stream(1)[0])[6:]


@pytest.mark.parametrize(
    "payload",
    [
        BLOCK[:12] + struct.pack("<f", math.nan) + BLOCK[16:],
        BLOCK[:24] + struct.pack("<2f", math.inf, -math.inf) + BLOCK[32:],
        BLOCK[:12] + struct.pack("<f", 2e6) + BLOCK[16:],  # in g
        BLOCK[:60] + bytes(16),
        BLOCK[:60] + struct.pack("<4f", 1.2, 0, 0, 0),
        BLOCK[:60] + struct.pack("<4f", math.nan, 0, 0, 0),
        BLOCK + BLOCK[:-1],
        b"\xa0" + bytes(5),
        b"\xd1" + bytes(16),
        b"\xd9" + struct.pack("<3f", math.nan, 0, 0),
        struct.pack("<BHBI", 0x83, 0, 0, 1) + bytes(11),
        struct.pack("<BHBIf", 0x83, 0, 0, 0x100, math.inf),
        b"\x83\0",
        b"\x61\0\0\0",
    ],
)
def test_impossible_content(payload):
    samples, counters = decode(hipnuc.encode_frame(payload) + hipnuc.encode(stream(1)[0]))
    same(samples[-1:], stream(1))
    assert (counters.bad, counters.resyncs, counters.skipped) == (1, 0, 0)
    assert len(samples) == counters.packets


@pytest.mark.parametrize(
    "payload",
    [
        b"\x81" + bytes(103),
        b"\x99abc",
        b"\x90\x07",
        b"\xf0" + bytes(4),
        struct.pack("<BHBI", 0x83, 0, 0, 1 << 25) + bytes(8),
        b"\x71" + bytes(7),
        b"\x61\0\0\1\x99",
    ],
)
def test_unknown_content_is_skipped(payload):
    samples, counters = decode(hipnuc.encode_frame(payload) + hipnuc.encode(stream(1)[0]))
    same(samples, stream(1))
    assert (counters.bad, counters.skipped) == (0, 1)


# --- bad lines ------------------------------------------------------------------------------------

ENCODERS = [
    hipnuc.encode,
    hipnuc.encode_items,
    hipnuc.encode_fields,
    lambda sample: hipnuc.encode_nodes([sample, sample._replace(sensor=1)]),
]


@given(st.integers(0, 2**32))
@settings(max_examples=50, deadline=None)
def test_any_chunking(in_pieces, seed):
    rng = random.Random(seed)
    data = b""
    for sample in stream(6):
        data += rng.choice(ENCODERS)(sample)
        data += rng.choice([b"", b"", rng.randbytes(200), b"\x5a", b"\x5a\xa5\x4c\x00", data[-60:-20]])
    in_pieces(HipnucDecoder, data, rng.choices([1, 2, 7, 64, 200], k=len(data)))


def test_noise_costs_no_packet():
    rng = random.Random(1)
    for length in (1, 2, 5, 81, 82, 83, 1000):
        sent = stream(20)
        data = b"".join(rng.randbytes(length) + hipnuc.encode(s) for s in sent)
        samples, counters = decode(data)
        same(samples, sent)
        assert counters.bad == counters.resyncs == 20


def test_false_starts_and_lengths_cost_no_packet():
    sent = stream(3)
    frames = list(map(hipnuc.encode, sent))
    for false in (
        "5a",
        "5aa5",
        "5aa54c00",
        "5aa5ffff",
        "5aa50002000091",
        "5aa5c804000062000f",
        "5aa54c00112291",
    ):
        data = bytes.fromhex(false).join([b"", *frames])
        samples, counters = decode(data + bytes(1300))
        same(samples, sent)
        assert counters.resyncs == 3


def test_a_false_start_holds_up_nothing_for_long():
    # Without the plausibility of the tag, these would wait for up to 64 kB.
    for false in ("5aa5ffff00000000", "5aa5c804000062000f", "5aa50100010091"):
        frame = hipnuc.encode(stream(1)[0])
        samples, _ = decode(bytes.fromhex(false) + frame * 8)
        assert len(samples) >= 1


def test_every_flipped_bit_costs_one_packet():
    sent = stream(3)
    first, good, third = map(hipnuc.encode, sent)
    for bit in range(8 * len(good)):
        broken = bytearray(good)
        broken[bit // 8] ^= 1 << bit % 8
        # A longer false length can hold up what follows, so let something follow.
        samples, counters = decode(first + bytes(broken) + third + bytes(1300))
        same(samples, [sent[0], sent[2]])
        assert counters.resyncs == 1


def test_every_truncation_costs_one_packet():
    sent = stream(3)
    first, good, third = map(hipnuc.encode, sent)
    for keep in range(1, len(good)):
        samples, _ = decode(first + good[:keep] + third + bytes(100))
        same(samples, [sent[0], sent[2]])
        samples, _ = decode(first + good[keep:] + third)
        same(samples, [sent[0], sent[2]])


@given(st.lists(st.binary(max_size=120), max_size=8))
@settings(max_examples=100, deadline=None)
def test_random_bytes_never_raise(chunks):
    decoder = HipnucDecoder()
    for chunk in chunks:
        decoder.feed(chunk)
        assert len(decoder._rest) <= 6 + 8 + 16 * 76
    assert decoder.counters.bytes == sum(map(len, chunks))


TAGS = [0x61, 0x62, 0x71, 0x72, 0x75, 0x83, 0x90, 0x91, 0xA0, 0xB0, 0xC0, 0xD0, 0xD1, 0xD9, 0xE0, 0xF0]


@given(st.lists(st.tuples(st.sampled_from(TAGS), st.binary(max_size=80)), min_size=1, max_size=4))
@settings(max_examples=200, deadline=None)
def test_random_payloads_never_raise(parts):
    payload = b"".join(bytes([tag]) + rest for tag, rest in parts)
    for node_ids in (False, True):
        samples, _ = decode(hipnuc.encode_frame(payload), node_ids=node_ids)
        for sample in samples:
            assert all(math.isfinite(x) for v in sample[2:6] if v is not None for x in v)


# --- CAN ------------------------------------------------------------------------------------------

BUSES = {
    "canopen": (HipnucCanopenDecoder, hipnuc_can.encode_canopen, ("acc", "gyr", "quat")),
    "j1939": (HipnucJ1939Decoder, hipnuc_can.encode_j1939, ("acc", "gyr", "mag", "temperature", "quat")),
}


def cut_to(samples, names):
    return [Sample(s.sensor, **{name: getattr(s, name) for name in names}) for s in samples]


@pytest.fixture(params=BUSES)
def bus(request):
    return BUSES[request.param]


def test_can_round_trip_of_several_nodes(bus):
    make, encode, names = bus
    sent = [stream(1, sensor=s)[0] for _ in range(5) for s in (1, 8, 64)]
    # Frames of different nodes come mixed: by identifier, as on a busy bus.
    frames = []
    for start in range(0, len(sent), 3):
        frames += sorted(f for s in sent[start : start + 3] for f in encode(s))
    decoder = make()
    got = run(decoder, frames)
    same(sorted(got, key=lambda s: s.sensor), sorted(cut_to(sent, names), key=lambda s: s.sensor), abs=0.03)
    assert (decoder.counters.packets, decoder.counters.lost, decoder.counters.bad) == (15, 0, 0)


def test_a_lost_can_frame_never_mixes_cycles(bus):
    make, encode, names = bus
    sent = stream(6, sensor=3)
    cycles = [encode(s) for s in sent]
    for index in range(len(cycles[2])):
        frames = [f for i, c in enumerate(cycles) for j, f in enumerate(c) if (i, j) != (2, index)]
        decoder = make()
        samples = run(decoder, frames)
        whole = cut_to([s for i, s in enumerate(sent) if i != 2], names)
        same(samples, whole, abs=0.03)
        assert decoder.counters.lost == 1


def test_slow_can_quantities():
    sent = stream(40, sensor=3)
    decoder = HipnucJ1939Decoder()
    frames = []
    for i, sample in enumerate(sent):
        rare = {} if i % 10 == 5 else {"temperature": None}
        half = {} if i % 2 else {"mag": None}
        frames += hipnuc_can.encode_j1939(sample._replace(**rare, **half))
    samples = run(decoder, frames)
    assert (len(samples), decoder.counters.lost) == (40, 0)
    assert [s.temperature is not None for s in samples].count(True) == 4
    assert [s.mag is not None for s in samples] == [i % 2 == 1 for i in range(40)]


# Not 3, 6, 9 of three quantities and 5 of five: nothing on the bus shows the loss of as many frames as cycles
# have.
@pytest.mark.parametrize(
    ("name", "count"),
    [
        *(("canopen", count) for count in (2, 4, 5, 7, 8)),
        *(("j1939", count) for count in (2, 3, 4, 6, 7, 8, 9)),
    ],
)
def test_lost_can_frames_in_a_row_never_mix_cycles(name, count):
    make, encode, names = BUSES[name]
    sent = stream(8, sensor=3)
    frames = [f for s in sent for f in encode(s)]
    for start in range(3 * len(names), 4 * len(names)):
        decoder = make()
        samples = run(decoder, frames[:start] + frames[start + count :])
        for sample in samples:
            i = round(sample.acc[0] * 64 / STANDARD_G)
            for name in set(names) - {"acc"}:
                value = getattr(sample, name)
                assert value is None or value == pytest.approx(getattr(sent[i], name), abs=0.03)


def test_can_start_in_the_middle_is_no_loss(bus):
    make, encode, names = bus
    frames = [f for s in stream(3, sensor=3) for f in encode(s)]
    for start in range(1, len(names)):
        decoder = make()
        assert len(run(decoder, frames[start:])) == 2
        assert decoder.counters.lost == 0


def test_bad_can_quaternion(bus):
    make, encode, _ = bus
    (good,) = stream(1, sensor=3)
    frames = encode(good)
    decoder = make()
    zero = (frames[-1][0], bytes(8), frames[-1][2])
    assert run(decoder, [*frames[:-1], zero]) == []
    assert run(decoder, [(can_id, data[:5], extended) for can_id, data, extended in frames[:2]]) == []
    assert (decoder.counters.bad, decoder.counters.lost) == (3, 0)
    assert len(run(decoder, frames)) == 1
    assert decoder.counters.resyncs == 1


def test_other_frames_on_the_bus_are_skipped():
    decoder = HipnucCanopenDecoder()
    for can_id in (0, 0x080, 0x180, 0x1C1, 0x1FF, 0x388, 0x588, 0x688, 0x708, 0x788, 0x7E5):
        assert decoder.feed(can_id, bytes(8)) == []
    assert decoder.feed(0x188, bytes(6), True) == []
    assert decoder.counters.skipped == 12
    decoder = HipnucJ1939Decoder()
    for can_id in (0x0CFF2F08, 0x0CFF3D08, 0x0CFEF108, 0x0DFF3408, 0x0CFF34FE, 0x0CEF5508):
        assert decoder.feed(can_id, bytes(8), True) == []
    assert decoder.feed(0x734, bytes(8), False) == []
    assert decoder.counters.skipped == 7


def test_j1939_layout():
    decoder = HipnucJ1939Decoder()
    frames = [
        (0x0CFF3408, "000800f800040000"),
        (0x18FF3708, "004000c048010000"),  # the priority does not matter
        (0x0CFF3A08, "004000c000200000"),
        (0x0CFF4308, "e6090000e7030000"),
        (0x0CFF4208, "1027000000000000"),  # the other number of the quaternion
    ]
    (sample,) = run(decoder, [(can_id, bytes.fromhex(data), True) for can_id, data in frames])
    expected = Sample(
        8,
        None,
        (1.0, 0.0, 0.0, 0.0),
        (STANDARD_G, -STANDARD_G, STANDARD_G / 2),
        (math.radians(1000), -math.radians(1000), 0.34940673),
        (500.0, -500.0, 250.0),
        25.34,
    )
    same([sample], [expected])


def test_can_fd_frames():
    sent = [s._replace(mag=None, temperature=None) for s in stream(4, sensor=3)]
    decoder = HipnucJ1939Decoder()
    frames = [hipnuc_can.encode_j1939_fd(s, 254 + i) for i, s in enumerate(sent)]
    assert {len(data) for _, data, _ in frames} == {64}
    same(run(decoder, frames[:1] + frames[2:]), sent[:1] + sent[2:])
    assert (decoder.counters.lost, decoder.counters.restarts) == (1, 0)
    run(decoder, [hipnuc_can.encode_j1939_fd(sent[0], 200)])
    assert decoder.counters.restarts == 1
    with pytest.raises(ValueError, match="too much data"):
        hipnuc_can.encode_j1939_fd(stream(1)[0])
    can_id, data, _ = frames[0]
    assert decoder.feed(can_id, data[:48], True) == []
    assert decoder.feed(can_id, data[:6], True) == []
    assert decoder.counters.bad == 2
    assert decoder.feed(can_id, b"\x00\x02" + data[2:], True) == []
    assert decoder.feed(can_id, bytes(8), True) == []
    assert decoder.counters.skipped == 2


@given(
    st.lists(
        st.tuples(
            st.sampled_from([0x181, 0x281, 0x481, 0x0CFF3401, 0x0CFF4601, 0x0CFF5B01])
            | st.integers(0, 2**29 - 1),
            st.binary(max_size=64),
            st.booleans(),
        ),
        max_size=12,
    )
)
@settings(max_examples=150, deadline=None)
def test_random_can_frames_never_raise(frames):
    for decoder in (HipnucCanopenDecoder(), HipnucJ1939Decoder()):
        run(decoder, frames)
        assert decoder.counters.bytes == sum(len(data) for _, data, _ in frames)
