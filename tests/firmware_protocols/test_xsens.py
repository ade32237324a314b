"""Xsens Xbus and MTi-600 CAN: recorded packets, round trips, losses."""

import json
import math
import random
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocols.rotation import rotate
from firmware_protocols.sample import Sample, z_up
from firmware_protocols.xsens import FRAMES, MTDATA2, XbusDecoder, encode_mtdata2, encode_xbus, mtdata2_items
from firmware_protocols.xsens_can import MTI600_IDS, Mti600CanDecoder, encode_mti600

DATA = Path(__file__).parents[1] / "data" / "protocols"
VECTORS = {v["id"]: v for v in json.loads((DATA / "xsens.json").read_text())}
SERIAL = [v for v in VECTORS.values() if v["hex"].startswith("fa")]


def matrix(quat):
    """Rotation matrix, row after row."""
    columns = [rotate(quat, axis) for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
    return [column[i] for i in range(3) for column in columns]


def angle(a, b):
    """Radians between two orientations, if small."""
    return 2 * min(math.dist(a, b), math.dist(a, [-x for x in b]))


def decode_whole(line, decoder=None):
    """Samples of a line that ends here."""
    decoder = decoder or XbusDecoder()
    return [*decoder.feed(line), *decoder.flush()]


def payloads(stream):
    """Payloads of back to back frames with short lengths."""
    while stream:
        assert stream[0] == 0xFA
        yield stream[4 : 4 + stream[3]]
        stream = stream[5 + stream[3] :]


def unit(rng):
    q = [rng.gauss(0, 1) for _ in range(4)]
    return tuple(x / math.hypot(*q) for x in q)


def samples(n, sensor=0):
    rng = random.Random(n)
    return [
        Sample(
            sensor,
            1_000_000 + 10_000 * i,
            unit(rng),
            (rng.uniform(-50, 50), 1.5, 9.81),
            (0.1, -0.2, rng.uniform(-9, 9)),
            (0.5, -0.25, 1.0),
            25.5,
        )
        for i in range(n)
    ]


def agree(a, b, tolerance):
    assert a.sensor == b.sensor
    assert a.time_us == b.time_us
    assert angle(a.quat, b.quat) < max(10 * tolerance, 1e-6)
    for x, y in zip(a[3:6], b[3:6], strict=True):
        assert x == pytest.approx(y, abs=tolerance)
    assert a.temperature == pytest.approx(b.temperature, abs=tolerance)


# --- recorded -------------------------------------------------------------------------------------


@pytest.mark.parametrize("vector", SERIAL, ids=lambda v: v["id"])
def test_every_item_of_a_recorded_packet(vector):
    (payload,) = payloads(bytes.fromhex(vector["hex"]))
    items = dict(mtdata2_items(payload))
    for name, expected in vector["expect"].items():
        values = items[int(name, 16)]
        if name == "1010":
            ns, year, *rest = values
            assert ns.to_bytes(4, "big") + year.to_bytes(2, "big") + bytes(rest) == bytes.fromhex(expected)
        elif isinstance(expected, int):
            assert values == (expected,)
        else:
            assert values == pytest.approx(expected, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("vector", SERIAL, ids=lambda v: v["id"])
def test_sample_of_a_recorded_packet(vector):
    decoder = XbusDecoder()
    (sample,) = decode_whole(bytes.fromhex(vector["hex"]), decoder)
    expect = vector["expect"]
    assert decoder.counters.packets == 1
    assert decoder.counters.bad == decoder.counters.skipped == 0
    assert sample.sensor == 0
    assert sample.time_us == (expect["1060"] * 100 if "1060" in expect else None)
    for value, ids in (
        (sample.acc, ("4020", "4021")),
        (sample.gyr, ("8020", "8021")),
        (sample.mag, ("C020", "C021", "C023")),
    ):
        given = [expect[i] for i in ids if i in expect]
        if given:
            assert value == pytest.approx(given[0], rel=1e-6)
        elif not any(i.startswith(ids[0][:3]) for i in expect):
            assert value is None
    if "2010" in expect:
        assert angle(sample.quat, expect["2010"]) < 1e-6
    assert (sample.temperature is None) == (not any(i.startswith("081") for i in expect))


@pytest.mark.parametrize("name", ["xsens_full", "xsens_shake"])
def test_free_acceleration_is_velocity_increment_without_gravity(name):
    vector = VECTORS[name]
    (sample,) = XbusDecoder().feed(bytes.fromhex(vector["hex"]))
    # Increments of 2.5 ms; the device works on with these, while the acceleration has another filter.
    local = rotate(sample.quat, [dv * 400 for dv in vector["expect"]["4010"]])
    free = vector["expect"]["4030"]
    assert local[:2] == pytest.approx(free[:2], abs=1e-4)
    assert local[2] - free[2] == pytest.approx(9.79716, abs=1e-4)
    assert rotate(sample.quat, sample.acc)[:2] == pytest.approx(free[:2], rel=0.02, abs=0.01)


def test_euler_angles_of_a_still_sensor():
    for name in ("xsens_g710_f32", "xsens_g710_fp1220"):
        (sample,) = XbusDecoder().feed(bytes.fromhex(VECTORS[name]["hex"]))
        assert rotate(sample.quat, sample.acc) == pytest.approx([0, 0, 9.8], abs=0.1)


def test_matrix_is_sent_by_columns():
    (sample,) = XbusDecoder().feed(bytes.fromhex(VECTORS["xsens_rotmat_fp1632"]["hex"]))
    sent = VECTORS["xsens_rotmat_fp1632"]["expect"]["2022"]
    columns = sent[0::3] + sent[1::3] + sent[2::3]
    assert matrix(sample.quat) == pytest.approx(columns, abs=1e-6)


FIELDS = {
    "PacketCounter": 0x102,
    "SampleTimeFine": 0x106,
    "UTCTime": 0x101,
    "StatusWord": 0xE02,
    "StatusByte": 0xE01,
    "EulerAngles": 0x203,
    "Acceleration": 0x402,
    "DeltaV": 0x401,
    "RateOfTurn": 0x802,
    "DeltaQ": 0x803,
    "LatLon": 0x504,
    "AltitudeEllipsoid": 0x502,
    "VelocityXYZ": 0xD01,
    "GNSSPVTData": 0x701,
}


def golden(text):
    """Fields of each packet by type: name with its options, lines."""
    for block in text.strip().split("\n\n"):
        packet, name = {}, ""
        for line in block.splitlines():
            if line.startswith(" "):
                packet[name].append(line.strip())
            else:
                name = line.rstrip(":")
                packet[name] = []
        yield packet


@pytest.mark.parametrize("number", [1, 2])
def test_whole_recording(number):
    stream = (DATA / f"xsens-mtig710-{number}.bin").read_bytes()
    expected = list(golden((DATA / f"xsens-mtig710-{number}.golden.txt").read_text()))
    recorded = list(payloads(stream))
    assert len(recorded) == len(expected) == 100
    compared = 0
    for payload, packet in zip(recorded, expected, strict=True):
        items = {item >> 4: (item, values) for item, values in mtdata2_items(payload)}
        for name, lines in packet.items():
            item, values = items[FIELDS[name.split("(")[0]]]
            if name == "UTCTime":
                ns, *date, _ = values
                fraction = f".{ns:09}".rstrip("0").rstrip(".")
                assert lines == ["{}-{:02}-{:02}T{:02}:{:02}:{:02}{}Z".format(*date, fraction)]
            elif name.startswith("Status"):
                assert values == (int(lines[0], 2),)
            elif name == "GNSSPVTData":  # not needed for a sample, so its layout is not known here
                assert f"ITOW:{int.from_bytes(values[:4], 'big')}" in lines
            else:
                assert item & 3 == ("FP1220" in name)
                assert item >> 2 & 3 == 0  # ENU or none
                assert [float(line.split(":")[-1]) for line in lines] == pytest.approx(
                    list(values), rel=1e-15
                )
            compared += 1
    assert compared > 900

    decoder = XbusDecoder()
    result = decoder.feed(stream)
    counters = decoder.counters
    assert (counters.packets, counters.skipped, counters.bad, counters.lost) == (96, 4, 0, 0)
    assert [s.time_us // 100 for s in result] == [int(p["SampleTimeFine"][0]) for p in expected if len(p) > 4]
    still = [rotate(s.quat, s.acc) for s in result if s.quat]
    assert len(still) == 95
    assert all(v == pytest.approx([0, 0, 9.8], abs=0.15) for v in still[1:])


# --- encoder and decoder --------------------------------------------------------------------------


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("orientation", ["quaternion", "matrix", "euler"])
@pytest.mark.parametrize(
    ("number_format", "tolerance"), [("f32", 1e-5), ("fp12.20", 1e-6), ("fp16.32", 1e-9), ("f64", 1e-12)]
)
def test_round_trip(number_format, tolerance, orientation, frame):
    decoder = XbusDecoder()
    for i, sample in enumerate(samples(20)):
        line = encode_mtdata2(
            sample, 65530 + i, number_format=number_format, frame=frame, orientation=orientation
        )
        (result,) = decoder.feed(line)
        agree(result, sample, tolerance)
    assert decoder.counters.packets == 20
    assert decoder.counters.lost == decoder.counters.bad == 0


def test_frame_is_on_the_wire():
    sample = Sample(0, 0, (0.5, 0.5, -0.5, 0.5))
    sent = {}
    for frame in FRAMES:
        (payload,) = payloads(encode_mtdata2(sample, 0, frame=frame))
        sent[frame] = {item: v for item, v in mtdata2_items(payload) if item >> 12 == 2}
    assert list(sent["ENU"]) == [0x2010]
    assert list(sent["NED"]) == [0x2014]
    assert list(sent["NWU"]) == [0x2018]
    assert sent["NWU"][0x2018] == sent["ENU"][0x2010] == sample.quat
    assert sent["NED"][0x2014] == pytest.approx(z_up(sample.quat))


def test_long_packet():
    many = b"".join(b"\xc0\x20\x0c" + bytes(12) for _ in range(30))
    line = encode_xbus(MTDATA2, many + b"\x10\x20\x02\x00\x07")
    assert line[3] == 0xFF
    (sample,) = decode_whole(line)
    assert sample.mag == (0, 0, 0)


def test_sensors_behind_a_master():
    decoder = XbusDecoder()
    result = []
    for i in range(10):
        for sensor in (1, 2, 3):
            if (i, sensor) != (5, 2):
                result += decoder.feed(encode_mtdata2(Sample(sensor, i * 10_000, (1.0, 0, 0, 0)), i))
    assert [s.sensor for s in result].count(2) == 9
    assert decoder.counters.lost == 1
    assert decoder.counters.packets == 29


def test_counter_and_clock_wrap():
    decoder = XbusDecoder()
    start = decoder.WRAP_US - 50_000
    for i in range(10):
        decoder.feed(encode_mtdata2(Sample(0, (start + i * 10_000), (1.0, 0, 0, 0)), 65533 + i))
    assert decoder.counters.packets == 10
    assert decoder.counters.lost == decoder.counters.restarts == decoder.counters.late == 0


def test_repeated_packets_and_a_restart():
    decoder = XbusDecoder()
    lines = [encode_mtdata2(s, i) for i, s in enumerate(samples(6))]
    assert len(decoder.feed(b"".join([*lines, lines[5], lines[3]]))) == 6
    assert decoder.counters.late == 2
    assert decode_whole(encode_mtdata2(Sample(0, 200, (1.0, 0, 0, 0)), 40_000), decoder)
    assert decoder.counters.restarts == 1
    assert decoder.counters.lost == 0


def test_other_messages_are_skipped():
    decoder = XbusDecoder()
    assert not decoder.feed(bytes.fromhex("FAFF3100D0 FAFF1100F0 FAFF420103BB"))
    assert decoder.counters.skipped == 3
    assert decoder.counters.bad == 0


@pytest.mark.parametrize("quat", [(0.0, 0, 0, 0), (math.nan, 0, 0, 0), (0.3, 0, 0, 0), (math.inf, 0, 0, 0)])
def test_no_orientation_is_invented(quat):
    decoder = XbusDecoder()
    (sample,) = decode_whole(encode_mtdata2(Sample(0, 0, quat, (1.0, 2.0, 3.0)), 1), decoder)
    assert sample.quat is None
    assert sample.acc == (1, 2, 3)
    assert not decoder.feed(encode_mtdata2(Sample(0, 100, quat, (math.nan, 0, 0)), 2))
    assert decoder.counters.skipped == 1


def test_needed_item_of_wrong_size():
    decoder = XbusDecoder()
    assert not decoder.feed(encode_xbus(MTDATA2, b"\x20\x10\x04\x3f\x80\x00\x00"))
    assert decoder.counters.bad == 1


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.sampled_from([0x810, 0x1020, 0x2010, 0x2020, 0x2030, 0x4020, 0xC020]),
                          st.integers(0, 15), st.binary(max_size=40))))  # fmt: skip
