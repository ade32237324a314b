"""WitMotion over a serial line, RS-485 and CAN: published and measured packets, bad lines, round trips."""

import json
import math
import random
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocols import witmotion, witmotion_ble, witmotion_can, witmotion_modbus
from firmware_protocols.rotation import rotate
from firmware_protocols.sample import STANDARD_G, Counters, Sample
from firmware_protocols.witmotion import WitDecoder
from firmware_protocols.witmotion_can import WitCanDecoder
from firmware_protocols.witmotion_modbus import WitModbusDecoder

VECTORS = {
    v["id"]: v
    for v in json.loads((Path(__file__).parents[1] / "data" / "protocols" / "witmotion.json").read_text())
}
QUAT = (0.8, 0.0, 0.6, 0.0)


def stream(n, sensor=0):
    return [
        Sample(
            sensor,
            (43_200_000 + 10 * i) * 1000,
            QUAT,
            (STANDARD_G * i / 64, 0.0, STANDARD_G),
            (0.0, math.radians(i), 1.0),
            (100.0, float(i), -400.0),
            25.5,
        )
        for i in range(n)
    ]


def check(sample, expected, tolerance):
    for name, want in expected.items():
        got = getattr(sample, name)
        assert (got is None) == (want is None), name
        assert want is None or got == pytest.approx(want, abs=tolerance), name


def same(got, sent, tolerance=2e-3):
    assert len(got) == len(sent)
    for a, b in zip(got, sent, strict=True):
        check(a, b._asdict(), tolerance)


def packets(data):
    return [data[i : i + 11] for i in range(0, len(data), 11)]


def decode(data, **options):
    decoder = WitDecoder(**options)
    return decoder.feed(data), decoder.counters


def upright(sample):
    w, x, y, z = sample.quat
    a, b, c = sample.acc
    return (2 * (x * z - w * y) * a + 2 * (y * z + w * x) * b + (1 - 2 * (x * x + y * y)) * c) / math.hypot(
        a, b, c
    )


# --- published and measured packets ---------------------------------------------------------------


def test_serial_vectors():
    quat = bytes.fromhex(VECTORS["wit_quat"]["hex"])
    for name in ("wit_hwt901b", "wit_hwt905"):
        vector = VECTORS[name]
        data = bytes.fromhex(vector["hex"])
        with_quat, _ = decode((data + quat) * 2)
        assert len(with_quat) == 2
        expected = {key: value for key, value in vector["expect"].items() if key in Sample._fields}
        check(with_quat[0], expected | VECTORS["wit_quat"]["expect"], 1e-5)
        if "quat" in expected:
            (sample, _), counters = decode(data * 2)
            check(sample, expected, 1e-5)
            assert counters == Counters(bytes=88, packets=2)
            # Measured in motion: down is right, the size is not that of g alone.
            assert upright(sample) > 0.99


def test_poll_vector():
    vector = VECTORS["wit_poll"]
    expected = vector["expect"]
    assert witmotion_modbus.poll(**expected).hex() == vector["hex"]
    assert witmotion_modbus.crc16(b"123456789") == 0x4B37
    for wrong in ((0, 0x34, 12), (248, 0x34, 12), (1, -1, 12), (1, 0x34, 0), (1, 0x34, 126)):
        with pytest.raises(ValueError, match="cannot ask"):
            witmotion_modbus.poll(*wrong)


# --- serial ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("angles", [False, True])
def test_round_trip(angles):
    sent = stream(20)
    data = b"".join(witmotion.encode(s, angles=angles) for s in sent)
    samples, counters = decode(data)
    # The end of a cycle is known from the second one on; from there samples go out at once.
    same(samples, sent)
    assert counters == Counters(bytes=len(data), packets=20)
    assert all(abs(upright(s) - upright(t)) < 1e-3 for s, t in zip(samples, sent, strict=True))


def test_samples_go_out_with_their_last_packet():
    decoder = WitDecoder()
    decoder.feed(b"".join(map(witmotion.encode, stream(2))))
    for sample in stream(5):
        *before, last = packets(witmotion.encode(sample))
        assert decoder.feed(b"".join(before)) == []
        same(decoder.feed(last), [sample])


def test_field_in_microtesla():
    sent = stream(3)
    data = b"".join(witmotion.encode(s, mag_ut=0.013) for s in sent)
    same(decode(data, mag_ut=0.013)[0], sent, 0.01)


def test_field_range_is_held():
    (sample, *_), _ = decode(witmotion.encode(Sample(0, 0, QUAT, (1e6, -1e6, 0.0))) * 2)
    assert sample.acc == pytest.approx((16 * STANDARD_G, -16 * STANDARD_G, 0), rel=1e-4)


