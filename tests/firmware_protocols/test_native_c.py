"""The C sender against the Python encoder, byte for byte."""

import math
import random
import struct
import subprocess
from binascii import crc_hqx
from pathlib import Path

import pytest

from firmware_protocols import native, native_can, native_packet
from firmware_protocols.native import NativeDecoder
from firmware_protocols.native_packet import Info, Packet

SOURCE = Path(__file__).parent / "packet_encoder.c"
FLT_MAX = 3.4028234663852886e38
SCALES = (32767, 100, 900, 10, 100)


@pytest.fixture(scope="session")
def program(cc, tmp_path_factory):
    return cc(tmp_path_factory.mktemp("c") / "encoder", "-std=c99", SOURCE)


def ask(program, requests):
    done = subprocess.run(
        [str(program)], input="\n".join(requests) + "\n", capture_output=True, text=True, check=True
    )
    answers = done.stdout.split("\n")[:-1]
    assert len(answers) == len(requests)
    return answers


def neighbours(value):
    """A value and the binary32 numbers around it."""
    (bits,) = struct.unpack("<I", struct.pack("<f", value))
    return [
        value,
        *(struct.unpack("<f", struct.pack("<I", bits + d))[0] for d in (-1, 0, 1) if bits + d >= 0),
    ]


def awkward(rng, scale):
    """A number that rounding, range or sign could get wrong at this scale."""
    kind = rng.randrange(6)
    if kind == 0:
        value = rng.gauss(0, 1000 / scale)
    elif kind == 1:
        value = rng.choice(neighbours((rng.randrange(32768) + 0.5) / scale))
    elif kind == 2:
        value = rng.randrange(-64, 64) / 2 ** rng.randrange(
            12
        )  # exact in binary: true ties where scale is even
    elif kind == 3:
        value = rng.choice(
            neighbours(rng.choice([32766.5, 32767, 32767.5, 32768, 32768.5, 32769, 65536]) / scale)
        )
    elif kind == 4:
        value = rng.choice([0.0, 1e-45, 1e-38, 7.6e-6, 1.5e-5, 1.6e-5, 65535.0, 65536.0, 1e6, 1e20, FLT_MAX])
    else:
        while not math.isfinite(value := struct.unpack("<f", rng.randbytes(4))[0]):
            pass
    return value * rng.choice((-1, 1))


def random_packet(rng):
    def vector(n, scale):
        return tuple(awkward(rng, scale) for _ in range(n)) if rng.random() < 0.7 else None

    quat, acc, gyr, mag = (vector(n, scale) for n, scale in zip((4, 3, 3, 3), SCALES, strict=False))
    temperature = vector(1, 100)
    battery = (rng.randrange(256), rng.randrange(256)) if rng.random() < 0.5 else None
    return Packet(
        rng.randrange(256), rng.randrange(1 << 16), rng.randrange(1 << 32), quat, acc, gyr, mag,
        temperature and temperature[0], battery,
    )  # fmt: skip


def request(packet, floats, extra_mask=0):
    present = [v is not None for v in packet[3:7]]
    mask = sum(p << (i + 5 * floats) for i, p in enumerate(present)) | extra_mask
    mask |= (packet.temperature is not None) << 4 | (packet.battery is not None) << 9
    numbers = []
    for vector, n in zip(packet[3:7], (4, 3, 3, 3), strict=True):
        numbers += vector or [0.0] * n
    numbers.append(packet.temperature or 0.0)
    battery = packet.battery or (0, 0)
    return " ".join(
        map(str, ["P", *packet[:3], mask, *(struct.pack(">f", x).hex() for x in numbers), *battery])
    )


def info_request(info):
    segment = 255 if info.segment is None else info.segment
    return (
        f"I {info.sensor_id} {segment} {native_packet.FRAMES.index(info.frame)} "
        f"{round(info.rate_hz * 10)} {info.firmware.encode().hex() or '-'}"
    )