def test_any_items_with_a_good_checksum(items):
    payload = b"".join((kind | low).to_bytes(2, "big") + bytes([len(d)]) + d for kind, low, d in items)
    decoder = XbusDecoder()
    decode_whole(encode_xbus(MTDATA2, payload), decoder)
    assert decoder.counters.packets + decoder.counters.skipped + decoder.counters.bad == 1
    for item, _ in mtdata2_items(payload):
        assert 0 <= item <= 0xFFFF


def test_what_cannot_be_sent():
    with pytest.raises(ValueError, match="format"):
        encode_mtdata2(Sample(0), 0, number_format="f16")
    with pytest.raises(ValueError, match="orientation"):
        encode_mtdata2(Sample(0, None, (1.0, 0, 0, 0)), 0, orientation="axis")
    with pytest.raises(ValueError, match="cannot send"):
        encode_mtdata2(Sample(0, None, None, (3000.0, 0, 0)), 0, number_format="fp12.20")
    with pytest.raises(ValueError, match="sensor"):
        encode_mtdata2(Sample(200), 0)
    with pytest.raises(ValueError, match="2048"):
        encode_xbus(MTDATA2, bytes(3000))
    with pytest.raises(ValueError, match="fill"):
        list(mtdata2_items(b"\x20\x10\x10\x00"))