def test_angles_turn_about_z_then_y_then_x():
    angles = [round(x / 180 * 32768) for x in (30, -45, 60)]
    body = b"\x55\x53" + b"".join(a.to_bytes(2, "little", signed=True) for a in angles) + b"\0\0"
    packet = body + bytes([sum(body) & 0xFF])
    acc = packets(witmotion.encode(stream(1)[0]))[1]
    w, x, y, z = decode((acc + packet) * 2)[0][0].quat
    assert 1 - 2 * (y * y + z * z) == pytest.approx(math.sqrt(1 / 8), abs=1e-3)  # cos(pitch) cos(yaw)
    assert 2 * (x * y + w * z) == pytest.approx(math.sqrt(3 / 8), abs=1e-3)  # cos(pitch) sin(yaw)
    assert 2 * (x * z - w * y) == pytest.approx(math.sqrt(1 / 2), abs=1e-3)  # -sin(pitch)
    assert 2 * (y * z + w * x) == pytest.approx(math.sqrt(1 / 8), abs=1e-3)  # cos(pitch) sin(roll)


def test_output_that_changes():
    # A magnetic field and a quaternion that are switched on and off again cost a few samples and mix none.
    decoder, got = WitDecoder(), []
    plain = [s._replace(mag=None) for s in stream(12)]
    for sample in plain[:4] + stream(8)[4:] + plain[8:]:
        got += decoder.feed(witmotion.encode(sample, angles=sample.mag is not None))
    assert len(got) >= 9
    for sample in got:
        i = round(sample.acc[0] * 64 / STANDARD_G)
        check(sample, {"gyr": plain[i].gyr, "quat": QUAT}, 2e-3)


def test_answers_and_other_packets_are_skipped():
    sent = stream(4)
    body = b"\x55\x5f" + bytes(8)
    answer = body + bytes([sum(body) & 0xFF])
    body = b"\x55\x56" + bytes(8)
    pressure = body + bytes([sum(body) & 0xFF])
    data = b"".join(answer.join([*packets(witmotion.encode(s))[:4], pressure]) for s in sent)
    assert decode(data)[0] == []  # no quaternion and no angles in them
    data = b""
    for s in sent:
        p = packets(witmotion.encode(s))
        data += answer.join([*p[:-1], pressure, p[-1]])
    samples, counters = decode(data)
    same(samples, sent)
    assert counters.skipped == 20


def test_quaternion_of_a_device_that_starts():
    zero = b"\x55\x59" + bytes(8) + b"\xae"
    sent = stream(4)
    frames = [packets(witmotion.encode(s)) for s in sent]
    frames[2][-1] = zero
    samples, counters = decode(b"".join(b"".join(f) for f in frames))
    same(samples, sent[:2] + sent[3:])
    assert (counters.bad, counters.lost) == (1, 0)


def test_impossible_time():
    p = packets(witmotion.encode(stream(1)[0]))
    body = b"\x55\x50" + bytes([26, 1, 1, 25, 0, 0, 0, 0])
    p[0] = body + bytes([sum(body) & 0xFF])
    assert decode(b"".join(p) * 2)[0][0].time_us is None


@given(st.integers(0, 2**32))
@settings(max_examples=50, deadline=None)
def test_any_chunking(in_pieces, seed):
    rng = random.Random(seed)
    data = b""
    for sample in stream(8):
        for packet in packets(witmotion.encode(sample, angles=rng.random() < 0.3)):
            data += packet
            if rng.random() < 0.1:
                data += rng.choice([rng.randbytes(60), b"\x55", b"\x55\x51", packet[3:]])
    in_pieces(WitDecoder, data, rng.choices([1, 2, 7, 11, 64], k=len(data)))


def test_noise_between_cycles_costs_nothing():
    rng = random.Random(3)
    for length in (1, 2, 10, 11, 12, 200):
        sent = stream(20)
        data = b"".join(witmotion.encode(s) + rng.randbytes(length) for s in sent)
        samples, counters = decode(data)
        same(samples, sent)
        assert counters.bad == 20
        assert counters.resyncs == 19
        assert counters.lost == 0


