"""SlimeVR trackers: packets that the vendor's own library made, bundles, and the talk with a host."""

import random
import struct

import pytest

from firmware_protocols import slimevr
from firmware_protocols.rotation import rotate_back
from firmware_protocols.sample import STANDARD_G, Sample
from firmware_protocols.slimevr import SlimevrDecoder, SlimevrHost

# Made with npm's @slimevr/firmware-protocol 0.6.6 (SlimeVR/slimevr-node, MIT or Apache-2.0): numbers 0 to 10.
HANDSHAKE = (
    "000000030000000000000000000000040000000400000001000000000000000000000000000000160474657374020000000001"
)
FEATURES = "00000016000000000000000100"
SENSOR_INFO = "0000000f0000000000000002010104"
ROTATION = "0000001100000000000000030101000000003f4ccccd000000003f19999a03"
ACCELERATION = "0000000400000000000000043f800000400000004040000001"
CORRECTION = "000000110000000000000005010200000000000000003f19999a3f4ccccd03"
OTHERS = (
    "0000000c0000000000000006406ccccd3ba3d70a",  # battery
    "00000013000000000000000701ce",  # signal strength
    "0000001400000000000000080141fc0000",  # temperature
    "000000000000000000000009",  # heartbeat
    "0000000a000000000000000a00000007",  # pong
)
QUAT = (0.6, 0.0, 0.8, 0.0)  # of ROTATION, scalar first
UP = rotate_back(QUAT, (0.0, 0.0, STANDARD_G))


def feed(decoder, *datagrams):
    return [s for d in datagrams for s in decoder.feed(bytes.fromhex(d) if isinstance(d, str) else d)]


def test_packets_of_the_vendors_library():
    decoder = SlimevrDecoder()
    (sample,) = feed(decoder, HANDSHAKE, FEATURES, SENSOR_INFO, ROTATION, ACCELERATION, CORRECTION, *OTHERS)
    assert sample.sensor == 1
    assert sample.quat == pytest.approx(QUAT)
    assert sample.acc == pytest.approx((1.0 + UP[0], 2.0 + UP[1], 3.0 + UP[2]))
    assert sample.time_us is sample.gyr is sample.mag is None
    assert (decoder.counters.packets, decoder.counters.bad, decoder.counters.lost) == (1, 0, 0)
    assert decoder.refused is None


def test_older_firmware_sends_the_axes_of_the_chip():
    decoder = SlimevrDecoder()
    old = bytes.fromhex(HANDSHAKE).replace(b"\0\0\0\x16", b"\0\0\0\x15")
    (sample,) = feed(decoder, old, ROTATION, ACCELERATION)
    # Turned by -90 degrees about Z: (x, y) becomes (y, -x).
    assert sample.acc == pytest.approx((2.0 + UP[0], -1.0 + UP[1], 3.0 + UP[2]))
    assert "protocol 21" in decoder.refused


@pytest.mark.parametrize("compact", [False, True])
def test_bundles(compact):
    sent = [Sample(s, None, QUAT, (0.5, -0.25, 9.0)) for s in (0, 1, 2)]
    one = [slimevr.encode(sample, 1, compact=compact) for sample in sent]
    decoder = SlimevrDecoder()
    got = feed(decoder, one[0] + one[1][12:] + b"\0" * (1 if compact else 2) + one[2][12:])
    assert [sample.sensor for sample in got] == [0, 1, 2]
    for sample in got:
        assert sample.quat == pytest.approx(QUAT, abs=1e-4)
        assert sample.acc == pytest.approx((0.5, -0.25, 9.0), abs=0.01)
    assert decoder.counters.bad == 0


def test_a_bundle_that_is_cut_short_costs_its_end():
    one = slimevr.encode(Sample(0, None, QUAT, (0.0, 0.0, 9.0)), 1, compact=True)
    decoder = SlimevrDecoder()
    assert len(feed(decoder, one + one[12:-3])) == 1
    assert decoder.counters.bad == 1


def test_orientations_without_accelerations_wait_only_once():
    decoder = SlimevrDecoder()
    rotations = [struct.pack(">IQBB4fB", 17, k, 0, 1, 0.0, 0.8, 0.0, 0.6, 0) for k in range(1, 6)]
    assert [len(feed(decoder, d)) for d in rotations] == [0, 2, 1, 1, 1]
    assert decoder.flush() == []
    # From the next acceleration on, they wait again.
    last = struct.pack(">IQ3fB", 4, 6, 0.0, 0.0, 0.0, 0)
    assert feed(decoder, last) == []
    held = struct.pack(">IQBB4fB", 17, 7, 0, 1, 0.0, 0.8, 0.0, 0.6, 0)
    assert feed(decoder, held) == []
    (sample,) = feed(decoder, struct.pack(">IQ3fB", 4, 8, 0.0, 0.0, 0.0, 0))
    assert sample.acc == pytest.approx(UP)


def numbered(number):
    return slimevr.encode(Sample(0, None, QUAT, UP), number)