# --- messages that are split ----------------------------------------------------------------------


def split(sample, first_count, second_count, parts=(("quat",), ("acc", "gyr"))):
    """The quantities of a sample in messages of their own."""
    counts = [first_count, *[second_count] * (len(parts) - 1)]
    return [
        encode_mtdata2(Sample(0, sample.time_us)._replace(**{n: getattr(sample, n) for n in names}), count)
        for names, count in zip(parts, counts, strict=True)
    ]


@pytest.mark.parametrize(("own_counts", "timed"), [(False, True), (False, False), (True, True)])
@pytest.mark.parametrize("parts", [(("quat",), ("acc", "gyr")), (("acc", "gyr"), ("quat",))])
def test_messages_of_one_instant_are_one_sample(own_counts, timed, parts):
    sent = [s if timed else s._replace(time_us=None) for s in samples(20)]
    decoder = XbusDecoder()
    got = []
    for i, sample in enumerate(sent):
        counts = (2 * i, 2 * i + 1) if own_counts else (i, i)
        got += [decoder.feed(line) for line in split(sample, *counts, parts)]
    assert [len(part) for part in got] == [0, 1] * 20  # complete with the last of its messages
    for sample, (result,) in zip(sent, got[1::2], strict=True):
        agree(result, sample._replace(mag=None, temperature=None), 1e-5)
    counters = decoder.counters
    assert (counters.packets, counters.late, counters.lost, counters.bad) == (20, 0, 0, 0)


