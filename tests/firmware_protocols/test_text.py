"""Text lines: ready patterns, patterns of one's own, and what a decoder makes of a bad line."""

import json
import math
import random
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocols import text
from firmware_protocols.rotation import rotate
from firmware_protocols.sample import STANDARD_G, Sample
from firmware_protocols.text import TextDecoder, encode, encode_header
from firmware_protocols.text_pattern import PATTERNS, Pattern, pattern_from_table

try:
    import tomllib
except ImportError:
    import tomli as tomllib

DATA = json.loads((Path(__file__).parents[1] / "data/protocols/text.json").read_text(encoding="utf-8"))


def quaternion(rng):
    q = [rng.gauss(0, 1) for _ in range(4)]
    return tuple(x / math.hypot(*q) for x in q)


def stream(n, seed=1):
    rng = random.Random(seed)
    return [
        Sample(
            0,
            5_000_000 + i * 10_000,
            quaternion(rng),
            tuple(rng.gauss(0, 8) for _ in range(3)),
            tuple(rng.gauss(0, 3) for _ in range(3)),
            tuple(rng.gauss(0, 30) for _ in range(3)),
            25.5,
        )
        for i in range(n)
    ]


def same(a, b, tolerance=2e-4):
    """Every quantity of b alike in a; quaternions up to sign."""
    dot = abs(sum(x * y for x, y in zip(a.quat, b.quat, strict=True))) if b.quat else 1
    pairs = [
        (x, y)
        for p, q in zip(a[3:6], b[3:6], strict=True)
        if q is not None
        for x, y in zip(p, q, strict=True)
    ]
    return dot > 1 - tolerance**1.5 and all(abs(x - y) < 5 * tolerance + abs(y) * 1e-4 for x, y in pairs)


# --- what lines say -------------------------------------------------------------------------------


@pytest.mark.parametrize("vector", DATA["vectors"], ids=lambda v: v["id"])
def test_vectors(vector):
    decoder = TextDecoder(vector["pattern"])
    (sample,) = decoder.feed(vector["lines"].encode())
    assert sample.time_us == vector.get("time_us")
    if "quat" in vector:
        assert sample.quat == pytest.approx(vector["quat"], abs=1e-9)
    if "acc_g" in vector:
        assert sample.acc == pytest.approx([x * STANDARD_G for x in vector["acc_g"]])
    if "gyr_deg" in vector:
        assert sample.gyr == pytest.approx([math.radians(x) for x in vector["gyr_deg"]])
    if "mag" in vector:
        assert sample.mag == pytest.approx(vector["mag"])
    assert sample.temperature == vector.get("temperature")
    if "yaw_pitch_roll_ned_deg" in vector:
        yaw, pitch, roll = map(math.radians, vector["yaw_pitch_roll_ned_deg"])
        # Nose down, right side down, looking west of south: x forward, y right, z down.
        forward = rotate(sample.quat, (1.0, 0.0, 0.0))
        assert forward == pytest.approx(
            (math.sin(yaw) * math.cos(pitch), math.cos(yaw) * math.cos(pitch), math.sin(pitch))
        )
        assert rotate(sample.quat, (0.0, 1.0, 0.0))[2] == pytest.approx(-math.sin(roll) * math.cos(pitch))
    assert decoder.counters.bad == 0


@pytest.mark.parametrize("name", PATTERNS)
def test_round_trip(name):
    expected = stream(50)
    decoder = TextDecoder(name)
    got = decoder.feed(encode_header(name) + b"".join(encode(s, name) for s in expected))
    assert len(got) == 50
    for a, b in zip(got, expected, strict=True):
        if name in ("adafruit", "razor"):
            b = b._replace(acc=None, gyr=None, mag=None)
        elif name == "artemis":
            b = b._replace(quat=None)
        assert same(a, b, {"razor": 4e-4, "artemis-dmp": 0.05}.get(name, 2e-3))
        if name.startswith("artemis"):
            assert a.time_us == b.time_us
    assert decoder.counters.bad == decoder.counters.skipped == 0


def test_still_sensor_reads_gravity_upwards():
    rng = random.Random(2)
    decoder = TextDecoder("artemis-dmp")
    decoder.feed(encode_header("artemis-dmp"))
    for _ in range(50):
        w, x, y, z = quaternion(rng)
        acc = rotate((w, -x, -y, -z), (0.0, 0.0, STANDARD_G))
        (sample,) = decoder.feed(encode(Sample(0, 0, (w, x, y, z), acc, (0.0, 0.0, 0.0)), "artemis-dmp"))
        # Where w is almost 0, five decimals of the others leave it at a few thousandths.
        assert rotate(sample.quat, sample.acc) == pytest.approx((0, 0, STANDARD_G), abs=0.2)