@pytest.fixture(scope="session")
def cases():
    rng = random.Random(20)
    return [(random_packet(rng), bool(i % 3 == 0)) for i in range(900)]


def check_packets(program, cases):
    answers = ask(program, [request(packet, floats) for packet, floats in cases])
    for (packet, floats), answer in zip(cases, answers, strict=True):
        assert answer == native.encode(packet, floats=floats).hex(), packet


def test_packets_equal_python(program, cases):
    check_packets(program, cases)


def test_ties_go_away_from_zero(program):
    # 0.125 m/s^2 is 12.5 steps, 0.375 is 37.5, 0.5 of a quaternion is 16383.5, 0.25 uT is 2.5.
    packet = Packet(
        1,
        2,
        3,
        (0.5, -0.5, 0.5, -0.5),
        (0.125, -0.125, 0.375),
        (0.125, -0.125, 0.0),
        (0.25, -0.25, 0.75),
        -0.125,
    )
    body = native_packet.encode_body(packet)
    assert struct.unpack("<14h", body[10:]) == (
        *(16384, -16384, 16384, -16384), *(13, -13, 38), *(113, -113, 0), *(3, -3, 8), -13
    )  # fmt: skip
    assert ask(program, [request(packet, False)]) == [native.encode(packet).hex()]


def test_saturates(program):
    packet = Packet(
        1,
        2,
        3,
        (2.0, -2.0, 1.0, -1.0),
        (400.0, -400.0, 1e30),
        (40.0, -40.0, -FLT_MAX),
        None,
        327.675,
        (200, 255),
    )
    assert struct.unpack("<11hBB", native_packet.encode_body(packet)[10:]) == (
        *(32767, -32768, 32767, -32767), *(32767, -32768, 32767), *(32767, -32768, -32768), 32767, 100, 255
    )  # fmt: skip
    assert ask(program, [request(packet, False)]) == [native.encode(packet).hex()]


def test_refuses_nan_infinity_and_bad_masks(program):
    packet = Packet(1, 2, 3, (1.0, 0.0, 0.0, 0.0))
    bad = [
        request(Packet(1, 2, 3, (1.0, 0.0, value, 0.0)), floats)
        for value in (math.nan, math.inf, -math.inf)
        for floats in (0, 1)
    ]
    bad += [request(packet, False, extra) for extra in (0x20, 0x400, 0x8000)]
    assert set(ask(program, bad)) == {""}


def test_info_equals_python(program):
    rng = random.Random(4)
    infos = [Info(255, ""), Info(0, "~" * 32, 23, "Z-up", 6553.5)]
    for _ in range(100):
        text = "".join(chr(rng.randrange(0x20, 0x7F)) for _ in range(rng.randrange(33)))
        frame, segment = rng.choice(native_packet.FRAMES), rng.choice([None, *range(24)])
        infos.append(Info(rng.randrange(256), text, segment, frame, rng.randrange(65536) / 10))
    requests = [info_request(i) for i in infos]
    answers = ask(program, requests)
    assert answers == [native.encode_info(i).hex() for i in infos]
    decoder = NativeDecoder()
    for info, answer in zip(infos, answers, strict=True):
        decoder.feed(bytes.fromhex(answer))
        assert decoder.infos[info.sensor_id] == info


def test_info_refuses(program):
    text = b"v1".hex()
    refused = [
        f"I 1 24 0 0 {text}",
        f"I 1 0 5 0 {text}",
        f"I 1 0 0 0 {'41' * 33}",
        "I 1 0 0 0 0a",
        "I 1 0 0 0 7f",
        "I 1 0 0 0 c3a9",
    ]
    assert set(ask(program, refused)) == {""}