def test_a_lost_part_costs_its_sample_alone():
    lines = [line for i, s in enumerate(samples(20)) for line in split(s, i, i)]
    del lines[20]  # an orientation
    got = decode_whole(b"".join(lines))
    assert [s.quat is None for s in got] == [i == 10 for i in range(20)]
    assert all(s.acc is not None for s in got)
    assert [s.time_us for s in got] == [s.time_us for s in samples(20)]


def test_three_messages_and_one_that_is_new():
    parts = (("quat",), ("acc", "gyr"), ("mag",))
    sent = [s._replace(mag=(0.1, 0.2, 0.3)) for s in samples(10)]
    got = decode_whole(b"".join(line for i, s in enumerate(sent) for line in split(s, i, i, parts)))
    # That the field follows is known from the second instant on.
    assert [s.time_us for s in got] == [s.time_us for s in sent]
    assert [s.mag is not None for s in got] == [False] + [True] * 9


def test_orientation_alone_is_not_delayed():
    decoder = XbusDecoder()
    got = [decoder.feed(encode_mtdata2(Sample(0, 10_000 * i, (1.0, 0, 0, 0)), i)) for i in range(5)]
    assert [len(part) for part in got] == [0, 2, 1, 1, 1]


# --- CAN ------------------------------------------------------------------------------------------


