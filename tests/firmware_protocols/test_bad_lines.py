"""What the decoders of Xbus, MIP and VectorNav make of a bad line: it costs only the packets it touches."""

import math
import random
import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocols import mip, vectornav, xsens
from firmware_protocols.sample import Sample


def xbus(sample, i):
    return xsens.encode_mtdata2(sample, i)


def xbus_long(sample, i):
    line = xsens.encode_mtdata2(sample, i)
    padding = b"".join(b"\x40\x10\x0c" + bytes(12) for _ in range(17))
    return xsens.encode_xbus(xsens.MTDATA2, line[4:-1] + padding)


def mip_sensor(sample, i):
    return mip.encode(sample, period_us=10_000)


def vectornav_binary(sample, i):
    return vectornav.encode_binary(sample)


def vectornav_ascii(sample, i):
    return vectornav.encode_ascii(sample, "VNQMR")


# Encoder, decoder, longest frame.
FAMILIES = {
    "xbus": (xbus, xsens.XbusDecoder, 2055),
    "xbus long": (xbus_long, xsens.XbusDecoder, 2055),
    "mip": (mip_sensor, mip.MipDecoder, 261),
    "vectornav binary": (vectornav_binary, vectornav.VectorNavDecoder, 1100),
    "vectornav ascii": (vectornav_ascii, vectornav.VectorNavDecoder, 300),
}


@pytest.fixture(params=FAMILIES)
def family(request):
    return FAMILIES[request.param]


def lines_of(encode, n, seed=0):
    rng = random.Random(seed)
    lines = []
    for i in range(n):
        q = [rng.gauss(0, 1) for _ in range(4)]
        vectors = [tuple(rng.uniform(-20, 20) for _ in range(3)) for _ in range(3)]
        sample = Sample(0, i * 10_000, tuple(x / math.hypot(*q) for x in q), *vectors)
        lines.append(encode(sample, i))
    return lines


def decode(make, stream, chunk=None):
    decoder = make()
    if chunk is None:
        return decoder.feed(stream), decoder.counters
    result = []
    for at in range(0, len(stream), chunk):
        result += decoder.feed(stream[at : at + chunk])
    return result, decoder.counters


def one_by_one(make, lines):
    return [decode(make, line)[0][0] for line in lines]


def dirty(lines, seed):
    """A line with everything that can happen to it."""
    rng = random.Random(seed)
    out = []
    for line in lines:
        kind = rng.randrange(8)
        if kind == 0:
            at = rng.randrange(len(line))
            line = line[:at] + bytes([line[at] ^ 1 << rng.randrange(8)]) + line[at + 1 :]
        elif kind == 1:
            line = line[: rng.randrange(len(line))]
        elif kind == 2:
            line = rng.randbytes(rng.randrange(60)) + line
        elif kind == 3:
            line += line[: rng.randrange(6)]
        out.append(line)
    return b"".join(out)


@pytest.mark.parametrize("chunk", [1, 2, 3, 7, 64, 1000])
def test_any_chunking(family, chunk):
    encode, make, _ = family
    lines = lines_of(encode, 60)
    assert decode(make, b"".join(lines), chunk) == decode(make, b"".join(lines))
    line = dirty(lines, chunk)
    assert decode(make, line, chunk) == decode(make, line)


def test_good_line(family):
    encode, make, _ = family
    result, counters = decode(make, b"".join(lines_of(encode, 50)))
    assert len(result) == counters.packets == 50
    assert (counters.bad, counters.resyncs, counters.lost, counters.skipped) == (0, 0, 0, 0)