def test_crc_and_cobs_equal_python(program):
    rng = random.Random(5)
    data = [b"123456789", b"", b"\0", *(b"\1" * n for n in (253, 254, 255, 508, 509)), b"\1" * 254 + b"\0"]
    data += [
        bytes(rng.choice((0, 1, 255)) if rng.random() < p else 7 for _ in range(rng.randrange(900)))
        for p in [0.01, 0.5] * 20
    ]
    answers = ask(program, [f"C {d.hex() or '-'}" for d in data])
    assert answers == [f"{crc_hqx(d, 0xFFFF):04x}{native.cobs_encode(d).hex()}" for d in data]


def test_same_bytes_however_compiled(cc, tmp_path, cases):
    check_packets(cc(tmp_path / "fast", "-std=c99", "-O3", "-ffast-math", SOURCE), cases[:300])


def test_compiles_as_cplusplus(cxx, tmp_path, cases):
    check_packets(cxx(tmp_path / "plus", "-std=c++11", "-x", "c++", SOURCE), cases[:300])


# --- CAN ------------------------------------------------------------------------------------------


def test_can_frames_equal_python(program, cases):
    # The form that the mask names does not matter here.
    cases = [(p._replace(sensor_id=p.sensor_id % 32), floats) for p, floats in cases]
    bases = [0x400, 0x000, 0x81, 0x780, 0x781, 0x1FFFFF80]
    requests = [
        f"2 {bases[i % 6]} {p.t_us // 100 & 0xFFFF} {request(p, floats)[2:]}"
        for i, (p, floats) in enumerate(cases)
    ]
    refused = 0
    for i, ((packet, _), answer) in enumerate(zip(cases, ask(program, requests), strict=True)):
        if packet.acc is None:
            refused += 1
            assert answer == ""
        else:
            frames = native_can.encode(packet, bases[i % 6])
            assert answer == "".join(f"{can_id:x}:{data.hex()} " for can_id, data in frames), packet
    assert 0 < refused < len(cases) / 2


def test_can_refuses(program):
    packet = Packet(31, 2, 3, (1.0, 0.0, 0.0, 0.0), *[(0.0, 0.0, 9.81)] * 3)
    bad = [packet._replace(sensor_id=32), packet._replace(acc=None)]
    nan = (0.0, math.nan, 0.0)
    bad += [packet._replace(**{name: nan}) for name in ("acc", "gyr", "mag")]
    bad += [packet._replace(quat=(math.inf, 0.0, 0.0, 0.0))]
    assert set(ask(program, [f"2 1024 0 {request(p, False)[2:]}" for p in bad])) == {""}
    assert ask(program, [f"2 1024 0 {request(packet, False)[2:]}"]) != [""]


def test_can_fd_equals_python(program, cases):
    cases = [(p._replace(sensor_id=p.sensor_id % 32), floats) for p, floats in cases]
    answers = ask(program, ["F" + request(p, floats)[1:] for p, floats in cases])
    too_long = 0
    for (packet, floats), answer in zip(cases, answers, strict=True):
        if len(native_packet.encode_body(packet, floats=floats)) > 64:
            too_long += 1
            assert answer == ""
        else:
            assert answer == native_can.encode_fd(packet, floats=floats)[1].hex()
    assert too_long
    infos = [Info(3, "x" * n, 18, "ENU", 60.0) for n in range(33)]
    answers = ask(program, ["J" + info_request(i)[1:] for i in infos])
    assert answers == [native_can.encode_fd(i)[1].hex() for i in infos]


def test_can_sync_equals_python(program):
    can_id, data = native_can.encode_sync(0x12345678)
    assert ask(program, [f"S {0x12345678}"]) == [f"{can_id:x}:{data.hex()} "]


def test_can_clock_does_not_jump(program):
    rng = random.Random(6)
    times = [0]
    while times[-1] < 3 * 2**32:
        times.append(times[-1] + rng.choice([1, 99, 10_000, 4_000_000_000]))
    answers = ask(program, [f"T {t % 2**32}" for t in times])
    assert answers == [str(t // 100 % 65536) for t in times]
