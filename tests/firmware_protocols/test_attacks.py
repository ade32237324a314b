"""Input that somebody made up to hurt: slow to read, filling the memory, too large to go on with."""

import math
import re
import struct
from pathlib import Path
from time import process_time

import pytest

import firmware_protocols
from firmware_protocols import (
    hipnuc,
    mip,
    native,
    native_packet,
    text,
    text_pattern,
    vectornav,
    witmotion_can,
    ximu3,
    xsens,
)
from firmware_protocols._numbers import LARGEST, int16
from firmware_protocols._recent import MAX_SENSORS
from firmware_protocols._sequence import count_byte
from firmware_protocols.registry import PROTOCOLS
from firmware_protocols.rotation import from_angles, from_matrix
from firmware_protocols.sample import Counters, Sample

LEVEL = (1.0, 0.0, 0.0, 0.0)
STILL = Sample(0, 0, LEVEL, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0))

# --- time -----------------------------------------------------------------------------------------

SLOW = [
    *(bytes([start]) for start in b"\x00\n\x11$,9:Uu\xaa\xc9\xfa\xfe"),
    b"\xfa\x01\x36\xfe",
    b"\xfa\xff\x36\xff\x08\x00",
    b"\xfa\xff\x36\xff\x07\xff" + bytes(6),
    b"ue\x80\xff",
    b"ue\x80\xfe\x02\x04",
    b"\x5a\xa5\xf0\x01\x00\x00\x81",
    b"\x5a\xa5\xc8\x04\x00\x00\x62\x00\x10",
    b"\x01\x03\x18",
    b"\x3a\x01\x00\x09\x00\x00\x01",
    b"\xfd\xff\x00\x00\x00\x01\x01\x1f\x00\x00",
    b"\xfe\xff\x00\x01\x01\x1a",
    b"$VNYMR,",
    b"\xfa\x7f\xff\x7f",
    b"X0:AAAA",
    b"Quaternion: ",
    b"#YPR=1,",
    b"^A",
    b"I,1,",
    b"I,1,0,0,0,0,0,1",
]  # fmt: skip


def beginnings(name):
    """The first bytes of a message."""
    protocol = PROTOCOLS[name]
    if protocol.encoder is None:
        return []
    sensor = protocol.ids[0] if protocol.ids else 0
    message = protocol.encode(STILL._replace(sensor=sensor, mag=(20.0, 0.0, -40.0), temperature=25.0), 0)
    return [message[:size] for size in (1, 2, 3, 5, 8, 12)]


@pytest.mark.parametrize("name", [name for name, p in PROTOCOLS.items() if p.transport == "bytes"])
def test_no_pattern_is_slow(name):
    for pattern in (*SLOW, *beginnings(name)):
        taken = []
        for size in (6_000, 24_000):
            data = (pattern * size)[:size]
            decoder = PROTOCOLS[name].decoder()
            start = process_time()
            decoder.feed(data)
            taken.append(process_time() - start)
        # Four times as much may take four times as long and not sixteen times, and no line is as fast as 10
        # bytes a millisecond can fill.
        assert taken[1] < 10 * taken[0] + 0.02, pattern
        assert taken[1] / 24_000 < 1e-4, pattern


DOCS = Path(firmware_protocols.__file__).parent / "docs"


def test_regexes_of_the_documentation_are_fast_and_read_numbers():
    (regex,) = re.findall(r"^regex = '(.+)'$", (DOCS / "text.md").read_text(encoding="utf-8"), re.MULTILINE)
    decoder = text.TextDecoder(text_pattern.Pattern(regex=regex))
    (sample,) = decoder.feed(b"IMU7 q=1,-0.0,+0,1e-3 a=.5,0,-9.81\r\n")
    assert (sample.sensor, sample.acc) == (7, (0.5, 0.0, -9.81))
    start = process_time()
    for filler in (b",", b"1,", b"1", b" a=1,", b"-"):
        decoder.feed(b"IMU1 q=" + (filler * 500)[:500] + b"\n")
    assert process_time() - start < 0.2


# --- memory ---------------------------------------------------------------------------------------


def test_invented_can_ids_do_not_push_out_a_device():
    decoder, got = witmotion_can.WitCanDecoder(), 0
    for i in range(200):
        for frame in witmotion_can.encode_can(STILL._replace(sensor=0x50)):
            got += len(decoder.feed(*frame))
        for other in range(50):
            decoder.feed(0x1000 + 50 * i + other, b"\x55\x51" + bytes(6), True)
    assert got >= 199
    assert len(decoder._cycles) == MAX_SENSORS