def test_numbers():
    decoder = SlimevrDecoder()
    assert len(feed(decoder, *map(numbered, (1, 2, 5, 6)))) == 4
    assert decoder.counters.lost == 2
    assert feed(decoder, *map(numbered, (6, 4))) == []
    assert decoder.counters.late == 2
    # A forged number makes no later datagram late.
    assert len(feed(decoder, *map(numbered, (1 << 63, 7, 8)))) == 3
    # The tracker restarts, with a handshake or without.
    assert len(feed(decoder, HANDSHAKE, numbered(1), numbered(2))) == 2
    assert len(feed(decoder, numbered(10_000), numbered(10_001), numbered(1))) == 3


@pytest.mark.parametrize(
    "datagram",
    [
        b"",
        b"\0" * 11,
        b"\xff" * 40,
        struct.pack(">IQBB4fB", 17, 1, 0, 1, *[float("nan")] * 4, 0),
        struct.pack(">IQBB4fB", 17, 1, 0, 1, 0.0, 0.0, 0.0, 0.0, 0),
        struct.pack(">IQBB4f", 17, 1, 0, 1, 0.0, 0.0, 0.0, 1.0)[:-1],
        struct.pack(">IQ3fB", 4, 1, float("inf"), 0.0, 0.0, 0),
        struct.pack(">IQ3fB", 4, 1, 2000.0, 0.0, 0.0, 0),
        struct.pack(">IQB7h", 23, 1, 0, *[0] * 7),
        struct.pack(">IQH", 100, 1, 60_000),
    ],
)
def test_what_is_no_packet(datagram):
    decoder = SlimevrDecoder()
    assert feed(decoder, datagram) == []
    assert decoder.counters.bad == 1


def test_a_host_answers_as_the_server_does():
    host = SlimevrHost()
    data = bytes.fromhex(ROTATION)
    # Nothing is decoded before the handshake, which has the version.
    assert host.receive(data, "a", 0.0) == (False, b"")
    wanted, answer = host.receive(bytes.fromhex(HANDSHAKE), "a", 0.0)
    assert wanted
    assert answer == b"\x03Hey OVR =D 5".ljust(64, b"\0")
    assert host.receive(data, "a", 0.1) == (True, b"")
    assert host.receive(bytes.fromhex(SENSOR_INFO), "a", 0.1) == (True, bytes.fromhex("0000000f0101"))
    assert host.receive(bytes.fromhex(FEATURES), "a", 0.1)[1] == bytes.fromhex("00000016000000000000000003")
    assert host.due(0.4) == []
    keep_alive = bytes.fromhex("000000010000000000000000")
    assert host.due(0.5) == [("a", keep_alive)]
    assert host.due(0.9) == []
    assert host.due(1.0) == [("a", keep_alive)]
    assert host.due(20.0) == []  # gone
    assert host.receive(data, "a", 20.0) == (False, b"")


def test_a_host_sends_little_to_a_forged_address():
    host = SlimevrHost()
    host.receive(bytes.fromhex(HANDSHAKE), "victim", 0.0)
    assert sum(len(host.due(k / 10)) for k in range(90)) == 2
    # A tracker that is heard again is kept sending.
    assert host.receive(bytes.fromhex(ROTATION), "victim", 9.0) == (True, b"")
    assert [tracker for tracker, _ in host.due(9.5)] == ["victim"]


def test_a_host_answers_few_strangers_and_no_short_calls():
    host = SlimevrHost()
    call = bytes.fromhex(HANDSHAKE)
    assert host.receive(call[:12], "short", 0.0) == (False, b"")
    answers = [host.receive(call, number, 0.0)[1] for number in range(200)]
    assert sum(map(bool, answers)) == slimevr.MAX_TRACKERS
    assert host.receive(call, 0, 1.0)[1]  # those that it knows are answered again


def test_no_datagram_upsets_a_host():
    rng = random.Random(5)
    host = SlimevrHost()
    whole = [bytes.fromhex(text) for text in (HANDSHAKE, FEATURES, SENSOR_INFO, ROTATION)]
    for k in range(3000):
        datagram = bytearray(rng.choice(whole))
        datagram[rng.randrange(len(datagram))] = rng.randrange(256)
        data = bytes(datagram[: rng.randrange(len(datagram) + 1)])
        wanted, answer = host.receive(data, rng.randrange(100), k / 100)
        assert isinstance(wanted, bool)
        assert len(answer) <= max(64, len(data))
        assert len(host.identity(data, k % 100)) in (0, 17)
        assert len(host.due(k / 100)) <= slimevr.MAX_TRACKERS
    assert host.due(1000.0) == []


def test_calls_without_an_answer_are_reported():
    decoder = SlimevrDecoder()
    feed(decoder, HANDSHAKE)
    assert decoder.refused is None
    feed(decoder, HANDSHAKE)
    assert decoder.refused.startswith(
        "the tracker 02:00:00:00:00:01 calls and gets no answer: give --protocol slimevr"
    )


@pytest.mark.parametrize(
    "sample",
    [Sample(0, None, None, UP), Sample(256, None, QUAT), Sample(0, None, (float("nan"), 0.0, 0.0, 1.0))],
)
def test_what_cannot_be_sent(sample):
    with pytest.raises(ValueError, match=r"cannot send|needs an orientation"):
        slimevr.encode(sample, 0)