def test_one_flipped_bit(family):
    encode, make, longest = family
    lines = lines_of(encode, 5)
    expected = one_by_one(make, lines)
    # Behind the line comes enough to end any false frame.
    tail = lines_of(encode, 2 + longest // len(lines[0]) + 1, seed=9)
    behind = one_by_one(make, tail)
    rng = random.Random(1)
    for at in range(len(lines[2])):
        flipped = lines[2][:at] + bytes([lines[2][at] ^ 1 << rng.randrange(8)]) + lines[2][at + 1 :]
        if encode is xbus or encode is xbus_long:
            # The counters begin anew with the tail, which is no loss.
            decoder = make()
            result = decoder.feed(b"".join([*lines[:2], flipped, *lines[3:]]))
            decoder._sequence._last.clear()
            result += decoder.feed(b"".join(tail))
            counters = decoder.counters
        else:
            result, counters = decode(make, b"".join([*lines[:2], flipped, *lines[3:], *tail]))
        others = expected[:2] + expected[3:] + behind
        # Some bits of a line of text do not matter: a capital letter in its checksum, its last line end.
        harmless = encode is vectornav_ascii and len(result) == len(others) + 1
        assert result == (expected + behind if harmless else others), at
        assert counters.bad >= 1 or harmless


def test_truncated(family):
    encode, make, longest = family
    lines = lines_of(encode, 4)
    tail = lines_of(encode, 2 + longest // len(lines[0]) + 1, seed=9)
    n = len(lines) - 1 + len(tail)
    for size in range(1, len(lines[1]), 3):
        stream = b"".join([lines[0], lines[1][:size], *lines[2:], *tail])
        result, counters = decode(make, stream)
        # Of a line of text, only the line end may be missing.
        assert len(result) + counters.late == n or (lines[1].endswith(b"\r\n") and size >= len(lines[1]) - 1)
        assert counters.resyncs == 1


FALSE_STARTS = {
    "xbus": [b"\xfa", b"\xfa\xff\x36", b"\xfa\xff\x36\xff\x08\x00", b"\xfa\x01\x36\xfe\x20\x10\xff"],
    "xbus long": [b"\xfa\xff\x36\xff\xff\xff", b"\xfa\xff\x30\xff\x00\x20"],
    "mip": [b"u", b"ue", b"ue\x80\xff", b"ue\x80\x20\x01", b"ue\x80\x20\xf0\x04"],
    "vectornav binary": [b"\xfa", b"\xfa\x01\xff\x7f", b"\xfa\x3f", b"\xfa\x01\x00\x80", b"$VNYMR,", b"$"],
    "vectornav ascii": [b"$", b"$VNQMR,1,2", b"$VNQMR,1*", b"$VNQMR*00\r", b"\xfa\x01\x08\x00", b"$" * 20],
}  # fmt: skip


@pytest.mark.parametrize("name", FAMILIES)
def test_false_starts_swallow_nothing(name):
    encode, make, longest = FAMILIES[name]
    lines = lines_of(encode, 4 + longest // len(lines_of(encode, 1)[0]))
    expected = one_by_one(make, lines)
    for start in FALSE_STARTS[name]:
        result, counters = decode(make, start + b"".join(lines))
        assert result == expected, start
        assert counters.bad >= 1
        assert counters.resyncs == 1


def test_start_bytes_inside(family):
    encode, make, longest = family
    lines = lines_of(encode, 4 + longest // len(lines_of(encode, 1)[0]))
    expected = one_by_one(make, lines)
    for cut in range(1, len(lines[0])):
        result, _ = decode(make, lines[0][cut:] + b"".join(lines[1:]))
        assert result == expected[1:]


def test_noise_costs_nothing(family):
    encode, make, longest = family
    n = 400
    lines = lines_of(encode, n)
    rng = random.Random(8)
    stream = b"".join(rng.randbytes(rng.randrange(80)) + line for line in lines) + bytes(longest + 2)
    result, counters = decode(make, stream)
    expected = one_by_one(make, lines)
    # An 8 bit checksum lets one in 256 false frames through, and they can cover a good one.
    assert sum(sample in expected for sample in result) >= n - 6
    assert counters.resyncs > n // 2
    assert counters.bad >= counters.resyncs


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(sorted(FAMILIES)), st.lists(st.binary(max_size=200), max_size=6))
def test_never_raises(name, chunks):
    _, make, longest = FAMILIES[name]
    decoder = make()
    for chunk in chunks:
        for sample in decoder.feed(chunk):
            assert isinstance(sample, Sample)
        assert len(decoder._rest) <= longest
    assert decoder.counters.bytes == sum(map(len, chunks))


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(sorted(FAMILIES)), st.randoms(use_true_random=False))
def test_almost_good_lines_never_raise(name, rng):
    encode, make, longest = FAMILIES[name]
    line = bytearray(b"".join(lines_of(encode, 3)))
    for _ in range(rng.randrange(1, 6)):
        line[rng.randrange(len(line))] = rng.choice([0, 1, 0x36, 0x75, 0x65, 0x80, 0xFA, 0xFF, 0x24, 0x2A])
    decoder = make()
    for byte in line:
        decoder.feed(bytes([byte]))
    assert len(decoder._rest) <= longest
    whole = make()
    whole.feed(bytes(line))
    assert whole.counters == decoder.counters


def test_start_pattern_knows_its_first_byte(family):
    _, make, _ = family
    assert isinstance(make._START, re.Pattern)
    for start in (b"\xfa", b"u", b"$"):
        match = make._START.search(b"x" + start)
        assert match is None or match.start() == 1
