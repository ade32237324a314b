"""Our decoders against those of makers and of the community, packet by packet.

    witmotion                          WitMotion standard packets
    adafruit-circuitpython-bno08x-rvc  BNO08x UART-RVC frames
    mscl (pymscl)                      MicroStrain MIP, over a TCP connection of this machine
    cantools                           MTi-600 CAN by our DBC file (native packets: test_dbc.py)
    ximu3                              in test_ximu3.py

pymscl has wheels for Linux on x86-64 (glibc 2.34) from Python 3.11 on; on other platforms its tests do not
exist. The others run everywhere. HiPNUC's parser and DBC files are in no package and have no licence file:
what the encoders of both CAN formats send was compared with the DBC files by hand, 3000 random samples, each
value within a step. No library for Xsens Xbus or VectorNav is on PyPI: recordings of devices with the output
of others' decoders, and the makers' examples, stand in for them in test_xsens.py and test_vectornav.py.
"""

from __future__ import annotations

import math
import platform
import random
import socket
import struct
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import adafruit_bno08x_rvc
import cantools
import pytest
import witmotion.protocol

import firmware_protocols
from firmware_protocols import bno08x, mip, xsens_can
from firmware_protocols.sample import STANDARD_G, Sample, z_up
from firmware_protocols.witmotion import WitDecoder

HAS_MSCL = (
    sys.platform == "linux" and platform.machine() == "x86_64" and sys.version_info >= (3, 11)
)  # the marker in pyproject.toml
COUNT = 3000
RECORDING = Path(__file__).parents[1] / "data" / "protocols" / "microstrain-mip.bin"
DBC = Path(firmware_protocols.__file__).parent / "dbc" / "mti600.dbc"


def turn(axis: int, degrees: float) -> tuple[float, ...]:
    """Quaternion of a turn about X, Y or Z (0, 1, 2)."""
    half = math.radians(degrees) / 2
    return (math.cos(half), *(math.sin(half) * (i == axis) for i in range(3)))


def product(p, q):
    pw, px, py, pz = p
    qw, qx, qy, qz = q
    return (
        pw * qw - px * qx - py * qy - pz * qz,
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
    )


def assert_same_turn(p, q, tolerance=1e-6):
    sign = math.copysign(1.0, sum(a * b for a, b in zip(p, q, strict=True)))
    assert p == pytest.approx([sign * x for x in q], abs=tolerance)


def unit(rng: random.Random) -> tuple[float, ...]:
    values = [rng.gauss(0, 1) for _ in range(4)]
    return tuple(x / math.hypot(*values) for x in values)


def random_samples(seed: int) -> list[Sample]:
    rng = random.Random(seed)
    return [
        Sample(
            0,
            1_000_000 + 10_000 * i,
            unit(rng),
            tuple(rng.gauss(0, 20) for _ in range(3)),
            tuple(rng.gauss(0, 5) for _ in range(3)),
            tuple(rng.gauss(0, 40) for _ in range(3)),
            rng.uniform(-20, 80),
        )
        for i in range(COUNT)
    ]