def test_pattern_of_a_toml_file():
    table = tomllib.loads(
        r"""
        regex = '^IMU(?P<sensor>\d+) t=(?P<time>\d+) q=(?P<x>\S+) (?P<y>\S+) (?P<z>\S+) (?P<w>\S+) a=(?P<ax>\S+) (?P<ay>\S+) (?P<az>\S+)(?: T=(?P<temperature>\S+))?$'
        frame = "NED"
        units = { acc = "-g", time = "ms" }
        """  # noqa: E501
    )
    decoder = TextDecoder(pattern_from_table(table))
    assert decoder.WRAP_US == 1000 << 32
    a, b = decoder.feed(b"IMU3 t=1500 q=0 0 0 1 a=0 0 1\nIMU4 t=4294967296 q=1 0 0 0 a=1 0 0 T=20.5\n")
    assert a[:2] == (3, 1_500_000)
    assert a.acc == (0, 0, -STANDARD_G)
    assert rotate(a.quat, (1.0, 0.0, 0.0)) == pytest.approx((0, 1, 0), abs=1e-9)
    assert rotate(a.quat, a.acc) == pytest.approx((0, 0, STANDARD_G))
    assert b[:2] == (4, 0)
    assert b.temperature == 20.5


def test_columns_of_a_toml_file():
    table = tomllib.loads(
        """
        header = "t;id;qw;qx;qy;qz;ax;ay;az"
        separator = ";"
        units = { acc = 0.01, time = "s" }

        [columns]
        time = "t"
        sensor = "id"
        w = "qw"
        x = "qx"
        y = "qy"
        z = "qz"
        ax = "ax"
        ay = "ay"
        az = "az"
        """
    )
    decoder = TextDecoder(pattern_from_table(table))
    got = decoder.feed(b".5;0;1;0;0;0;1;2;3\n2.25;7;1;0;0;0;0;0;981\n")
    # The first line may have lost its beginning.
    assert got == [Sample(7, 2_250_000, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 981 * 0.01))]
    assert decoder.counters.skipped == 1


def test_header_says_where_the_columns_are():
    decoder = TextDecoder("artemis-dmp")
    assert decoder.feed(b"0.1,0.2,0.3\n01/01/2026,00:00:00.00,0,0,0\n") == []
    assert decoder.counters.skipped == 2
    decoder.feed(b"Q6_3,x,Q6_1,Q6_2,\r\n")
    (sample,) = decoder.feed(b"0.5,ignored,0.5,-0.5,\r\n")
    assert sample.quat == (0.5, 0.5, -0.5, 0.5)
    assert decoder.feed(b"0.5,one too few,0.5\r\n0.5,,0.5,-0.5,9\r\n") == []
    assert decoder.counters.bad == 2
    # The nine-axis orientation is preferred; the device starts again.
    decoder.feed(b"Q6_1,Q6_2,Q6_3,Q9_1,Q9_2,Q9_3\r\n")
    (sample,) = decoder.feed(b"0,0,0,0,0,1\r\n")
    assert sample.quat == (0, 0, 0, 1)
    assert decoder.counters.restarts == 1


@pytest.mark.parametrize(
    ("unit", "value", "expected"),
    [
        ("us", "4294967297", 1),
        ("ms", "1.5", 1500),
        ("s", "2.5", 2_500_000),
        ("clock", "01:00:00.25", 3_600_250_000),
    ],
)
def test_time(unit, value, expected):
    pattern = Pattern(
        columns={"time": "t", "ax": "a", "ay": "b", "az": "c"}, units={"time": unit}, header="t,a,b,c"
    )
    assert TextDecoder(pattern).feed(f"\nfirst\n{value},0,0,1\n".encode())[0].time_us == expected


# --- the line -------------------------------------------------------------------------------------

ADAFRUIT = b"Quaternion: 1.0000, 0.0000, 0.0000, 0.0000\r\n"


@pytest.mark.parametrize(
    "line",
    [
        b"Quaternion: 0, 0, 0, 0",
        b"Quaternion: 2.0, 0.0, 0.0, 0.0",
        b"Quaternion: 1.0, 0.0, 0.0, 0.0 \xb0",
        b"x" * (text.MAX_LINE + 1),
    ],
)
def test_what_cannot_be_true_is_bad(line):
    decoder = TextDecoder("adafruit")
    assert len(decoder.feed(line + b"\n" + ADAFRUIT)) == 1
    assert decoder.counters.bad == decoder.counters.resyncs == 1