def feed(decoder, messages):
    return [s for can_id, data in messages for s in decoder.feed(can_id, data)]


def test_can_scales():
    values = {"quat": "xsens_can_quat", "gyr": "xsens_can_gyr", "acc": "xsens_can_acc"}
    decoder = Mti600CanDecoder()
    result = []
    for _ in range(2):
        for name in values.values():
            vector = VECTORS[name]
            result += decoder.feed(int(vector["expect"]["can_id"], 16), bytes.fromhex(vector["hex"]))
    (sample,) = result
    for kind, name in values.items():
        assert getattr(sample, kind) == pytest.approx(VECTORS[name]["expect"]["value"])


@pytest.mark.parametrize("byte_order", ["big", "little"])
@pytest.mark.parametrize("euler", [False, True])
@pytest.mark.parametrize("frame", FRAMES)
def test_can_round_trip(byte_order, euler, frame):
    decoder = Mti600CanDecoder(byte_order, frame=frame)
    sent = [s._replace(mag=(0.5, -0.25, 1.0)) for s in samples(30)]
    result = []
    for i, sample in enumerate(sent):
        result += feed(
            decoder, encode_mti600(sample, 65520 + i, byte_order=byte_order, euler=euler, frame=frame)
        )
    # From the third on, a sample is out with its last awaited message, and what follows comes with the next.
    assert len(result) == 30
    for got, sample in zip(result, sent, strict=True):
        assert got.time_us == sample.time_us
        assert angle(got.quat, sample.quat) < 3e-4
        assert got.acc == pytest.approx(sample.acc, abs=2**-8)
        assert got.gyr == pytest.approx(sample.gyr, abs=2**-9)
        if got is not result[2]:
            assert got.mag == sample.mag
            assert got.temperature == sample.temperature
    assert decoder.counters.lost == decoder.counters.bad == 0


def test_can_wrong_byte_order_shows_in_gravity():
    messages = encode_mti600(Sample(0, 0, (1.0, 0, 0, 0), (0.0, 0.0, 9.81)), 0)
    (sample,) = feed(Mti600CanDecoder("little"), messages + messages)
    assert abs(math.hypot(*sample.acc) - 9.81) > 3