# --- WitMotion ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("orientation", [0x53, 0x59])
def test_witmotion(orientation):
    """Random numbers in every field. The library has 9.8 m/s^2 for g, and other years and months."""
    rng = random.Random(orientation)

    def words() -> bytes:
        return struct.pack("<4h", *(rng.randint(-32768, 32767) for _ in range(4)))

    wire, theirs = b"", []
    for i in range(COUNT):
        minute, ms = divmod(25 * i, 60_000)
        bodies = {
            0x50: struct.pack("<6BH", 26, 10, 20, rng.randrange(24), minute, ms // 1000, ms % 1000),
            **{kind: words() for kind in (0x51, 0x52, 0x53, 0x54)},
            0x59: struct.pack("<4h", *(min(32767, round(x * 32768)) for x in unit(rng))),
        }
        del bodies[0x53 + 0x59 - orientation]
        cycle = {}
        for kind, body in bodies.items():
            message = witmotion.protocol.receive_messages[kind]
            wire += bytes([0x55, kind]) + body + bytes([message.compute_checksum(body)])
            cycle[kind] = message.parse(body)
        theirs.append(cycle)
    decoder = WitDecoder()
    samples = {sample.time_us: sample for sample in decoder.feed(wire)}
    assert decoder.counters.bad == 0
    # What makes a cycle is not known before the second one.
    assert len(samples) >= COUNT - 1
    for cycle in theirs[1:]:
        sample = samples[round(cycle[0x50].timestamp * 1e3) * 1000 % 86_400_000_000]
        acc = [x / witmotion.protocol.G * STANDARD_G for x in cycle[0x51].a]
        assert sample.acc == pytest.approx(acc, rel=1e-9, abs=1e-9)
        assert sample.temperature == pytest.approx(cycle[0x51].temp_celsius)
        assert sample.gyr == pytest.approx([math.radians(x) for x in cycle[0x52].w], rel=1e-9, abs=1e-9)
        assert sample.mag == cycle[0x54].mag
        if orientation == 0x59:
            assert_same_turn(sample.quat, cycle[0x59].q, 5e-5)  # theirs is not brought to norm 1
        else:
            angles = cycle[0x53]
            about_z, about_y, about_x = turn(2, angles.yaw), turn(1, angles.pitch), turn(0, angles.roll)
            assert_same_turn(sample.quat, product(product(about_z, about_y), about_x))


# --- BNO08x -------------------------------------------------------------------------------------------------


def test_bno08x():
    """Random frames, every tenth with a wrong bit: both take the good ones, and read the same."""
    rng = random.Random(8)
    parse = adafruit_bno08x_rvc.BNO08x_RVC._parse_frame
    for i in range(COUNT):
        angles = [rng.randint(-18000, 18000) for _ in range(3)]
        force = [rng.randint(-32768, 32767) for _ in range(3)]
        body = bytearray(struct.pack("<B6h3x", i & 0xFF, *angles, *force))
        body.append(sum(body) & 0xFF)
        if i % 10 == 0:
            body[rng.randrange(17)] ^= 1 << rng.randrange(8)
        theirs = parse(bytes(body))
        ours = bno08x.Bno08xDecoder().feed(b"\xaa\xaa" + body)
        assert (theirs is None) == (i % 10 == 0) == (not ours)
        if theirs is None:
            continue
        ((_, _, quat, acc, *_),) = ours
        yaw, second, third, *their_acc = theirs
        assert acc == pytest.approx(their_acc, rel=1e-5, abs=1e-9)  # 9.8067 and 9.80665
        # The turns that docs/bno08x.md gives for the three angles.
        assert_same_turn(quat, product(product(turn(2, -yaw), turn(0, second)), turn(1, third)))


def test_bno08x_encoder():
    for i, sample in enumerate(random_samples(9)):
        frame = bno08x.encode(sample, i)
        yaw, second, third, *acc = adafruit_bno08x_rvc.BNO08x_RVC._parse_frame(frame[2:])
        assert acc == pytest.approx(sample.acc, rel=1e-5, abs=0.006)  # steps of 1 mg
        quat = product(product(turn(2, -yaw), turn(0, second)), turn(1, third))
        assert_same_turn(quat, sample.quat, 2e-4)  # steps of 0.01 degrees


# --- MicroStrain --------------------------------------------------------------------------------------------


if HAS_MSCL:
    import mscl

    @contextmanager
    def mscl_node() -> Iterator[tuple[mscl.InertialNode, socket.socket]]:
        """The maker's side of a connection, and ours."""
        with socket.create_server(("127.0.0.1", 0)) as server:
            connection = mscl.Connection.TcpIp(*server.getsockname())
            device, _ = server.accept()
            with device:
                yield mscl.InertialNode(connection), device
                connection.disconnect()

    def mscl_packets(data: bytes, count: int) -> list[mscl.MipDataPacket]:
        """What the maker's library makes of a stream; waits until it has so many packets."""
        packets: list[mscl.MipDataPacket] = []
        with mscl_node() as (node, device):
            device.sendall(data)
            while len(packets) < count:
                came = node.getDataPackets(5000)
                assert came, f"{len(packets)} packets of {count}"
                packets += came
        return packets

    def values(packet: mscl.MipDataPacket) -> dict[str, Any]:
        """Values of a packet by the names of its channels."""
        result: dict[str, Any] = {}
        for point in packet.data():
            name = point.channelName()
            if point.storedAs() == mscl.valueType_Vector:
                vector = point.as_Vector()
                result[name] = tuple(vector.as_floatAt(i) for i in range(vector.size()))
            elif point.storedAs() == mscl.valueType_float:
                result[name] = point.as_float()
            elif point.storedAs() == mscl.valueType_uint64:
                result[name] = point.as_uint64()
        return result

    def assert_same(sample: Sample, found: dict[str, Any]) -> list[str]:
        """Compares all that both a sample and a packet can hold, and gives the names of it."""
        met = []
        for name, ours, scale in (
            ("scaledAccel", sample.acc, STANDARD_G),
            ("scaledGyro", sample.gyr, 1.0),
            ("scaledMag", sample.mag, 100.0),
            ("estCompensatedAccel", sample.acc, 1.0),
            ("estAngularRate", sample.gyr, 1.0),
        ):
            if f"{name}X" in found:
                met.append(name)
                theirs = [found[f"{name}{axis}"] * scale for axis in "XYZ"]
                assert ours == pytest.approx(theirs, rel=1e-6, abs=1e-9)
        for name in {"orientQuaternion", "estOrientQuaternion"} & set(found):
            met.append(name)
            assert_same_turn(sample.quat, z_up(found[name]))
        for names in (("yaw", "pitch", "roll"), ("estYaw", "estPitch", "estRoll")):
            if names[0] in found:
                met.append("angles")
                z, y, x = (turn(2 - i, math.degrees(found[name])) for i, name in enumerate(names))
                assert_same_turn(sample.quat, z_up(product(product(z, y), x)))
        for name in {"timeInfo_referenceTime_ahrsImu", "timeInfo_referenceTime_estFilter"} & set(found):
            met.append("time")
            assert sample.time_us == found[name] // 1000
        if "tempStats_mean" in found:
            met.append("temperature")
            assert sample.temperature == found["tempStats_mean"]
        return met

    @pytest.mark.parametrize("euler", [False, True])
    @pytest.mark.parametrize(("descriptor", "quantities"), [(mip.SENSOR_SET, 6), (mip.FILTER_SET, 4)])
    def test_mip(descriptor, quantities, euler):
        """The library does not know a magnetic field of the filter set; that set has no temperature."""
        samples = random_samples(descriptor)
        data = b"".join(mip.encode(sample, descriptor=descriptor, euler=euler) for sample in samples)
        ours = mip.MipDecoder().feed(data)
        for sample, packet in zip(ours, mscl_packets(data, COUNT), strict=True):
            assert packet.descriptorSet() == descriptor
            assert len(assert_same(sample, values(packet))) == quantities

    def test_mip_damaged():
        """A wrong bit in every tenth packet: the library's packets are ours."""
        rng = random.Random(5)
        data, good = b"", []
        for i, sample in enumerate(random_samples(4)):
            wire = bytearray(mip.encode(sample))
            if i % 10 == 5:
                wire[rng.randrange(4, len(wire))] ^= 1 << rng.randrange(8)
            else:
                good.append(sample.time_us)
            data += wire
        ours = mip.MipDecoder().feed(data)
        assert [sample.time_us for sample in ours] == good
        for sample, packet in zip(ours, mscl_packets(data, len(good)), strict=True):
            assert len(assert_same(sample, values(packet))) == 6

    def test_mip_recording_of_a_device():
        """Every packet of a real recording that holds something for a sample."""
        data = RECORDING.read_bytes()
        whole = mip.MipDecoder()
        whole.feed(data)
        packets = mscl_packets(data, whole.counters.packets + whole.counters.skipped)
        met: Counter[str] = Counter()
        for descriptor in (mip.SENSOR_SET, mip.FILTER_SET):
            ours = mip.MipDecoder([descriptor]).feed(data)
            theirs = [values(packet) for packet in packets if packet.descriptorSet() == descriptor]
            for sample, found in zip(ours, theirs, strict=True):
                met.update(assert_same(sample, found))
        assert met == {"scaledAccel": 723, "scaledGyro": 723, "scaledMag": 578, "angles": 404, "time": 838}


# --- MTi-600 by the DBC file --------------------------------------------------------------------------------


def test_mti600_by_its_dbc():
    """What our encoder sends is what the DBC file says, and our decoder reads what cantools encodes by it."""
    database = cantools.database.load_file(DBC)
    ours, by_dbc = xsens_can.Mti600CanDecoder(), xsens_can.Mti600CanDecoder()
    steps = {"quat": 1 / 32767, "gyr": 2**-9, "acc": 2**-8, "mag": 2**-10, "temperature": 2**-8}
    got, again = [], []
    samples = [sample._replace(mag=tuple(x / 40 for x in sample.mag)) for sample in random_samples(6)]
    for count, sample in enumerate(samples):
        for can_id, data in xsens_can.encode_mti600(sample, count):
            message = database.get_message_by_frame_id(can_id)
            signals = message.decode(data)
            if "time" in signals:
                assert signals["time"] == sample.time_us
            elif "count" in signals:
                assert signals["count"] == count
            else:
                name = next(iter(signals)).split("_")[0]
                expected = getattr(sample, name)
                expected = expected if isinstance(expected, tuple) else (expected,)
                assert tuple(signals.values()) == pytest.approx(expected, abs=0.5001 * steps[name])
            got += ours.feed(can_id, data)
            again += by_dbc.feed(can_id, message.encode(signals))
    assert len(got) >= COUNT - 2  # the first ones show what there is
    assert again == got