def test_invented_channels_do_not_push_out_a_device():
    decoder, got = ximu3.Ximu3Decoder(), 0
    for i in range(200):
        got += len(decoder.feed(ximu3.encode(STILL._replace(sensor=65, time_us=10_000 * i))))
        for other in range(50):
            channel = 50 * i + other
            line = b"^" + bytes([11 + channel // 200]) + b"^" + bytes([20 + channel % 200])
            decoder.feed(line + b"Q,1,1,0,0,0\n" + line + b"M,1,1,0,0\n")
    assert got == 200
    held = decoder._pairing
    for memory in (decoder._time, decoder._mag, held._held, held._done, decoder._suspect):
        assert len(memory) <= MAX_SENSORS


def test_invented_components_do_not_push_out_a_device():
    pytest.importorskip("pymavlink.dialects.v20.common")
    mavlink = __import__("firmware_protocols.mavlink", fromlist=["Encoder"])
    real, others, decoder, got = mavlink.Encoder(), mavlink.Encoder(), mavlink.MavlinkDecoder(), []
    for i in range(60):
        got += decoder.feed(real.encode(STILL._replace(sensor=1, time_us=10_000 * i)))
        for other in range(20):
            decoder.feed(others.encode(Sample(1000 + 20 * i + other, 0, LEVEL)))
    assert [sample.sensor for sample in got] == [1] * 60
    assert len(decoder._sequence) == MAX_SENSORS
    assert decoder.counters.lost == 0


# --- numbers --------------------------------------------------------------------------------------

HUGE = STILL._replace(acc=(1e30, 0.0, 0.0), gyr=(0.0, -3e38, 0.0), mag=(0.0, 0.0, 1e30), temperature=1e30)
LARGE = {
    "xsens": lambda: xsens.XbusDecoder().feed(xsens.encode_mtdata2(HUGE, 0)),
    "xsens f64": lambda: xsens.XbusDecoder().feed(xsens.encode_mtdata2(HUGE, 0, number_format="f64")),
    "mip": lambda: mip.MipDecoder().feed(mip.encode(HUGE._replace(gyr=(1e30, 0.0, 0.0)))),
    "vectornav": lambda: vectornav.VectorNavDecoder().feed(vectornav.encode_binary(HUGE)),
    "vectornav ascii": lambda: vectornav.VectorNavDecoder().feed(vectornav.encode_ascii(HUGE)),
    "hipnuc": lambda: hipnuc.HipnucDecoder().feed(
        hipnuc.encode(HUGE._replace(gyr=STILL.gyr, temperature=1.0))
    ),
    "hipnuc fields": lambda: hipnuc.HipnucDecoder().feed(hipnuc.encode_fields(HUGE)),
    "native": lambda: native.NativeDecoder().feed(
        native.encode(native_packet.Packet(0, 0, 0, *HUGE[2:6]), floats=True)
    ),
    "text": lambda: text.TextDecoder(
        text_pattern.Pattern(header="a,b,c", columns={"ax": "a", "ay": "b", "az": "c"})
    ).feed(b"0,0,0\n1e30,0,0\n0,1e400,0\n"),
    "ximu3": lambda: ximu3.Ximu3Decoder().feed(
        b"M,1,1e300,0,0\nT,1,1e300\n" + ximu3.encode(STILL)
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LARGE)
def test_nothing_too_large_to_go_on_with(name):
    for sample in LARGE[name]():
        for values in sample[2:6]:
            assert values is None or max(map(abs, values)) <= LARGEST
        assert sample.temperature is None or abs(sample.temperature) <= LARGEST


@pytest.mark.parametrize("name", [name for name, protocol in PROTOCOLS.items() if protocol.encoder])
@pytest.mark.parametrize("quantity", ["acc", "gyr", "mag"])
def test_nothing_too_large_in_any_format(name, quantity):
    """As far as it can be sent."""
    protocol = PROTOCOLS[name]
    huge = STILL._replace(**{quantity: (1e30, 0.0, 0.0)})
    try:
        wire = [protocol.encode(huge, k) for k in range(3)]
    except (ValueError, OverflowError, struct.error):
        return
    decoder = protocol.decoder()
    samples = []
    for packet in wire:
        pieces = [(packet,)] if protocol.transport != "can" else [frame[:3] for frame in packet]
        for piece in pieces:
            samples += decoder.feed(*piece)
    for sample in samples + decoder.flush():
        for values in sample[2:6]:
            assert values is None or max(map(abs, values)) <= LARGEST


def test_the_smallest_numbers_are_numbers():
    tiny = STILL._replace(acc=(5e-324, -1e-310, 1e-45))
    (sample,) = xsens.XbusDecoder().feed(xsens.encode_mtdata2(tiny, 0, number_format="f64"))
    assert sample.acc == tiny.acc
    (sample,) = native.NativeDecoder().feed(
        native.encode(native_packet.Packet(0, 0, 0, *tiny[2:5]), floats=True)
    )
    assert sample.acc == (0.0, 0.0, pytest.approx(1e-45, abs=1e-45))


@pytest.mark.parametrize("value", [7.1, -1e9, 1e300, math.inf, math.nan])
def test_angles_beyond_a_turn(value):
    for angles in ((value, 0.0, 0.0), (0.0, value, 0.0), (0.0, 0.0, value)):
        assert from_angles(*angles) is None
    data = struct.pack(">3f", value if not abs(value) > 3e38 else math.inf, 0, 0)
    degrees = struct.pack(">3d", 57.4 * value, 0, 0)
    assert xsens.XbusDecoder().feed(xsens.encode_xbus(xsens.MTDATA2, b"\x20\x33\x18" + degrees)) == []
    assert mip.MipDecoder().feed(mip.encode_packet(0x80, [(0x0C, data)])) == []


@pytest.mark.parametrize(
    "m",
    [
        (1, 0.8, 0, 0, 1, 0, 0, 0, 1),  # a shear: its determinant is 1
        (2, 0, 0, 0, 0.5, 0, 0, 0, 1),
        (1, 0, 0, 0, 1, 0, 0, 0, -1),  # a mirror
        (-1, 0, 0, 0, -1, 0, 0, 0, -1),
        (0,) * 9,
        (math.nan, 0, 0, 0, 1, 0, 0, 0, 1),
        (math.inf,) * 9,
        (1e300,) * 9,
    ],
)
def test_matrices_that_are_no_rotations(m):
    assert from_matrix(m) is None


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_whole_numbers_of_none(value):
    with pytest.raises(ValueError, match="cannot send"):
        int16(value)
    acc = (0.0, value, 0.0)
    for name in ("hipnuc-canopen", "witmotion", "witmotion-modbus", "xsens-can", "bno08x-rvc"):
        with pytest.raises(ValueError, match="cannot send"):
            PROTOCOLS[name].encode(STILL._replace(sensor=(PROTOCOLS[name].ids or [0])[0], acc=acc), 0)


# --- counts ---------------------------------------------------------------------------------------


def mip_lost(*times_and_periods):
    decoder = mip.MipDecoder()
    for time_ns, period_ns in times_and_periods:
        parts = [(0xD5, time_ns.to_bytes(8, "big")), (0xD6, period_ns.to_bytes(8, "big"))]
        decoder.feed(mip.encode_packet(0x80, [*parts, (0x04, struct.pack(">3f", 0, 0, -1))]))
    return decoder.counters.lost, decoder.counters.restarts


def test_clocks_that_jump_lose_nothing():
    ms = 1_000_000
    assert mip_lost((0, 10 * ms), (10 * ms, 10 * ms), (40 * ms, 10 * ms)) == (2, 0)
    assert mip_lost((0, 10 * ms), (10 * ms, 1), (20 * ms, 0), (30 * ms, 10 * ms)) == (0, 0)
    # The time of satellites arrives.
    assert mip_lost((0, 10 * ms), (1_700_000_000_000 * ms, 10 * ms), (0, 10 * ms)) == (0, 2)
    assert mip_lost(((1 << 64) - 1, 10 * ms), (0, (1 << 64) - 1)) == (0, 1)


@pytest.mark.parametrize(
    ("last", "count", "expected"),
    [
        (None, 7, (0, 0)),
        (7, 7, (0, 0)),
        (7, 8, (0, 0)),
        (254, 1, (2, 0)),
        (0, 128, (127, 0)),
        (0, 129, (0, 1)),
    ],
)
def test_bytes_that_count(last, count, expected):
    counters = Counters()
    count_byte(counters, last, count)
    assert (counters.lost, counters.restarts) == expected
