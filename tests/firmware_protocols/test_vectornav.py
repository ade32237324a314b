"""VectorNav: recorded outputs and lines, frames, lengths of fields, round trips."""

import json
import math
import random
import struct
from binascii import crc_hqx
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocols.rotation import rotate, to_yaw_pitch_roll
from firmware_protocols.sample import Sample, z_up
from firmware_protocols.vectornav import (
    ASCII_LINES,
    VectorNavDecoder,
    encode_ascii,
    encode_binary,
    header_size,
)

DATA = Path(__file__).parents[1] / "data" / "protocols"
VECTORS = {v["id"]: v for v in json.loads((DATA / "vectornav.json").read_text())}
LINES = [v for v in VECTORS.values() if "text" in v]


def matrix(quat):
    """Rotation matrix, row after row."""
    columns = [rotate(quat, axis) for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
    return [column[i] for i in range(3) for column in columns]


def output(header, payload):
    body = bytes.fromhex(header) + payload
    return b"\xfa" + body + crc_hqx(body, 0).to_bytes(2, "big")


def ypr(sample):
    return [math.degrees(a) for a in to_yaw_pitch_roll(z_up(sample.quat))]


def test_binary_of_the_manual():
    decoder = VectorNavDecoder()
    (sample,) = decoder.feed(bytes.fromhex(VECTORS["vn_bin"]["hex"]))
    assert ypr(sample) == pytest.approx(VECTORS["vn_bin"]["expect"]["ypr"], rel=1e-5)
    assert decoder.counters.bad == 0


def test_misprint_of_the_manual():
    decoder = VectorNavDecoder()
    assert not decoder.feed(bytes.fromhex(VECTORS["vn_misprint"]["hex"]) + bytes(100))
    assert decoder.counters.bad == 1
    (sample,) = decoder.feed(bytes.fromhex(VECTORS["vn_misprint_right"]["hex"]))
    assert decoder.counters.resyncs == 1
    assert sample.temperature is not None or sample.quat is not None


@pytest.mark.parametrize("vector", LINES, ids=lambda v: v["id"])
def test_recorded_lines(vector):
    decoder = VectorNavDecoder()
    (sample,) = decoder.feed(vector["text"].encode("ascii"))
    expect = vector["expect"]
    assert decoder.counters.bad == 0
    assert sample.time_us is None
    if "ypr" in expect:
        assert ypr(sample) == pytest.approx(expect["ypr"], abs=1e-9)
    else:
        x, y, z, w = expect["quat"]
        assert sample.quat == pytest.approx(z_up((w, x, y, z)), abs=1e-5)
    assert sample.acc == (tuple(expect["acc"]) if "acc" in expect else None)
    assert sample.gyr == tuple(expect["gyr"])
    assert sample.mag == (pytest.approx([100 * m for m in expect["mag"]]) if "mag" in expect else None)
    if sample.acc:
        # At rest: what the device feels points up.
        assert rotate(sample.quat, sample.acc) == pytest.approx([0, 0, 9.75], abs=0.1)


def random_sample(rng):
    q = [rng.gauss(0, 1) for _ in range(4)]
    vector = [tuple(rng.uniform(-20, 20) for _ in range(3)) for _ in range(3)]
    return Sample(0, rng.randrange(1 << 50), tuple(x / math.hypot(*q) for x in q), *vector, 21.5)


@pytest.mark.parametrize("euler", [False, True])
def test_binary_round_trip(euler):
    rng = random.Random(3)
    decoder = VectorNavDecoder()
    for _ in range(50):
        sample = random_sample(rng)
        (result,) = decoder.feed(encode_binary(sample, euler=euler))
        assert result.time_us == sample.time_us
        assert matrix(result.quat) == pytest.approx(matrix(sample.quat), abs=1e-5)
        for a, b in zip(result[3:6], sample[3:6], strict=True):
            assert a == pytest.approx(b, rel=1e-6, abs=1e-6)
        assert result.temperature == 21.5
    (acc,) = decoder.feed(encode_binary(Sample(0, None, None, (1.0, 2.0, 3.0))))
    assert acc == Sample(0, None, None, (1.0, 2.0, 3.0))


@pytest.mark.parametrize("crc", [False, True])
@pytest.mark.parametrize("name", list(ASCII_LINES))
def test_ascii_round_trip(name, crc):
    rng = random.Random(4)
    decoder = VectorNavDecoder()
    for _ in range(10):
        sample = random_sample(rng)
        (result,) = decoder.feed(encode_ascii(sample, name, crc=crc))
        kinds = ASCII_LINES[name]
        if "quat" in kinds or "ypr" in kinds:
            assert matrix(result.quat) == pytest.approx(matrix(sample.quat), abs=1e-4)
        else:
            assert result.quat is None
        for kind, step in (("acc", 1e-3), ("gyr", 1e-6), ("mag", 1e-2)):
            if kind in kinds:
                assert getattr(result, kind) == pytest.approx(getattr(sample, kind), abs=step)
            else:
                assert getattr(result, kind) is None
        assert result.temperature == (21.5 if "temperature" in kinds else None)
    assert decoder.counters.bad == 0


def test_quaternion_has_its_scalar_last():
    line = encode_binary(Sample(0, None, z_up((0.1, 0.7, 0.5, 0.5))))
    x, *_, w = struct.unpack("<4f", line[4:20])
    assert (abs(w), abs(x)) == (pytest.approx(0.1), pytest.approx(0.7))
    # Level by the device's own axes, heading north: Z down, and it reads -9.81.
    (sample,) = VectorNavDecoder().feed(output("011001", struct.pack("<7f", 0, 0, 0, 1, 0, 0, -9.81)))
    assert rotate(sample.quat, sample.acc) == pytest.approx([0, 0, 9.81], rel=1e-6)


def test_both_kinds_on_one_line():
    rng = random.Random(6)
    decoder = VectorNavDecoder()
    binary = [rng.random() < 0.5 for _ in range(60)]
    stream = b"".join((encode_binary if kind else encode_ascii)(random_sample(rng)) for kind in binary)
    # The lines repeat the outputs, from the first output on.
    wanted = len(binary) - binary[binary.index(True) :].count(False)
    assert len(decoder.feed(stream)) == wanted
    assert (decoder.counters.bad, decoder.counters.skipped) == (0, 60 - wanted)


SIZES = {  # group, then the bits that all devices have
    1: [8, 8, 8, 12, 16, 12, 24, 12, 12, 24, 20, 28, 2, 4, 8],
    2: [8, 8, 8, 2, 8, 8, 8, 4, 4, 1],
    4: [2, 12, 12, 12, 4, 4, 16, 12, 12, 12, 12, 2],
    8: [8, 8, 2, 1, 1, 24, 24, 12, 12, 12, 4, 4, 2, 28],
    16: [2, 12, 16, 36, 12, 12, 12, 12, 12, 12, 28, 24, 12, 4],
    32: [2, 24, 24, 12, 12, 12, 12, 12, 12, 4, 4],
}


@pytest.mark.parametrize("group", SIZES)
def test_fields_before_and_behind(group):
    """Whatever else an output holds, the next one is found and quantities come from their places."""
    rng = random.Random(group)
    for bit, size in enumerate(SIZES[group]):
        decoder = VectorNavDecoder()
        line = output(f"{group:02x}" + (1 << bit).to_bytes(2, "little").hex(), rng.randbytes(size))
        decoder.feed(line + encode_binary(Sample(0, 5, None, (1.0, 2.0, 3.0))))
        assert decoder.counters.bad == 0
        assert decoder.counters.packets + decoder.counters.skipped == 2
    masks = {1: 1 << 8}
    masks[group] = masks.get(group, 0) | (1 << len(SIZES[group])) - 1
    payload = b""
    for number in sorted(masks):
        for bit, size in enumerate(SIZES[number]):
            if masks[number] >> bit & 1:
                payload += struct.pack("<3f", 1, 2, 3) if (number, bit) == (1, 8) else bytes(size)
    header = bytes([sum(masks)]) + b"".join(masks[n].to_bytes(2, "little") for n in sorted(masks))
    (sample,) = VectorNavDecoder().feed(output(header.hex(), payload))
    assert sample.acc == (1, 2, 3)


def test_more_groups_and_longer_masks():
    vector = struct.pack("<3f", 1, 2, 3)
    # Acceleration and, of the second group byte's fifth group, the week.
    (sample,) = VectorNavDecoder().feed(output("81100001 0400", vector + b"\x10\x09"))
    assert sample.acc == (1, 2, 3)
    # A GNSS mask that goes on: its bit 17 has two bytes.
    (sample,) = VectorNavDecoder().feed(output("09 0001 0480 0200", vector + b"\0\0" + b"\0\0"))
    assert sample.acc == (1, 2, 3)


@pytest.mark.parametrize(
    "header",
    ["00", "010000", "010080", "020004", "400040", "8080", "8001 0000", "080480 0100", "0180 0100"],
)
def test_no_such_output(header):
    line = b"\xfa" + bytes.fromhex(header)
    decoder = VectorNavDecoder()
    (sample,) = decoder.feed(line + encode_binary(Sample(0, 5, None, (1.0, 2.0, 3.0))))
    assert sample.acc == (1, 2, 3)
    assert (decoder.counters.bad, decoder.counters.resyncs) == (1, 1)


def test_compensated_values_are_preferred():
    raw, good = struct.pack("<6f", *[1] * 6), struct.pack("<3f", 2, 2, 2)
    (sample,) = VectorNavDecoder().feed(output("01 2003", good + good + raw))
    assert sample.acc == sample.gyr == (2, 2, 2)
    (sample,) = VectorNavDecoder().feed(output("01 0002", raw))
    assert sample.acc == sample.gyr == (1, 1, 1)


def test_noise_does_not_fill_the_memory():
    decoder = VectorNavDecoder()
    for mask in range(1, 0x8000, 7):
        decoder.feed(b"\xfa\x01" + mask.to_bytes(2, "little") + bytes(300))
    assert len(decoder._plans) <= 64


def test_header_size():
    assert header_size(b"\xfa") == 0
    assert header_size(b"\xfa\x01\x08") == 0
    assert header_size(b"\xfa\x01\x08\x00") == 4
    assert header_size(b"\xfa\x05\x08\x00\x01\x00") == 6


def test_nothing_is_invented():
    decoder = VectorNavDecoder()
    assert not decoder.feed(output("011000", struct.pack("<4f", 0, 0, 0, 0)))
    assert not decoder.feed(output("010001", struct.pack("<3f", math.nan, 0, 0)))
    assert not decoder.feed(output("041000", struct.pack("<f", math.inf)))
    assert not decoder.feed(ascii_line("VNRRG,01,VN-100T-CR"))
    assert (decoder.counters.skipped, decoder.counters.bad) == (4, 0)


def ascii_line(text):
    body = text.encode("ascii")
    return b"$" + body + f"*{crc_hqx(body, 0):04X}\r\n".encode("ascii")


@pytest.mark.parametrize("text", ["VNYPR", "VNYPR,1,2", "VNYPR,1,2,x", "VNQTN,1,2,3", "VNYPR,1,,3"])
def test_lines_that_lack_numbers(text):
    decoder = VectorNavDecoder()
    assert not decoder.feed(ascii_line(text))
    assert decoder.counters.bad == 1


@settings(max_examples=100, deadline=None)
@given(
    st.sampled_from([*ASCII_LINES, "VNXXX"]),
    st.lists(st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=12), max_size=16),
)
def test_any_line_with_a_good_checksum(name, parts):
    VectorNavDecoder().feed(ascii_line(",".join([name, *parts])))