@pytest.mark.parametrize("kept", [("time",), ("counter",), ("time", "counter"), ()])
def test_can_lost_messages_do_not_mix_samples(kept):
    drop = {"time", "counter"} - set(kept)
    ids = {kind: can_id for kind, can_id in MTI600_IDS.items() if kind not in drop}
    rng = random.Random(5)
    decoder = Mti600CanDecoder(ids={0: ids})
    sent, result, gone = [], [], 0
    for i in range(400):
        # The index is in every quantity: they have to agree in whatever comes out.
        sent.append(Sample(0, i * 10_000, (1.0, 0, 0, 0), (i / 8, 0.0, 0.0), (i / 16, 0.0, 0.0)))
        messages = [m for m in encode_mti600(sent[-1], i) if m[0] in ids.values()]
        if i > 3 and rng.random() < 0.2:
            del messages[rng.randrange(len(messages))]
            gone += 1
        result += feed(decoder, messages)
    assert gone > 50
    mixed = 0
    for sample in result:
        numbers = {round(sample.acc[0] * 8)} if sample.acc else set()
        numbers |= {round(sample.gyr[0] * 16)} if sample.gyr else set()
        numbers |= {sample.time_us // 10_000} if sample.time_us is not None else set()
        mixed += len(numbers) > 1
    # Without time and counter, the rest of a sample without its opener can fill a hole in the one before.
    assert mixed <= (0 if kept else 3)
    whole = [s for s in result if s.quat and s.acc and s.gyr]
    assert len(whole) >= 400 - gone - 2


def test_can_sensors_with_ids_of_their_own():
    ids = {s: {kind: i + 0x100 * s for kind, i in MTI600_IDS.items()} for s in (1, 2)}
    ids[3] = {kind: i + 0x10000 for kind, i in MTI600_IDS.items()}
    decoder = Mti600CanDecoder(ids=ids)
    result = []
    for i in range(20):
        messages = {
            s: encode_mti600(Sample(s, i * 10_000, (1.0, 0, 0, 0), (float(s), 0, 0)), i, ids=ids[s])
            for s in ids
        }
        for parts in zip(*messages.values(), strict=True):
            for can_id, data in parts:
                result += decoder.feed(can_id, data, extended=can_id > 0x7FF)
    assert {s: sum(r.sensor == s for r in result) for s in ids} == {1: 20, 2: 20, 3: 20}
    assert all(r.acc[0] == r.sensor for r in result)
    assert decoder.feed(0x121, bytes(8), extended=True) == []


def test_can_counts_losses_and_bad_messages():
    decoder = Mti600CanDecoder(time_unit_us=1)
    assert decoder.WRAP_US == 1 << 32
    for i in (0, 1, 2, 3, 6):
        feed(decoder, encode_mti600(Sample(0, i * 10_000, (1.0, 0, 0, 0)), i, time_unit_us=1))
    assert decoder.counters.lost == 2
    assert decoder.feed(0x021, b"\1\2") == []
    assert decoder.feed(0x021, bytes(8)) == []
    assert decoder.feed(0x3FF, bytes(8)) == []
    assert decoder.counters.bad == 2


@pytest.mark.parametrize(
    "options",
    [
        {"byte_order": "middle"},
        {"frame": "XYZ"},
        {"ids": {0: {"height": 3}}},
        {"ids": {0: {"quat": 3}, 1: {"acc": 3}}},
    ],
)
def test_can_options(options):
    with pytest.raises(ValueError, match=r"unknown|must be one of|twice"):
        Mti600CanDecoder(**options)


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from([*MTI600_IDS.values(), 0x7FF]), st.binary(max_size=8)), max_size=60)
)
def test_can_never_raises(messages):
    decoder = Mti600CanDecoder()
    for sample in feed(decoder, messages):
        assert sample[2:] != (None,) * 5