def test_every_flipped_bit_and_truncation_costs_its_own_cycle():
    sent = stream(5)
    good = witmotion.encode(sent[2])
    before = b"".join(map(witmotion.encode, sent[:2]))
    after = b"".join(map(witmotion.encode, sent[3:]))
    broken = []
    for bit in range(8 * len(good)):
        flipped = bytearray(good)
        flipped[bit // 8] ^= 1 << bit % 8
        broken.append(bytes(flipped))
    broken += [good[:i] + good[i + 1 :] for i in range(len(good))]
    for data in broken:
        samples, counters = decode(before + data + after)
        same(samples, sent[:2] + sent[3:])
        assert counters.resyncs == 1
        assert counters.lost == 1


def test_lost_packets_never_mix_cycles():
    sent = stream(8)
    frames = [p for s in sent for p in packets(witmotion.encode(s))]
    for start in range(10, 15):
        for count in (1, 2, 3, 4, 6, 7, 8, 9):
            data = b"".join(frames[:start] + frames[start + count :])
            for sample in decode(data)[0]:
                i = round(sample.acc[0] * 64 / STANDARD_G)
                check(
                    sample,
                    {k: v for k, v in sent[i]._asdict().items() if getattr(sample, k) is not None},
                    2e-3,
                )


@given(st.lists(st.binary(max_size=60), max_size=8))
@settings(max_examples=100, deadline=None)
def test_random_bytes_never_raise(chunks):
    for decoder in (WitDecoder(), WitModbusDecoder(), WitModbusDecoder(count=33)):
        for chunk in chunks:
            decoder.feed(chunk)
            assert len(decoder._rest) <= 75
        assert decoder.counters.bytes == sum(map(len, chunks))


@given(st.lists(st.tuples(st.integers(0x50, 0x5F), st.binary(min_size=8, max_size=8)), max_size=12))
@settings(max_examples=150, deadline=None)
def test_random_packets_never_raise(parts):
    bodies = [bytes([0x55, kind]) + data for kind, data in parts]
    decode(b"".join(body + bytes([sum(body) & 0xFF]) for body in bodies))
    decoder = WitCanDecoder(fine_angles=True)
    for body in bodies:
        decoder.feed(0x50, body[:8])


# --- RS-485 ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [12, 33])
@pytest.mark.parametrize("echo", [False, True])
def test_modbus_round_trip(count, echo):
    sent = [s._replace(sensor=0x50 + i % 3, time_us=None) for i, s in enumerate(stream(9))]
    if count == 12:
        sent = [s._replace(temperature=None) for s in sent]
    decoder, samples = WitModbusDecoder(count=count), []
    for sample in sent:
        if echo:
            samples += decoder.feed(witmotion_modbus.poll(sample.sensor, count=count))
        samples += decoder.feed(witmotion_modbus.encode_modbus(sample, count=count))
    same(samples, sent)
    assert (decoder.counters.packets, decoder.counters.bad) == (9, 0)
    assert decoder.counters.skipped == 9 * echo


def test_modbus_refusal_is_skipped():
    decoder = WitModbusDecoder()
    head = bytes([0x50, 0x83, 2])
    refusal = head + witmotion_modbus.crc16(head).to_bytes(2, "little")
    answer = witmotion_modbus.encode_modbus(stream(1, sensor=0x50)[0])
    assert len(decoder.feed(refusal + answer)) == 1
    assert (decoder.counters.skipped, decoder.counters.bad) == (1, 0)


def test_modbus_bad_line():
    sent = [s._replace(time_us=None, temperature=None) for s in stream(3, sensor=0x50)]
    first, good, third = map(witmotion_modbus.encode_modbus, sent)
    broken = [good[:i] for i in range(1, len(good))] + [good[i:] for i in range(1, len(good))]
    for bit in range(8 * len(good)):
        flipped = bytearray(good)
        flipped[bit // 8] ^= 1 << bit % 8
        broken.append(bytes(flipped))
    for data in broken:
        decoder = WitModbusDecoder()
        samples = decoder.feed(first + data + third + bytes(80))
        same(samples, [sent[0], sent[2]])
        assert decoder.counters.resyncs == 1


def test_modbus_refuses():
    with pytest.raises(ValueError, match="count"):
        WitModbusDecoder(count=13)
    with pytest.raises(ValueError, match="quaternion, acceleration and angular rate are required"):
        witmotion_modbus.encode_modbus(Sample(0x50))
    zero = witmotion_modbus.encode_modbus(
        stream(1, sensor=1)[0]._replace(quat=(0.0, 0.0, 0.0, 0.0)), count=33
    )
    decoder = WitModbusDecoder(count=33)
    assert decoder.feed(zero) == []
    assert decoder.counters.bad == 1


# --- CAN ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fine", [False, True])
def test_can_round_trip_of_several_devices(fine):
    devices = (0x50, 0x51, 0x18FF0050)
    sent = {d: [s._replace(time_us=None, temperature=None) for s in stream(10, sensor=d)] for d in devices}
    decoder, got = WitCanDecoder(fine_angles=fine), []
    for i in range(10):
        cycles = [witmotion_can.encode_can(sent[d][i], fine_angles=fine) for d in devices]
        for frames in zip(*cycles, strict=True):
            for frame in frames:
                got += decoder.feed(*frame)
    for d in devices:
        same([s for s in got if s.sensor == d], sent[d])
    assert (decoder.counters.packets, decoder.counters.lost) == (30, 0)


@pytest.mark.parametrize("fine", [False, True])
def test_lost_can_frames_never_mix_cycles(fine):
    sent = [s._replace(time_us=None, temperature=None) for s in stream(8, sensor=0x50)]
    frames = [f for s in sent for f in witmotion_can.encode_can(s, fine_angles=fine)]
    size = len(frames) // 8
    for start in range(2 * size, 3 * size):
        for count in range(1, size):
            decoder, samples = WitCanDecoder(fine_angles=fine), []
            for frame in frames[:start] + frames[start + count :]:
                samples += decoder.feed(*frame)
            # Nothing after the loss but the cycles that it touches is changed.
            assert len(samples) >= 6
            for sample in samples:
                i = round(sample.acc[0] * 64 / STANDARD_G)
                check(
                    sample,
                    {k: v for k, v in sent[i]._asdict().items() if getattr(sample, k) is not None},
                    2e-3,
                )


def test_other_frames_on_the_bus_are_skipped():
    decoder = WitCanDecoder()
    for data in (b"", bytes(8), b"\x55\x51" + bytes(5), b"\x55\x61" + bytes(6), b"\x55\x5f" + bytes(6)):
        assert decoder.feed(0x50, data) == []
    assert decoder.counters.skipped == 5
    assert decoder.feed(0x50, b"\x55\x59" + bytes(6)) == []  # three of four components are of no use


def test_fine_angle_of_no_axis():
    decoder = WitCanDecoder(fine_angles=True)
    assert decoder.feed(0x50, b"\x55\x53\x04" + bytes(5)) == []
    assert decoder.counters.bad == 1


@given(st.lists(st.tuples(st.integers(0, 2**29 - 1), st.binary(max_size=8), st.booleans()), max_size=12))
@settings(max_examples=60, deadline=None)
def test_random_can_frames_never_raise(frames):
    decoder = WitCanDecoder()
    for frame in frames:
        decoder.feed(*frame)
    assert decoder.counters.bytes == sum(len(data) for _, data, _ in frames)


# --- Bluetooth models -----------------------------------------------------------------------------


def ble(n):
    return [s._replace(time_us=None, mag=None, temperature=None) for s in stream(n)]


def test_a_bluetooth_frame_byte_for_byte():
    # The order of the manual: acceleration, rate, angles; 1 g up, 90 deg about X.
    frame = bytes.fromhex("5561 0000 0008 0000 0100 feff 0000 0040 0000 0000")
    decoder = witmotion_ble.WitBleDecoder()
    assert decoder.feed(frame) == []  # until the next one shows that no byte is missing
    (sample,) = decoder.feed(frame[:2])
    assert sample.acc == pytest.approx((0, STANDARD_G, 0))
    assert sample.gyr == pytest.approx((math.radians(2000 / 32768), -math.radians(4000 / 32768), 0))
    assert rotate(sample.quat, sample.acc) == pytest.approx((0, 0, STANDARD_G), abs=1e-6)
    assert decoder.feed(frame[2:-1]) == decoder.flush() == []
    assert decoder.counters.bad == 0


def test_bluetooth_frames_and_answers_in_any_chunks():
    answer = bytes.fromhex("5571 3a00 6801 6900 7a00 0000 0000 0000 0000 0000")
    data = b"".join(witmotion_ble.encode(s) + answer * (i % 3 == 0) for i, s in enumerate(ble(40)))
    decoder = witmotion_ble.WitBleDecoder()
    got = [*decoder.feed(data), *decoder.flush()]
    assert len(got) == decoder.counters.packets == 40
    assert (decoder.counters.bad, decoder.counters.skipped) == (0, 14)
    pieces = witmotion_ble.WitBleDecoder()
    assert [s for i in range(len(data)) for s in pieces.feed(data[i : i + 1])] + pieces.flush() == got
    assert pieces.counters == decoder.counters


def test_a_byte_lost_costs_its_bluetooth_frame():
    frames = [witmotion_ble.encode(s) for s in ble(60)]
    whole = witmotion_ble.WitBleDecoder()
    expected = [*whole.feed(b"".join(frames)), *whole.flush()]
    rng = random.Random(3)
    cut = set(rng.sample(range(1, 58), 12))
    for i in cut:
        at = rng.randrange(20)
        frames[i] = frames[i][:at] + frames[i][at + 1 :]
    decoder = witmotion_ble.WitBleDecoder()
    got = [*decoder.feed(b"".join(frames)), *decoder.flush()]
    # Without its start, a frame does not vouch for the one before.
    near = cut | {i - 1 for i in cut}
    assert all(sample in expected for sample in got)
    assert all(expected[i] in got for i in range(60) if i not in near)
    assert decoder.counters.bad > 0
