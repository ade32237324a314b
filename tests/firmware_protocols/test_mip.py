"""MicroStrain MIP: recorded packets, units and frames, round trips, losses."""

import json
import math
import random
import struct
from pathlib import Path
from statistics import median

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocols.mip import (
    FILTER_SET,
    SENSOR_SET,
    MipDecoder,
    checksum,
    encode,
    encode_packet,
    fields,
)
from firmware_protocols.rotation import rotate, to_yaw_pitch_roll
from firmware_protocols.sample import STANDARD_G, Sample, z_up

DATA = Path(__file__).parents[1] / "data" / "protocols"
(VECTOR,) = json.loads((DATA / "mip.json").read_text())
CAPTURE = (DATA / "microstrain-mip.bin").read_bytes()


def matrix(quat):
    """Rotation matrix, row after row."""
    columns = [rotate(quat, axis) for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
    return [column[i] for i in range(3) for column in columns]


def packets(stream):
    while stream:
        assert stream[:2] == b"ue"
        yield stream[: 6 + stream[3]]
        stream = stream[6 + stream[3] :]


def test_recorded_packet():
    line = bytes.fromhex(VECTOR["hex"])
    for field, data in fields(line):
        expected = VECTOR["expect"][f"0x{field:x}"]
        if isinstance(expected, int):
            assert int.from_bytes(data, "big") == expected
        else:
            assert struct.unpack(">3f", data) == pytest.approx(expected, rel=1e-6)
    (sample,) = MipDecoder().feed(line)
    assert sample.time_us == 23_067_000
    assert sample.acc == pytest.approx([a * STANDARD_G for a in VECTOR["expect"]["0x4"]], rel=1e-6)
    assert sample.gyr == pytest.approx(VECTOR["expect"]["0x5"], rel=1e-6)
    assert sample.quat is sample.mag is sample.temperature is None


def test_recording():
    decoder = MipDecoder()
    result = decoder.feed(CAPTURE)
    lines = list(packets(CAPTURE))
    counters = decoder.counters
    assert counters.packets + counters.skipped == len(lines)
    assert counters.packets == len(result) == sum(line[2] in (0x80, 0x82) for line in lines)
    assert (counters.bad, counters.resyncs, counters.lost, counters.restarts) == (0, 0, 0, 0)
    kept = (line for line in lines if line[2] in (0x80, 0x82))
    for sample, line in zip(result, kept, strict=True):
        here = dict(fields(line))
        assert sample.time_us == (int.from_bytes(here[0xD5], "big") // 1000 if 0xD5 in here else None)
        sensor_set = line[2] == 0x80
        euler = here.get(0x0C if sensor_set else 0x05)
        if euler:
            angles = to_yaw_pitch_roll(z_up(sample.quat))
            assert angles[::-1] == pytest.approx(struct.unpack(">3f", euler[:12]), abs=1e-6)
        else:
            assert sample.quat is None
        for value, field, scale in ((sample.acc, 4, STANDARD_G), (sample.gyr, 5, 1), (sample.mag, 6, 100)):
            if sensor_set and field in here:
                assert value == pytest.approx([v * scale for v in struct.unpack(">3f", here[field])])
            else:
                assert value is None


def test_gravity_points_up():
    both = [s for s in MipDecoder([SENSOR_SET]).feed(CAPTURE) if s.quat and s.acc]
    assert len(both) > 100
    east, north, up = (median(axis) for axis in zip(*(rotate(s.quat, s.acc) for s in both), strict=True))
    assert up == pytest.approx(9.7, abs=0.15)
    assert math.hypot(east, north) < 0.5


def test_attitude_of_one_set():
    assert all(s.acc is None for s in MipDecoder([FILTER_SET]).feed(CAPTURE))
    both = MipDecoder().feed(CAPTURE)
    chosen = MipDecoder([SENSOR_SET]).feed(CAPTURE) + MipDecoder([FILTER_SET]).feed(CAPTURE)
    assert sorted(map(repr, chosen)) == sorted(map(repr, both))
    with pytest.raises(ValueError, match="sets"):
        MipDecoder([0x81])


def test_missing_packets_are_counted():
    lines = list(packets(CAPTURE))
    timed = [i for i, line in enumerate(lines) if line[2] == 0x80 and 0xD5 in dict(fields(line))]
    for i in (timed[200], timed[100], timed[101], timed[50]):
        lines[i] = b""
    decoder = MipDecoder()
    decoder.feed(b"".join(lines))
    assert decoder.counters.lost == 4
    decoder.feed(CAPTURE)
    assert decoder.counters.restarts == 2  # one in each set


def random_sample(rng):
    q = [rng.gauss(0, 1) for _ in range(4)]
    vector = [tuple(rng.uniform(-20, 20) for _ in range(3)) for _ in range(3)]
    return Sample(0, rng.randrange(1 << 50), tuple(x / math.hypot(*q) for x in q), *vector, 21.5)


@pytest.mark.parametrize("euler", [False, True])
@pytest.mark.parametrize("descriptor", [SENSOR_SET, FILTER_SET])
def test_round_trip(descriptor, euler):
    rng = random.Random(1)
    decoder = MipDecoder()
    for _ in range(50):
        sample = random_sample(rng)
        (result,) = decoder.feed(encode(sample, descriptor=descriptor, euler=euler))
        assert result.time_us == sample.time_us
        sign = math.copysign(1, sum(a * b for a, b in zip(result.quat, sample.quat, strict=True)))
        assert [sign * x for x in result.quat] == pytest.approx(sample.quat, abs=2e-5)
        for a, b in zip(result[3:6], sample[3:6], strict=True):
            assert a == pytest.approx(b, rel=1e-6, abs=1e-6)
        assert result.temperature == (21.5 if descriptor == SENSOR_SET else None)


def test_level_and_still_on_the_wire():
    level = Sample(0, 0, (1.0, 0, 0, 0), (0.0, 0.0, STANDARD_G))
    here = dict(fields(encode(level)))
    # Sensor Z up and X east: in NED a half turn about the line between north and east.
    assert struct.unpack(">4f", here[0x0A]) == pytest.approx((0, 0.5**0.5, 0.5**0.5, 0), abs=1e-6)
    assert struct.unpack(">3f", here[0x04]) == pytest.approx((0, 0, 1))
    # A device that is level by its own axes has Z down and reads -1 g.
    down = struct.pack(">3f", 0, 0, -1)
    (sample,) = MipDecoder().feed(encode_packet(0x80, [(0x04, down), (0x0A, struct.pack(">4f", 1, 0, 0, 0))]))
    assert rotate(sample.quat, sample.acc) == pytest.approx([0, 0, STANDARD_G])


@pytest.mark.parametrize(("descriptor", "field", "tail"), [(0x80, 0x09, b""), (0x82, 0x04, b"\0\1")])
def test_matrix_turns_ned_into_the_device_frame(descriptor, field, tail):
    quat = z_up(random_sample(random.Random(2)).quat)
    m = matrix(quat)  # device to NED by rows
    data = struct.pack(">9f", *m[0::3], *m[1::3], *m[2::3]) + tail
    (sample,) = MipDecoder().feed(encode_packet(descriptor, [(field, data)]))
    assert matrix(sample.quat) == pytest.approx(matrix(z_up(quat)), abs=1e-6)


def test_gps_time_where_there_is_no_reference_time():
    acc = (0x04, struct.pack(">3f", 0, 0, -1))
    gps = (0x12, struct.pack(">dHH", 345.6789, 2000, 3))
    (sample,) = MipDecoder().feed(encode_packet(0x80, [acc, gps]))
    assert sample.time_us == (2000 * 604_800 * 1_000_000) + 345_678_900
    (sample,) = MipDecoder().feed(encode_packet(0x80, [acc, gps, (0xD5, (7000).to_bytes(8, "big"))]))
    assert sample.time_us == 7
    (sample,) = MipDecoder().feed(encode_packet(0x80, [acc, (0x12, struct.pack(">dHH", math.nan, 0, 0))]))
    assert sample.time_us is None


def test_nothing_is_invented():
    decoder = MipDecoder()
    zero = struct.pack(">4f", 0, 0, 0, 0)
    assert not decoder.feed(encode_packet(0x80, [(0x0A, zero)]))
    assert not decoder.feed(encode_packet(0x80, [(0x04, struct.pack(">3f", math.nan, 0, 0))]))
    not_valid = struct.pack(">4fH", 1, 0, 0, 0, 0)
    assert not decoder.feed(encode_packet(0x82, [(0x03, not_valid)]))
    assert not decoder.feed(encode_packet(0x01, [(0xF1, b"\6\0")]))
    assert not decoder.feed(encode_packet(0x80, []))
    assert (decoder.counters.skipped, decoder.counters.bad) == (5, 0)
    assert not decoder.feed(encode_packet(0x80, [(0x04, b"\0")]))
    assert decoder.counters.bad == 1


@settings(max_examples=100, deadline=None)
@given(
    st.sampled_from([0x01, 0x80, 0x82]),
    st.lists(st.tuples(st.integers(0, 255), st.binary(max_size=40)), max_size=6),
)
def test_any_fields_with_a_good_checksum(descriptor, parts):
    decoder = MipDecoder()
    line = encode_packet(descriptor, parts)
    decoder.feed(line)
    assert decoder.counters.packets + decoder.counters.skipped + decoder.counters.bad == 1
    assert list(fields(line)) == parts


def test_what_cannot_be_sent():
    with pytest.raises(ValueError, match="descriptor"):
        encode(Sample(0), descriptor=0x81)
    with pytest.raises(ValueError, match="cannot send"):
        encode(Sample(0, None, None, (1e300, 0.0, 0.0)))
    with pytest.raises(ValueError, match="cannot send"):
        encode(Sample(0, -1))
    with pytest.raises(ValueError, match="255"):
        encode_packet(0x80, [(1, bytes(200)), (2, bytes(200))])
    with pytest.raises(ValueError, match="fill"):
        list(fields(b"ue\x80\x02\x09\x00\0\0"))
    assert checksum(b"") == b"\0\0"