@settings(max_examples=100, deadline=None)
@given(st.binary(min_size=1, max_size=8), st.binary(max_size=120))
def test_any_output_with_a_good_checksum(header, payload):
    decoder = VectorNavDecoder()
    decoder.feed(output(header.hex(), payload))
    assert decoder.counters.bytes == len(header) + len(payload) + 3


def test_what_cannot_be_sent():
    with pytest.raises(ValueError, match="line"):
        encode_ascii(Sample(0), "VNXXX")
    with pytest.raises(ValueError, match="quat"):
        encode_ascii(Sample(0), "VNQTN")
    with pytest.raises(ValueError, match="cannot send"):
        encode_binary(Sample(0, -5))


def test_lines_beside_binary_outputs_are_one_device():
    """As delivered, lines come at 40 Hz; binary outputs that are switched on come in addition."""
    sample = Sample(0, 10_000, (0.6, 0.0, 0.8, 0.0), (0.1, 0.2, 9.81), (0.1, 0.2, 0.3), (10.0, 20.0, 30.0))
    binary, line = encode_binary(sample), encode_ascii(sample, "VNYMR")
    decoder = VectorNavDecoder()
    got = decoder.feed((2 * binary + line) * 50)
    assert len(got) == decoder.counters.packets == 100
    assert all(s.time_us is not None for s in got)
    assert (decoder.counters.skipped, decoder.counters.bad) == (50, 0)
    # Binary outputs are switched off: the lines count once that is certain.
    assert 0 < len(decoder.feed(line * 150)) < 150


def test_the_form_with_more_quantities_counts():
    sample = Sample(0, 10_000, (0.6, 0.0, 0.8, 0.0), (0.1, 0.2, 9.81), (0.1, 0.2, 0.3), (10.0, 20.0, 30.0))
    line, orientation = encode_ascii(sample, "VNQMR"), encode_binary(Sample(0, 10_000, sample.quat))
    decoder = VectorNavDecoder()
    got = decoder.feed((line + orientation) * 50)
    assert all(s.acc is not None for s in got)
    assert len(got) == 50
    assert decoder.counters.skipped == 50