@pytest.mark.parametrize("word", ["nan", "inf", "1_0", "", "x", "1e999"])
def test_words_that_are_no_numbers(word):
    pattern = Pattern(columns={"ax": "a", "ay": "b", "az": "c"}, header="a,b,c,d")
    decoder = TextDecoder(pattern)
    assert decoder.feed(f"\nfirst\n{word},0,0,1\n1,2,3,4\n".encode()) == [Sample(0, acc=(1.0, 2.0, 3.0))]
    assert decoder.counters.bad == 1


@pytest.mark.parametrize("word", ["", "1:2", "a:b:c", "-1:00:00", "1:2:nan", "1:2:inf", "1_0:0:0"])
def test_words_that_are_no_clock(word):
    pattern = replace(PATTERNS["artemis"], header="rtcTime,aX,aY,aZ")
    decoder = TextDecoder(pattern)
    assert decoder.feed(f"first\n{word},0,0,1\n".encode()) == []
    assert decoder.counters.bad == 1


def test_a_lost_line_end_costs_one_line_only():
    decoder = TextDecoder("adafruit")
    got = decoder.feed(ADAFRUIT + ADAFRUIT[:20] + ADAFRUIT + ADAFRUIT)
    assert len(got) == 3
    assert decoder.counters.bad == 0


def test_cuts_cost_only_what_they_touch():
    rng = random.Random(3)
    expected = stream(300)
    for name in ("adafruit", "razor", "artemis-dmp"):
        pieces = [encode(s, name) for s in expected]
        touched = set(rng.sample(range(300), 60))
        for i in touched:
            # The line end stays: without it the next line is touched too.
            pieces[i] = (
                bytes(rng.choice(b"\x00\x80\xff") if rng.random() < 0.5 else b for b in pieces[i][:-2])
                + b"\r\n"
            )
        clean = TextDecoder(name).feed(
            encode_header(name) + b"".join(p for i, p in enumerate(pieces) if i not in touched)
        )
        decoder = TextDecoder(name)
        got = decoder.feed(encode_header(name) + b"".join(pieces))
        assert got == clean
        assert len(got) == 240


@given(st.lists(st.integers(1, 90), max_size=40), st.sampled_from(sorted(PATTERNS)))
@settings(max_examples=50, deadline=None)
def test_any_chunking_gives_the_same(in_pieces, sizes, name):
    data = b"\xffnoise" * 200 + b"\r\n" + encode_header(name)
    data += (
        b"".join(encode(s, name) for s in stream(8))
        + b"x" * 600
        + b"\r\r\n\n"
        + encode(stream(1)[0], name)
        + b"1"
    )
    got, _ = in_pieces(lambda: TextDecoder(name), data, sizes)
    assert len(got) == 9


@given(
    st.sampled_from(sorted(PATTERNS)),
    st.lists(st.binary(max_size=200) | st.sampled_from([ADAFRUIT, b"#YPR=1,2,3", b"9" * 400, b",", b"\r\n"])),
)
@settings(max_examples=200, deadline=None)
def test_random_bytes_never_raise(name, chunks):
    decoder = TextDecoder(name)
    decoder.feed(encode_header(name))
    before = decoder.counters.bytes
    for chunk in chunks:
        for sample in decoder.feed(chunk):
            assert sample.quat is None or math.hypot(*sample.quat) == pytest.approx(1)
        assert len(decoder._rest) <= text.MAX_LINE
    assert decoder.counters.bytes == before + sum(map(len, chunks))


# --- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({}, "either a regex or columns"),
        ({"regex": "(?P<w>x)", "columns": {"w": "w"}}, "either a regex or columns"),
        ({"regex": "("}, "regex"),
        ({"regex": 5}, "regex must be text"),
        ({"regex": "(?P<qw>x)"}, "unknown field 'qw'"),
        ({"regex": "(?P<ax>x)"}, "ax without ay"),
        ({"regex": "(?P<ay>x)"}, "no ax"),
        ({"regex": "(?P<w>x)"}, "w without x"),
        ({"regex": "(?P<time>x)"}, "needs an orientation"),
        (
            {"columns": {k: k for k in ("x", "y", "z", "yaw", "pitch", "roll")}},
            "either a quaternion or angles",
        ),
        ({"columns": "x"}, "columns must be a table"),
        ({"columns": {"ax": 1, "ay": "b", "az": "c"}}, "columns: ax"),
        ({"columns": {"ax": "a", "ay": "b", "az": "c"}, "units": {"acc": "lb"}}, "units: acc must be one of"),
        ({"columns": {"ax": "a", "ay": "b", "az": "c"}, "units": {"acc": 0}}, "units: acc must be one of"),
        ({"columns": {"ax": "a", "ay": "b", "az": "c"}, "units": {"acc": []}}, "units: acc must be one of"),
        ({"columns": {"ax": "a", "ay": "b", "az": "c"}, "units": {"acc": 10**400}}, "units: acc must be"),
        (
            {"columns": {"ax": "a", "ay": "b", "az": "c"}, "units": {"time": "-us"}},
            "units: time must be one of",
        ),
        (
            {"columns": {"ax": "a", "ay": "b", "az": "c"}, "units": {"speed": "m/s"}},
            "unknown quantity 'speed'",
        ),
        ({"columns": {"ax": "a", "ay": "b", "az": "c"}, "frame": "ned"}, "frame must be one of"),
        ({"columns": {"ax": "a", "ay": "b", "az": "c"}, "header": "x,y"}, "header has none"),
        ({"columns": {"ax": "a", "ay": "b", "az": "c"}, "separator": ""}, "separator"),
        ({"columns": {"ax": "a", "ay": "b", "az": "c"}, "wrap_us": 0}, "wrap_us"),
        ({"columns": {"ax": "a", "ay": "b", "az": "c"}, "wrap_us": 10**400}, "wrap_us"),
        ({"columns": {"ax": "a", "ay": "b", "az": "c"}, "rate": 5}, "unknown key 'rate'"),
    ],
)
def test_patterns_are_checked(table, words):
    with pytest.raises(ValueError, match=words):
        pattern_from_table(table)


def test_names_are_checked():
    with pytest.raises(ValueError, match="pattern must be one of"):
        TextDecoder("csv")
    with pytest.raises(ValueError, match="pattern must be one of"):
        encode(Sample(0), "csv")
    with pytest.raises(ValueError, match="need an orientation"):
        encode(Sample(0), "razor")
    with pytest.raises(ValueError, match="need time, acceleration and angular rate"):
        encode(Sample(0), "artemis")


# --- logs of other people's programs ----------------------------------------------------------------

WIT = Pattern(
    separator="\t",
    units={"time": "clock", "acc": "g", "gyr": "deg/s"},
    columns={
        "time": "ChipTime",
        **dict(zip(("w", "x", "y", "z"), ("q0()", "q1()", "q2()", "q3()"), strict=True)),
        **dict(zip(("ax", "ay", "az"), ("ax(g)", "ay(g)", "az(g)"), strict=True)),
    },
)
WIT_HEADER = (
    "Start time:2023-03-04 21:27:11.700\nTime\tChipTime\tax(g)\tay(g)\taz(g)\tq0()\tq1()\tq2()\tq3()\n"
)
WIT_ROW = "2023-03-04 21:27:11.010\t{}\t0.0000\t0.0000\t1.0000\t0.6000\t0.0000\t0.8000\t0.0000\n"


@pytest.mark.parametrize("clock", ["2023-03-04 21:27:11.250", "2023-03-04T21:27:11,250", "21:27:11.250"])
@pytest.mark.parametrize("comma", [False, True])
def test_a_clock_with_a_date_and_decimal_commas(clock, comma):
    """WitMotion's program on computers with an English and with a German region."""
    date, _, numbers = WIT_ROW.format(clock).split("\t", 2)
    line = "\t".join([date, clock, numbers.replace(".", ",") if comma else numbers])
    decoder = TextDecoder(WIT)
    (sample,) = decoder.feed((WIT_HEADER + line).encode())
    assert sample.time_us == ((21 * 60 + 27) * 60 + 11) * 1_000_000 + 250_000
    assert sample.acc == pytest.approx((0, 0, 9.80665))
    assert sample.quat == (0.6, 0.0, 0.8, 0.0)
    assert decoder.refused is None


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("21:27:11.250", "noon", "line 3: time is 'noon', which is no time in the unit clock"),
        ("1.0000", "1,000.0", "line 3: az is '1,000.0', which is no number"),
        ("0.8000", "1.8000", "line 3: the quaternion is not of length 1"),
        ("\t0.8000", "", "line 3: it has 8 columns instead of 9"),
        ("1.0000", "1_0", "line 3: az is '1_0', which is no number"),
    ],
)
def test_the_reason_why_no_line_can_be_read(old, new, says):
    decoder = TextDecoder(WIT)
    row = WIT_ROW.format("21:27:11.250").replace(old, new)
    assert decoder.feed((WIT_HEADER + 3 * row).encode()) == []
    assert decoder.refused == f"3 lines cannot be read, the first: {says}"
    assert decoder.counters.bad == 3


def test_a_comma_that_separates_is_no_decimal_comma():
    decoder = TextDecoder(Pattern(columns={"ax": "a", "ay": "b", "az": "c"}))
    assert decoder.feed(b"a,b,c\n1,5,2\n1,5,2,5\n")[0].acc == (1.0, 5.0, 2.0)
    assert decoder.counters.bad == 1
